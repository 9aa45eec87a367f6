"""What `datagen build` can be told: its flags, but for those that send parts off as jobs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class BuildChoices:
    """Which dataset to build, or what to add to one. Each field is a flag of `datagen build`."""

    scene: str = "glass_table"
    """A name that `datagen scenes` lists, a folder with a scene.json, a file that `datagen import` reads, or random:
    glassware that --seed draws. random-0007 is the random scene of seed 7."""
    preset: str = "demo"
    """tiny, demo, standard or paper."""
    num_layers: int = 8
    """Layers kept per ray; the share of rays with more layers is reported."""
    out: Path | None = None
    """Folder to write; with --count, the folder of all datasets. Default: data/SCENE."""
    seed: int = 0
    """Seed of cameras and noise, and of a random scene; the same seed gives the same bytes."""
    family: str | None = None
    """With --scene random: object (one before a background), table (glass among other things) or nested (media inside
    of each other). Default: the seeds take turns."""
    count: int | None = None
    """With --scene random: build so many datasets, of --seed and the seeds that follow."""
    workers: int = 1
    """Parallel processes; the bytes do not depend on their number."""
    overwrite: bool = False
    """Replace an existing dataset that has other settings."""
    preview: bool = False
    """Show thumbnails of what was built, in a terminal with true colour."""
    ceiling: float | None = None
    """Render each test view until its noise ceiling reaches this many dB, instead of a fixed number of samples."""
    resolution: str | None = None
    """Pixels: one number for square pictures, or width and height, such as 320x240. Default: the preset's."""
    views: int | None = None
    """Number of training views. Default: the preset's."""
    test_views: int | None = None
    """Views in each of the two test splits. Default: the preset's."""
    spp: int | None = None
    """Samples per pixel of training views. Default: the preset's."""
    test_spp: int | None = None
    """Samples per pixel of test views; with --ceiling, the number to start from. Default: the preset's."""
    max_depth: int = 24
    """Maximum number of segments of a light path."""
    edit: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Re-render an existing dataset's scene after an edit, with the same test cameras, into its variants/NAME:
    remove:OBJECT, move:OBJECT:dx,dy,dz (metres), duplicate:OBJECT:dx,dy,dz, glass:OBJECT (turns what is opaque into
    glass, and glass opaque), swap:OBJECT:OBJECT, no-glass or opaque-glass. Several --edit change one scene, one after
    the other."""
    twins: bool = False
    """Also render the test views with all glass gone, and with it painted opaque; can be added to a finished
    dataset."""
    angle_splits: bool = False
    """Also render test cameras 10, 20 and 40 degrees outside the directions that training cameras cover; can be added
    to a finished dataset."""
    super_resolution: tuple[int, ...] = ()
    """Also render the test splits at these multiples of the width and height, such as 2 4; can be added to a finished
    dataset."""
    super_resolution_views: int | None = None
    """Evenly spaced views of each test split to render at those sizes. Default: all."""
    dataset: str | None = None
    """Instead of --scene: the folder of an existing dataset, or its name under data/, to which --edit, --twins,
    --angle-splits or --super-resolution add."""
    shard: str | None = None
    """Build part I of N (such as 2/4) of all views. Parts may run at once, on any machines of one kind that share the
    folder. When all are done, the dataset has the bytes of a single build. If a part failed, the same command without
    --shard builds the rest."""
