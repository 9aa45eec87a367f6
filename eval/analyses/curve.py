"""The extrapolation curve: a run's error against the training coverage of each pixel, and its slope."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.data.config import Split
from eval.analyses.coverage import PixelCoverage
from eval.score.metrics import decibels
from eval.score.runs import Run, read_prediction
from eval.score.scores import RunScores, Truth
from eval.score.seeds import by_group
from eval.tables.grids import MISSING, Column, Grid, format_number

ANGLE_EDGES = (0, 2, 4, 6, 8, 10, 15, 20, 25, 30, 40, 50, 60, 90, 180)
"""Bin edges in degrees; finer where most pixels are."""
VIEWS_EDGES = (1, 2, 3, 5, 9, 17, 33, 65, 129, 257, 513, 1 << 30)
"""Bin edges: training views that saw a texel."""
MIN_PIXELS = 100
"""Bins with fewer pixels are left out of the slope and of figures."""
PRINTED_ANGLES = ((0, 4), (4, 10), (10, 20), (20, 40), (40, 180))
"""Ranges of the table's columns in degrees."""

CURVE_NOTES = (
    "Slope: dB per 10 degrees between a pixel's ray and the nearest training ray on the same texel and layer, of its "
    "visible layers the farthest; the line through the PSNR of bins of angle, weighted by their pixels. PSNR of pooled "
    "pixels of all test splits that the run predicted; unseen: a texel that no training ray met. Texels are up to 32 "
    "x 32 cells of an object's atlas, training rays are those through pixel centres (eval/analyses/coverage.py).",
    "Of runs that differ in their seed alone: means of squared errors over the seeds.",
)


@dataclass(frozen=True, kw_only=True)
class Bin:
    """The pixels of a run with similar training coverage."""

    low: float
    high: float
    """Exclusive."""
    mean: float
    """Mean of the pixels' angles or views."""
    pixels: int
    mse: float
    """Mean squared error over pixels and channels, levels of 255 squared."""

    @property
    def psnr_db(self) -> float:
        return decibels(self.mse)


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One run's error against angle and against the views that saw the texels, without empty bins."""

    by_angle: tuple[Bin, ...]
    by_views: tuple[Bin, ...]
    unseen: Bin | None
    """Pixels with a visible layer that training never saw; they are not in any other bin."""
    db_per_10deg: float | None
    """See `slope_db_per_10deg`."""


def make_curve(
    runs: Mapping[Split, Run], truths: dict[Split, Truth], coverage: dict[Split, tuple[PixelCoverage, ...]]
) -> Curve:
    """The curve of a run over the test splits in `coverage`, all of which it predicted.

    Args:
        runs: by split, the run or its predictions of a variant.
    """
    angles, views, errors = [], [], []
    for split, covered in coverage.items():
        for view, pixels in enumerate(covered):
            difference = read_prediction(runs[split], split, view).astype(np.float64) - truths[split].images[view]
            errors.append(np.square(difference).reshape(-1, 3)[pixels.pixel].mean(axis=1))
            angles.append(pixels.angle_deg)
            views.append(pixels.views)
    return curve_of(np.concatenate(angles), np.concatenate(views), np.concatenate(errors))


def pool_seeds(runs: Sequence[RunScores], curves: Mapping[str, Curve]) -> dict[str, Curve]:
    """Curves by the run's name, with one for all runs that differ in their seed alone and predicted the same pixels."""
    pooled: dict[str, Curve] = {}
    for name, found in by_group(runs, {run: (run, curve) for run, curve in curves.items()}).items():
        pixels = {tuple((part.low, part.pixels) for part in curve.by_angle) for _, curve in found}
        pooled |= {name: _pooled_curve([curve for _, curve in found])} if len(pixels) == 1 else dict(found)
    return pooled


def curve_of(
    angle_deg: Float[np.ndarray, " pixel"], views: Int[np.ndarray, " pixel"], squared_error: Float[np.ndarray, " pixel"]
) -> Curve:
    """The curve of some pixels.

    Args:
        angle_deg: as in PixelCoverage; inf without training coverage.
        squared_error: mean over channels, levels of 255 squared.
    """
    is_known = np.isfinite(angle_deg)
    by_angle = _bins(angle_deg[is_known], squared_error[is_known], ANGLE_EDGES)
    unseen = None
    if not is_known.all():
        mse = float(squared_error[~is_known].mean())
        unseen = Bin(low=180, high=math.inf, mean=math.inf, pixels=int((~is_known).sum()), mse=mse)
    return Curve(
        by_angle=by_angle,
        by_views=_bins(views[is_known].astype(np.float64), squared_error[is_known], VIEWS_EDGES),
        unseen=unseen,
        db_per_10deg=slope_db_per_10deg(by_angle),
    )


def slope_db_per_10deg(by_angle: tuple[Bin, ...]) -> float | None:
    """How many dB a run gains (if negative: loses) when test rays are 10 degrees farther from training rays.

    10 s of the line y = a + s x that minimises sum_b n_b (y_b - a - s x_b)^2 over the bins with at least 100 pixels and
    some error: n_b pixels, x_b their mean angle in degrees, y_b = 10 log10(255^2 / MSE_b) from their pooled error. None
    with fewer than two such bins.
    """
    bins = [part for part in by_angle if part.pixels >= MIN_PIXELS and part.mse > 0]
    if len(bins) < 2:
        return None
    n, x, y = np.array([(part.pixels, part.mean, part.psnr_db) for part in bins]).T
    x_mean, y_mean = np.average(x, weights=n), np.average(y, weights=n)
    return float(10 * np.sum(n * (x - x_mean) * (y - y_mean)) / np.sum(n * (x - x_mean) ** 2))


def curve_grid(title: str, curves: dict[str, Curve]) -> Grid:
    """The table of a scene's curves by the run's name: slopes and PSNR by angle."""
    columns = [
        Column(group="run", is_number=False),
        Column(group="slope dB/10°"),
        *(Column(group=f"{low}–{high}°" if high < 180 else f"over {low}°") for low, high in PRINTED_ANGLES),  # noqa: RUF001
        Column(group="unseen"),
    ]
    rows = [
        (
            name,
            format_number(curve.db_per_10deg, 2),
            *(format_number(None if math.isnan(mse) else decibels(mse), 2) for _, mse in _printed_columns(curve)),
        )
        for name, curve in curves.items()
    ]
    # Runs that predicted the same splits have the same pixels; the last row is for the run with most pixels.
    counts = max(([pixels for pixels, _ in _printed_columns(curve)] for curve in curves.values()), key=sum)
    shares = [f"{100 * count / max(sum(counts), 1):.1f} %" for count in counts]
    return Grid(
        title=f"{title}: PSNR dB by angle to the nearest training ray",
        columns=tuple(columns),
        rows=(*rows, ("share of pixels", MISSING, *shares)),
        last_row_apart=True,
        notes=CURVE_NOTES,
        is_detail=True,
    )


def _bins(
    values: Float[np.ndarray, " pixel"], squared_error: Float[np.ndarray, " pixel"], edges: tuple[int, ...]
) -> tuple[Bin, ...]:
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    pixels = np.bincount(place, minlength=len(edges) - 1)
    value_sum = np.bincount(place, weights=values, minlength=len(edges) - 1)
    error_sum = np.bincount(place, weights=squared_error, minlength=len(edges) - 1)
    return tuple(
        Bin(
            low=edges[index],
            high=edges[index + 1],
            mean=float(value_sum[index] / pixels[index]),
            pixels=int(pixels[index]),
            mse=float(error_sum[index] / pixels[index]),
        )
        for index in np.flatnonzero(pixels)
    )


def _pooled_curve(curves: Sequence[Curve]) -> Curve:
    """The mean of curves over the same pixels: mean squared errors are averaged, bin by bin."""
    by_angle = _pooled([curve.by_angle for curve in curves])
    unseen = [(curve.unseen,) for curve in curves if curve.unseen is not None]
    return Curve(
        by_angle=by_angle,
        by_views=_pooled([curve.by_views for curve in curves]),
        unseen=_pooled(unseen)[0] if unseen else None,
        db_per_10deg=slope_db_per_10deg(by_angle),
    )


def _pooled(curves: Sequence[tuple[Bin, ...]]) -> tuple[Bin, ...]:
    return tuple(
        dataclasses.replace(parts[0], mse=math.fsum(part.mse for part in parts) / len(parts))
        for parts in zip(*curves, strict=True)
    )


def _printed_columns(curve: Curve) -> list[tuple[int, float]]:
    """Pixels and mean squared error (NaN without pixels) of each printed range of angles, then of the unseen ones."""
    ranges = [[part for part in curve.by_angle if low <= part.low < high] for low, high in PRINTED_ANGLES]
    ranges.append([] if curve.unseen is None else [curve.unseen])
    columns = []
    for bins in ranges:
        pixels = sum(part.pixels for part in bins)
        columns.append((pixels, sum(part.pixels * part.mse for part in bins) / pixels if pixels else math.nan))
    return columns
