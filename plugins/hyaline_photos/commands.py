"""The commands `datagen capture` and `model fit`."""

import re
import shlex
from pathlib import Path
from typing import Literal

from datagen.data.paths import DATA_ROOT, FITTED, find_dataset
from datagen.disk.errors import UsageError
from datagen.terminal.command import next_command, say_all, tell
from hyaline_photos.capture.choices import CaptureChoices
from model.settings import RUNS


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
    from hyaline_photos.capture.capture import plan_capture

    plan = plan_capture(folder, choices)
    dataset = write_import(plan, out or DATA_ROOT / plan.config.scene, overwrite=overwrite)
    say_all(list(plan.imported.remarks))
    tell(str(dataset.root))
    root = shlex.quote(str(dataset.root))
    next_command(f"datagen peel {root} && model fit {root}")


def fit(
    dataset: str | None = None,
    /,
    *,
    unknown: tuple[str, ...] = (),
    mask_errors: int | None = None,
    name: str = FITTED,
    out: Path | None = None,
    steps: int = 800,
    skip: tuple[Literal["grid", "search", "again"], ...] = (),
    room: Literal["known", "matt"] = "known",
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Find shapes and materials of glass from training pictures and masks; write them as a geometry.

    Cameras and everything but glass must be known. To train `light-path` on the result, use `--geometry
    fitted`; to compare it with the truth, `proxies check --geometry fitted`.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        unknown: An object of unknown shape and material. May be repeated. Default: all glass seen first, except panes.
        mask_errors: Wrong pixels to expect at the edges of masks: a ray counts as missing an object only if this many
            neighbouring rays miss it as well. Default: 2 for imported or captured masks, otherwise 0.
        name: The geometry's name: fitted, or fitted-SOMETHING.
        out: Folder for the results of each stage, with pictures. Default: runs/SCENE/fit, or fit-SOMETHING.
        steps: Training steps for the room's textures.
        skip: Skip a stage: grid (then all glass is solid), search, or again. May be repeated.
        room: Materials of everything but glass: known, or assumed to be diffuse (matt).
        seed: Seed of all random numbers.
        overwrite: Start over. By default, finished stages are kept.
    """
    from datagen.data.dataset import open_dataset
    from hyaline_photos.fit.fit import FitChoices
    from hyaline_photos.fit.fit import fit as fit_glass

    if not re.fullmatch(rf"{FITTED}(-[A-Za-z0-9_]+)*", name):
        raise UsageError(f"--name: is {name!r}; expected {FITTED}, or {FITTED}- and letters or digits")
    opened = open_dataset(find_dataset(dataset))
    if mask_errors is None:
        mask_errors = 0 if opened.imported is None else 2
    choices = FitChoices(unknown=unknown, mask_errors=mask_errors, steps=steps, skip=skip, room=room, seed=seed)
    place = out or RUNS / opened.name / name.replace(FITTED, "fit", 1)
    fit_glass(opened, name, choices, place, overwrite=overwrite)
    tell(str(place))
    next_command(shlex.join(["model", "train", "light-path", str(opened.root), "--geometry", name]))
