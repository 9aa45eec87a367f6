"""The commands `datagen capture` and `model fit`, and their flags."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.data.paths import DATA_ROOT, FITTED, find_dataset
from datagen.disk.errors import HyalineError, UsageError
from datagen.disk.ownership import DATASET, refuse_others
from datagen.terminal.command import next_command, say, tell
from model.settings import RUNS, SEED

SCALE = "scale: "
"""Begins the remark of a dataset whose lengths are relative."""
DRINK = "_drink"
"""Ends the name of an object without a mesh that `datagen capture` keeps free for what a glass may hold."""


@dataclass(frozen=True, kw_only=True)
class CaptureChoices:
    """The flags of `datagen capture`."""

    longest: int | None = None
    """Longer side of the dataset's pictures in pixels; larger pictures are reduced, averaging linear light. Default:
    160 to 320, so that glass is about 128 pixels long."""
    diameter: str | None = None
    """True diameter of one glass object at its widest place, such as tumbler=82mm, to find the scale; without a name if
    there is one object. Default: metres with a transforms file; otherwise lengths are relative."""

    def __post_init__(self) -> None:
        if self.longest is not None and not 8 <= self.longest <= 4096:
            raise HyalineError(f"--longest: is {self.longest}; expected 8 to 4,096 pixels")
        if self.diameter is not None:
            self.known_diameter()

    def known_diameter(self) -> tuple[str | None, float]:
        """The object of `diameter` (None if unnamed), and its metres."""
        from datagen.scene.description import OBJECT_NAME  # Not before: help needs no NumPy.

        match = re.fullmatch(rf"(?:({OBJECT_NAME})=)?(\d*\.?\d+)(mm|cm|m)", self.diameter or "")
        metres = float(match[2]) * {"mm": 1e-3, "cm": 1e-2, "m": 1.0}[match[3]] if match else 0.0
        if match is None or not 0 < metres < 100:
            raise HyalineError(f"--diameter: is {self.diameter!r}; expected an object and its size, as in tumbler=82mm")
        return match[1], metres


@dataclass(frozen=True, kw_only=True)
class FitChoices:
    """The flags of `model fit` that determine its result."""

    unknown: tuple[str, ...] = ()
    """An object of unknown shape and material. May be repeated. Default: all glass seen first, except panes."""
    mask_errors: int | None = None
    """Percentage of the pictures whose masks may be wrong about a place, for instance because something hides the glass
    there. 0: masks are exact. Default: 5 for imported or captured masks, otherwise 0."""
    steps: int = 800
    """Training steps for the room's textures."""
    skip: tuple[Literal["grid", "search", "refine"], ...] = ()
    """Skip a stage: grid (then all glass is solid), search, or refine. May be repeated."""
    room: Literal["known", "matt"] = "known"
    """Materials of everything but glass: known, or assumed to be diffuse (matt)."""
    seed: int = 0
    """Seed of all random numbers."""

    def __post_init__(self) -> None:
        if self.steps < 1 or not 0 <= (self.mask_errors or 0) < 50:
            raise UsageError("--steps, --mask-errors: expected at least 1, and 0 to 49 %")
        if not SEED[0] <= self.seed <= SEED[1]:
            raise UsageError(f"--seed: is {self.seed}; expected {SEED[0]} to {SEED[1]}")


def capture(
    folder: Path,
    /,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    choices: CaptureChoices = CaptureChoices(),  # noqa: B008
) -> None:
    """Make a dataset from a folder of pictures and masks of glass.

    Reads cameras from a transforms file or COLMAP's sparse/0, or finds them (needs the extra `capture`). Fits the
    opaque room to points: a floor, a table, and surfaces from depth maps. Each glass object is an ellipsoid until
    `model fit` finds its shape. If interrupted, the same command resumes.

    Args:
        folder: A folder with images/ and masks/OBJECT/, one mask per picture, white where the object is visible.
        out: Folder to write. Default: data/NAME.
        overwrite: Replace an existing dataset.
    """
    from hyaline_import.datasets.import_dataset import write_import
    from hyaline_import.source import scene_name
    from hyaline_photos.capture.capture import plan_capture

    root = out or DATA_ROOT / scene_name(folder.resolve())
    refuse_others(root, DATASET)
    plan = plan_capture(folder, choices)
    dataset = write_import(plan, root, overwrite=overwrite)
    say(*plan.imported.remarks)
    tell(str(dataset.root))
    place = shlex.quote(str(dataset.root))
    next_command(f"datagen peel {place} && model fit {place}")


def fit(
    dataset: str | None = None,
    /,
    *,
    name: str = FITTED,
    out: Path | None = None,
    overwrite: bool = False,
    choices: FitChoices = FitChoices(),  # noqa: B008
) -> None:
    """Find shapes and materials of glass from training pictures and masks; write them as a geometry.

    Cameras and everything but glass must be known. To train `light-path` on the result, use `--geometry
    fitted`; to compare it with the truth, `proxies check --geometry fitted`.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        name: The geometry's name: fitted, or fitted-SOMETHING.
        out: Folder for the results of each stage, with pictures. Default: runs/SCENE/fit, or fit-SOMETHING.
        overwrite: Start over. By default, finished stages are kept.
    """
    from datagen.data.dataset import open_dataset
    from hyaline_photos.fit.fit import fit as fit_glass

    if not re.fullmatch(rf"{FITTED}(-[A-Za-z0-9_]+)*", name):
        raise UsageError(f"--name: is {name!r}; expected {FITTED}, or {FITTED}- and letters or digits")
    opened = open_dataset(find_dataset(dataset))
    say(*(line for line in (opened.imported.remarks if opened.imported else ()) if line.startswith(SCALE)))
    place = out or RUNS / opened.name / name.replace(FITTED, "fit", 1)
    fit_glass(opened, name, choices, place, overwrite=overwrite)
    tell(str(place))
    next_command(shlex.join(["model", "train", "light-path", str(opened.root), "--geometry", name]))
