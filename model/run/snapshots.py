"""Pictures of the held-out views as training goes on: above what is true, below what is predicted.

RUN/snapshots/000500.png   after 500 steps, one at each evaluation; 8-bit sRGB, a column for each view

They are a log for people: no command reads them. Like all of a run but its TensorBoard events, they have equal bytes
whenever the same run is trained, however often it was stopped.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.data.images import png_bytes
from datagen.disk.storage import commit

FOLDER = "snapshots"
MOST_PIXELS = 128
"""The longer side of a view's picture; a larger one is thinned out."""
GAP = 2

Picture = UInt8[np.ndarray, "sheet_h sheet_w 3"]


def snapshot(truth: UInt8[np.ndarray, "view h w 3"], predicted: UInt8[np.ndarray, "view h w 3"]) -> Picture:
    """Both rows in one picture, with white gaps."""
    step = -(-max(truth.shape[1:3]) // MOST_PIXELS)
    rows = [_row(pictures[:, ::step, ::step]) for pictures in (truth, predicted)]
    return np.concatenate([rows[0], np.full((GAP, rows[0].shape[1], 3), 255, np.uint8), rows[1]])


def write_snapshot(run: Path, step: int, picture: Picture) -> None:
    """Commits the picture of one evaluation."""
    commit(run / snapshot_path(step), png_bytes(picture))


def snapshot_path(step: int) -> str:
    """Relative to the run's folder."""
    return f"{FOLDER}/{step:06d}.png"


def list_snapshots(run: Path, *, evaluate_every: int, steps: int) -> list[str]:
    """The pictures that such a run makes, of those that are there, by path relative to its folder."""
    found = []
    for path in sorted((run / FOLDER).glob("*.png")):
        step = int(path.stem) if re.fullmatch("[0-9]{6,12}", path.stem) else 0
        is_evaluated = 0 < step <= steps and (step % evaluate_every == 0 or step == steps)
        if is_evaluated and snapshot_path(step) == f"{FOLDER}/{path.name}":
            found.append(snapshot_path(step))
    return found


def _row(pictures: UInt8[np.ndarray, "view h w 3"]) -> Picture:
    gap = np.full((pictures.shape[1], GAP, 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(parts[:-1], axis=1)
