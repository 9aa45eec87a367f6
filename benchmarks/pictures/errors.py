"""Error maps of a run beside those of another: the views that the first one predicts worst."""

from pathlib import Path

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.data.variants import ANGLES, has_variant, open_variant, variant_root
from datagen.disk.errors import HyalineError
from eval.figures.sheets import Panel, Row, draw_sheet
from eval.score.metrics import psnr
from eval.score.runs import Run, has_split, open_run, read_prediction, within
from eval.tables.grids import psnr_text

HEADS = ("truth", "before", "after", "error before, levels of 255", "error after")


def draw_errors(before: Path, after: Path, *, views: int) -> bytes:
    """The PNG of the `views` worst views of the run in `before`, the worst first, with both runs' errors on one scale.

    Raises:
        HyalineError: the runs are not of one dataset, or share no split.
    """
    runs = [open_run(folder, Path("data")) for folder in (before, after)]
    if runs[0].dataset.seal != runs[1].dataset.seal:
        raise HyalineError(
            f"{after}: was made for {runs[1].dataset.root}; expected {runs[0].dataset.root}, as {before}"
        )
    rows = [_row(*place, runs) for place in find_worst(runs, views)]
    title = f"{runs[0].dataset.name}: the {len(rows)} worst views before, and after"
    return draw_sheet(title, HEADS, rows, size=runs[0].dataset.config.resolution)


def find_worst(runs: list[Run], views: int) -> list[tuple[Split, int]]:
    """Split and number of the views that the first run predicts worst, among those of splits that all predicted."""
    found: list[tuple[float, Split, int]] = []
    for split, home in _homes(runs[0].dataset).items():
        homed = [_run_at(run, home) for run in runs]
        if all(has_split(run, split) for run in homed):
            for view in range(home.config.split(split).views):
                pair = read_prediction(homed[0], split, view), home.view(split, view).image
                found.append((psnr(*pair), split, view))
    if not found:
        raise HyalineError(
            f"{runs[0].folder}: shares no predicted split with {runs[-1].folder}; run `model predict` on both"
        )
    return [(split, view) for _, split, view in sorted(found)[:views]]


def _homes(dataset: Dataset) -> dict[Split, Dataset]:
    """The dataset or the variant that has a test split, those by angle where they were built."""
    angles = [open_variant(dataset, ANGLES)] if has_variant(dataset, ANGLES) else []
    return {**dict.fromkeys(TEST_SPLITS, dataset), **{split: variant for variant in angles for split in variant.splits}}


def _run_at(run: Run, home: Dataset) -> Run:
    return run if home.parent is None else within(run, variant_root(run.folder, home.name), home)


def _row(split: Split, view: int, runs: list[Run]) -> Row:
    home = _homes(runs[0].dataset)[split]
    truth = home.view(split, view).image
    drawn = [read_prediction(_run_at(run, home), split, view) for run in runs]
    errors = [np.abs(picture.astype(np.float64) - truth).mean(axis=-1) for picture in drawn]
    return Row(
        split=split,
        panels=(
            Panel(image=truth, caption=f"view {view_name(view)}"),
            *(Panel(image=picture, caption=psnr_text(psnr(picture, truth))) for picture in drawn),
            *(Panel(image=error, caption=f"mean {error.mean():.1f}, largest {error.max():.0f}") for error in errors),
        ),
    )
