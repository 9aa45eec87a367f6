"""What `datagen build` can be told: its flags, but for those that send parts off as jobs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class BuildChoices:
    """Which dataset to build, or what to add to one. Each field is a flag of `datagen build`."""

    scene: str = "glass_table"
    """A name that `datagen scenes` lists, a folder with a scene.json, or a file that `datagen import` reads."""
    preset: str = "demo"
    """tiny, demo, standard or paper."""
    num_layers: int = 8
    """Layers kept per ray; the share of rays with more is reported."""
    out: Path | None = None
    """Where the dataset goes; data/SCENE unless given."""
    seed: int = 0
    """Fixes cameras and noise; the same seed gives the same bytes."""
    workers: int = 1
    """Processes that render side by side; the bytes do not depend on it."""
    overwrite: bool = False
    """Replace a dataset that stands there with other settings."""
    ceiling: float | None = None
    """Noise ceiling in dB that each test view is rendered to, instead of a fixed number of samples."""
    resolution: int | None = None
    """Width and height in pixels, instead of the preset's."""
    views: int | None = None
    """Training views, instead of the preset's."""
    test_views: int | None = None
    """Views in each of the two test splits, instead of the preset's."""
    spp: int | None = None
    """Samples per pixel of training views, instead of the preset's."""
    test_spp: int | None = None
    """Samples per pixel of test views, instead of the preset's; where --ceiling starts."""
    max_depth: int = 24
    """Longest light path in segments."""
    edit: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Re-render an existing dataset's scene after an edit, with the same test cameras, into its variants/NAME:
    remove:OBJECT, move:OBJECT:dx,dy,dz (metres), duplicate:OBJECT:dx,dy,dz, glass:OBJECT (turns what is opaque into
    glass, and glass opaque), swap:OBJECT:OBJECT, no-glass or opaque-glass. Several --edit change one scene, one after
    the other."""
    twins: bool = False
    """Also render the test views with all glass gone, and with it painted opaque; may be added to a finished
    dataset."""
    angle_splits: bool = False
    """Also render test cameras 10, 20 and 40 degrees outside of what training cameras cover; may be added to a finished
    dataset."""
    super_resolution: tuple[int, ...] = ()
    """Also render the test splits so many times as wide and high, such as 2 4; may be added to a finished dataset."""
    super_resolution_views: int | None = None
    """Views of each test split at those sizes, evenly chosen; all unless given."""
    dataset: str | None = None
    """Instead of --scene: the folder of an existing dataset, or its name under data/, to which --edit, --twins,
    --angle-splits or --super-resolution add."""
    shard: str | None = None
    """Makes part I of N (such as 2/4) of all views into the folder, beside any other parts, on any machines of one kind
    that share it. The dataset is complete when every part is, byte for byte as if made by one; the same command without
    --shard, when all parts have ended, makes what a failed one left out."""
