"""The contact sheets: truth, predictions and errors side by side, every pixel drawn as a square of pixels."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure

from datagen.data.config import TEST_SPLITS, Resolution, Split
from datagen.data.paths import view_name
from datagen.pages.charts import names_as_they_are
from eval.score.runs import read_prediction
from eval.score.scores import RunScores, SceneScores
from eval.score.seeds import group_seeds
from eval.tables.grids import psnr_text

DPI = 100
PANEL = 300
"""Least side of a panel in pixels; pictures are enlarged by a whole number to reach it."""
GAP, CAPTION, HEADING, MARGIN, SIDE = 14, 26, 64, 20, 44
"""Pixels: between columns, for a row's captions, for title and heads, at the edges, for the split's name."""

ERROR_LIMIT = 32
"""Levels of 255 at which the error's colours saturate: fixed, so that any two sheets can be compared."""

ERROR_TICKS = (0, 1, 4, 9, 16, 25, 32)


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One picture of a sheet with its caption; None stands for a split that was not predicted."""

    image: UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w"] | None
    caption: str = ""
    is_best: bool = False


@dataclass(frozen=True, kw_only=True)
class Row:
    """One view of a sheet."""

    split: Split
    panels: tuple[Panel, ...]


def contact_sheet(scene: SceneScores, scores: RunScores) -> bytes:
    """The PNG of one run: first, middle and last view of each split as truth, prediction and error."""
    rows = []
    for split, view in shown_views(scene):
        truth = scene.dataset.view(split, view).image
        panels = [Panel(image=truth, caption=f"view {view_name(view)}"), Panel(image=None), Panel(image=None)]
        if (values := scores.splits[split]) is not None:
            pred = read_prediction(scores.run, split, view)
            error = np.abs(pred.astype(np.float64) - truth).mean(axis=-1)
            panels[1] = Panel(image=pred, caption=psnr_text(values.images["psnr_db"][view]))
            panels[2] = Panel(image=error, caption=f"mean {error.mean():.1f}, largest {error.max():.0f}")
        rows.append(Row(split=split, panels=tuple(panels)))
    heads = ("truth", "prediction", "error, levels of 255")
    about = [text for text in (scores.run.method, scores.run.geometry) if text and text != scores.run.name]
    title = f"{scene.title}: {scores.run.name}" + (f" ({', '.join(about)})" if about else "")
    return draw_sheet(title, heads, rows, size=scene.dataset.config.resolution)


def comparison_sheet(scene: SceneScores, what: str) -> bytes:
    """The PNG of the same views as truth and every run's prediction; each row's best PSNR is bold.

    Args:
        scene: with the runs to show; of those that differ in their seed alone, the first is shown.
        what: that is, for the title.
    """
    runs = [group.runs[0] for group in group_seeds(scene.runs)]
    rows = []
    for split, view in shown_views(scene):
        values = [None if s is None else s.images["psnr_db"][view] for s in (run.splits[split] for run in runs)]
        best = max((value for value in values if value is not None), default=None)
        panels = [Panel(image=scene.dataset.view(split, view).image, caption=f"view {view_name(view)}")]
        for scores, value in zip(runs, values, strict=True):
            if value is None:
                panels.append(Panel(image=None))
            else:
                pred = read_prediction(scores.run, split, view)
                panels.append(Panel(image=pred, caption=psnr_text(value), is_best=value == best))
        rows.append(Row(split=split, panels=tuple(panels)))
    heads = ("truth", *(scores.run.name for scores in runs))
    return draw_sheet(f"{scene.title}: {what}", heads, rows, size=scene.dataset.config.resolution)


def shown_views(scene: SceneScores) -> list[tuple[Split, int]]:
    """First, middle and last view of each test split, fewer where a split has fewer."""
    shown: list[tuple[Split, int]] = []
    for split in TEST_SPLITS:
        last = scene.dataset.config.split(split).views - 1
        for view in sorted({0, (last + 1) // 2, last}):
            shown.append((split, view))
    return shown


def figure_png(figure: Figure) -> bytes:
    """The figure as a PNG that depends on nothing but the figure."""
    buffer = io.BytesIO()
    names_as_they_are(figure)
    # matplotlib would write its own version into the file.
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()


def draw_sheet(title: str, heads: Sequence[str], rows: Sequence[Row], *, size: Resolution) -> bytes:
    """Lays panels out in whole pixels, so that nearest-neighbour enlargement is exact."""
    scale = math.ceil(PANEL / size.shorter)
    high, wide = scale * size.height, scale * size.width
    has_error = any(panel.image is not None and panel.image.ndim == 2 for row in rows for panel in row.panels)
    bar = 70 if has_error else 0
    width = SIDE + len(heads) * (wide + GAP) - GAP + bar + MARGIN
    height = HEADING + len(rows) * (high + CAPTION) + MARGIN
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")

    def text(x: int, y: int, words: str, **style: Any) -> None:
        figure.text(x / width, 1 - y / height, words, **style)

    text(SIDE, 24, _fitting(title, width - SIDE), fontsize=14, weight="bold", va="center")
    for column, head in enumerate(heads):
        x = SIDE + column * (wide + GAP) + wide // 2
        text(x, HEADING - 10, _fitting(head, wide), fontsize=11, ha="center", va="center")
    for place, row in enumerate(rows):
        top = HEADING + place * (high + CAPTION)
        text(SIDE // 2, top + high // 2, row.split, fontsize=11, ha="center", va="center", rotation=90)
        for column, panel in enumerate(row.panels):
            left = SIDE + column * (wide + GAP)
            axes = figure.add_axes((left / width, 1 - (top + high) / height, wide / width, high / height))
            _fill(axes, panel)
            text(
                left + wide // 2,
                top + high + 11,
                panel.caption,
                fontsize=10,
                ha="center",
                va="center",
                weight="bold" if panel.is_best else "normal",
            )
    if has_error:
        left, extent = width - MARGIN - bar + 20, min(2 * high, height - HEADING - MARGIN - CAPTION)
        axes = figure.add_axes((left / width, 1 - (HEADING + extent) / height, 14 / width, extent / height))
        _color_bar(figure, axes)
    return figure_png(figure)


def _fill(axes: Axes, panel: Panel) -> None:
    axes.set_axis_off()
    axes.set(xticks=[], yticks=[])  # matplotlib makes them all the same, which is most of the time of a sheet.
    if panel.image is None:
        axes.text(0.5, 0.5, "no predictions", ha="center", va="center", color="0.5")
    elif panel.image.ndim == 3:
        axes.imshow(panel.image, interpolation="nearest", aspect="auto")
    else:
        norm = PowerNorm(0.5, vmin=0, vmax=ERROR_LIMIT, clip=True)
        axes.imshow(panel.image, interpolation="nearest", aspect="auto", norm=norm, cmap="inferno")


def _color_bar(figure: Figure, axes: Axes) -> None:
    """The scale of the error maps: square root, so that small errors show and large ones do not drown them."""
    colors = ScalarMappable(PowerNorm(0.5, vmin=0, vmax=ERROR_LIMIT), "inferno")
    bar = figure.colorbar(colors, cax=axes, ticks=list(ERROR_TICKS))
    bar.ax.set_yticklabels([*map(str, ERROR_TICKS[:-1]), f"≥ {ERROR_LIMIT}"])
    bar.ax.tick_params(labelsize=10)


def _fitting(words: str, width: int) -> str:
    """The words, cut in the middle where about 8 pixels a letter do not fit."""
    room = max(8, width // 8)
    return words if len(words) <= room else f"{words[: room - room // 2 - 1]}…{words[-(room // 2) :]}"
