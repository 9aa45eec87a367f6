"""The page of a fit: what was found against the truth, sections, distances, the search, and its pictures."""

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset
from datagen.data.images import read_png
from datagen.data.meshes import Mesh
from datagen.data.paths import TRUTH
from datagen.pages.charts import STYLE, Line, line_chart, new_figure, page_figure
from datagen.pages.html import Markup, Part, anchor, join, prose, section, tag
from datagen.pages.pictures import Gallery
from eval.analyses.fits import (
    Fit,
    FitObject,
    Measured,
    fitted_meshes,
    frame_of,
    heat_map,
    knows_truth,
    meshes_by_name,
    section_of,
    surface_distances,
)
from eval.page.run_page import Compared, prediction_panel, store_view, truth_panels
from eval.score.scores import SceneScores
from eval.tables.grids import MISSING, Column, Grid
from eval.tables.looks import html_table

LENGTHS = ("wall", "floor", "foot", "level")
"""Numbers in metres; the page shows millimetres."""
TITLES = {"ior": "index of refraction"}
MARGINS = {"left": 0.14, "right": 0.98, "top": 0.98, "bottom": 0.13}
CELLS = 3
"""Cells of the grid that the page shows."""
NEAREST, FARTHEST = 5e-4, 5e-3
"""Distances in metres at which the brightest colour of heat maps begins, at least and at most."""


def fit_anchor(scene: SceneScores, fit: Fit) -> str:
    """The anchor of a fit on the page."""
    return anchor("fit", scene.title, fit.folder.name)


def fit_page(
    scene: SceneScores, fit: Fit, measured: Sequence[Measured], compared: Iterable[Compared], gallery: Gallery
) -> Markup:
    """Everything about one fit.

    Args:
        measured: how each object compares with the truth.
        compared: what runs predicted; those on the truth, on this fit and on hulls are shown side by side.
    """
    place = fit_anchor(scene, fit)
    note = f"On {scene.title}. Runs on what was found: `--geometry {fit.geometry}`."
    if not knows_truth(scene.dataset):
        note += " The true glass is unknown."
    parts: list[Part] = [
        tag("p", prose(note), class_="note"),
        html_table(numbers_grid(fit, measured)),
        html_table(shapes_grid(fit, measured)) if any(item.errors for item in measured) else None,
        tag("h3", "Sections through the axis"),
        tag("div", *sections(fit, scene.dataset), class_="charts"),
        *_heat(gallery, fit, scene.dataset),
        tag("h3", "The search"),
        tag("div", *histories(fit), class_="charts"),
        html_table(cells_grid(fit)) if any(item.grid for item in fit.objects) else None,
        *_views(gallery, scene, fit, compared),
        *_pictures(gallery, fit),
    ]
    return tag("div", section(fit.folder.name, *parts, id_=place), class_="page", id=f"{place}-page")


def numbers_grid(fit: Fit, measured: Sequence[Measured]) -> Grid:
    """Every number that was found, with its interval and the true one."""
    rows = []
    for item, found in zip(fit.objects, measured, strict=True):
        for name, number in item.numbers.items():
            if number is not None:
                value, low, high = (_in_unit(name, number.get(key)) for key in ("value", "low", "high"))
                true = found.true.get(name)
                words = "unknown" if true is None else _in_unit(name, true)
                off = MISSING if true is None or "value" not in number else _in_unit(name, number["value"] - true)
                rows.append((item.name, item.kind, _title(name), value, f"{low} to {high}", words, off))
    texts = ("object", "kind", "number")
    return Grid(
        title="What was found",
        columns=(
            *(Column(group=text, is_number=False) for text in texts),
            *(Column(group=text) for text in ("found", "between", "true", "off by")),
        ),
        rows=tuple(rows),
        notes=("True walls: the median thickness, measured from outside along the normal.",),
    )


def shapes_grid(fit: Fit, measured: Sequence[Measured]) -> Grid:
    """The distance of every surface from the true one, before (the hull of masks) and after."""
    rows = []
    for item, found in zip(fit.objects, measured, strict=True):
        for when, errors in (("hull", found.hull_errors), ("fitted", found.errors)):
            if errors is not None:
                lengths = (errors.chamfer, errors.mean_distance, errors.wall)
                chamfer, mean, wall = (_millimetres(length) for length in lengths)
                rows.append((item.name, when, chamfer, mean, f"{errors.normal_deg:.1f}", wall))
    return Grid(
        title="Shapes against the true ones",
        columns=(
            *(Column(group=text, is_number=False) for text in ("object", "shape")),
            *(Column(group=f"{text} ↓") for text in ("Chamfer mm", "mean mm", "normals °", "wall mm")),
        ),
        rows=tuple(rows),
        notes=(
            "Chamfer: mean distance in both directions. Mean: of the whole surface, insides too. Normals, wall: "
            "median errors.",
        ),
    )


def cells_grid(fit: Fit) -> Grid:
    """The best cells of each object's grid, with their loss relative to the best."""
    rows = []
    for item in fit.objects:
        for cell in item.grid[:CELLS]:
            best = item.grid[0].get("loss", math.nan)
            ratio = cell.get("loss", math.nan) / best if best else math.nan
            wall = cell.get("wall")
            # Floors of cells are in parts of the height.
            parts = [f"{cell[name]:.3g}" if name in cell else MISSING for name in ("floor", "corner")]
            rows.append((item.name, _millimetres(wall) if wall else "solid", *parts, f"{ratio:.2f}"))
    columns = ("wall mm", "floor (of height)", "corner", "loss over the best")
    return Grid(
        title="The best cells of the grid",
        columns=(Column(group="object", is_number=False), *(Column(group=text) for text in columns)),
        rows=tuple(rows),
    )


def histories(fit: Fit) -> list[Markup]:
    """Each number over the steps of the search, a line an object."""
    names = dict.fromkeys(name for item in fit.objects for step in item.history for name in step)
    charts = []
    for name in names:
        scale = 1000 if name in LENGTHS else 1
        lines = tuple(
            Line(
                name=item.name,
                points=tuple((step, scale * now.get(name, math.nan)) for step, now in enumerate(item.history)),
            )
            for item in fit.objects
            if any(name in now for now in item.history)
        )
        charts.append(line_chart(lines, title=f"{_title(name)} over the search", x_title="step", y_title=_title(name)))
    return charts


@functools.lru_cache(maxsize=16)  # The page is drawn again with fewer pictures until it is small enough.
def sections(fit: Fit, dataset: Dataset) -> tuple[Markup, ...]:
    """Each object cut through its axis: the truth, the hull, and what was found."""
    truths = meshes_by_name(dataset, TRUTH) if knows_truth(dataset) else {}
    meshes = fitted_meshes(dataset, fit)
    charts = []
    for item in fit.objects:
        mesh, hull = meshes[item.name]
        shown = {"truth": truths.get(item.name), "hull": hull, "fitted": mesh}
        shown = {name: shape for name, shape in shown.items() if shape is not None}
        if shown:
            charts.append(_section(item, shown))
    return tuple(charts)


def _section(item: FitObject, shapes: Mapping[str, Mesh]) -> Markup:
    import matplotlib as mpl

    frame = frame_of(item, next(iter(shapes.values())))
    with mpl.rc_context(STYLE):
        figure = new_figure(440, 440)
        axes = figure.subplots(gridspec_kw=MARGINS)
        for name, shape in shapes.items():
            cut = 1000 * section_of(shape, frame)
            breaks = np.full((len(cut), 1, 2), np.nan)
            x, y = np.concatenate([cut, breaks], axis=1).reshape(-1, 2).T
            axes.plot(x, y, label=name, marker="", linewidth=1.5)
        axes.set(xlabel="mm", ylabel="mm", aspect="equal", adjustable="datalim")
        return page_figure(figure, f"{item.name}, cut through its axis")


@dataclass(frozen=True, kw_only=True)
class _Heat:
    """An object's distances from the truth, as pictures from outside and cut open."""

    item: FitObject
    most: float
    """Metres at the brightest colour."""
    pictures: Mapping[str, np.ndarray]


@functools.lru_cache(maxsize=16)
def heat_maps(fit: Fit, dataset: Dataset) -> tuple[_Heat, ...]:
    """The objects whose truth is known, before and after."""
    truths = meshes_by_name(dataset, TRUTH) if knows_truth(dataset) else {}
    meshes = fitted_meshes(dataset, fit)
    maps = []
    for item in fit.objects:
        mesh, hull = meshes[item.name]
        if mesh is None or item.name not in truths:
            continue
        shapes = {"hull": hull, "fitted": mesh}
        far = {name: surface_distances(shape, truths[item.name]) for name, shape in shapes.items() if shape is not None}
        most = float(np.clip(np.quantile(far["fitted"][1], 0.95), NEAREST, FARTHEST))
        frame = frame_of(item, mesh)
        pictures = {
            f"{name}, {how}": heat_map(shape, far[name], frame, most, is_cut=how != "outside")
            for name, shape in shapes.items()
            if shape is not None
            for how in ("outside", "cut open")
        }
        maps.append(_Heat(item=item, most=most, pictures=pictures))
    return tuple(maps)


def _heat(gallery: Gallery, fit: Fit, dataset: Dataset) -> list[Part]:
    parts: list[Part] = []
    for heat in heat_maps(fit, dataset):
        pictures = {
            f"{heat.item.name}: {name}": functools.partial(np.asarray, image) for name, image in heat.pictures.items()
        }
        scale = (
            f"{heat.item.name}: dark is on the true surface, bright {1000 * heat.most:.1f} mm and more away from it."
        )
        parts += [tag("p", scale, class_="note"), _sheet(gallery, fit, pictures)]
    return [tag("h3", "Distance from the true surface"), *parts] if parts else []


def _views(gallery: Gallery, scene: SceneScores, fit: Fit, compared: Iterable[Compared]) -> list[Part]:
    """The middle view of each test split: the truth, and runs on true, fitted and hull glass."""
    found = [item for item in compared if _belongs(item, fit)]
    # Of several runs on a geometry (seeds, other settings), the one with the shortest name.
    names = {item.run.geometry: item.run.name for item in sorted(found, key=lambda item: -len(item.run.name))}
    shown = [item for item in found if item.run.name == names[item.run.geometry]]
    if not set(names) - {TRUTH}:
        return []
    rows: list[Part] = []
    for split in TEST_SPLITS:
        view = scene.dataset.config.split(split).views // 2
        panels = truth_panels(gallery, scene.dataset, split, view)
        panels += [
            prediction_panel(gallery, item, view)
            for item in shown
            if item.split == split and store_view(gallery, item, view)
        ]
        rows.append(tag("div", *panels, class_="sheet wide"))
    return [tag("h3", "With true, fitted and hull glass"), join(rows)]


def _belongs(item: Compared, fit: Fit) -> bool:
    geometry = item.run.geometry or ""
    is_light = item.run.method == "light-path" and item.dataset.variant is None
    return is_light and (geometry in (TRUTH, fit.geometry) or "hull" in geometry)


def _pictures(gallery: Gallery, fit: Fit) -> list[Part]:
    pictures = {name.removesuffix(".png"): functools.partial(read_png, fit.folder / name) for name in fit.pictures}
    return [tag("h3", "What each stage found"), _sheet(gallery, fit, pictures, class_="charts")] if pictures else []


def _sheet(
    gallery: Gallery, fit: Fit, pictures: Mapping[str, functools.partial[np.ndarray]], class_: str = "sheet wide"
) -> Markup:
    """Pictures with their names, as far as they fit."""
    figures = []
    for name, read in pictures.items():
        key = anchor("fit", fit.folder.as_posix(), name)
        if gallery.add(key, read):
            figures.append(tag("figure", gallery.show(key, label=name), tag("figcaption", name)))
    return tag("div", *figures, class_=class_)


def _title(name: str) -> str:
    title = TITLES.get(name, name.replace("_", " "))
    return f"{title} (mm)" if name in LENGTHS else title


def _in_unit(name: str, value: float | None) -> str:
    if value is None:
        return MISSING
    return _millimetres(value) if name in LENGTHS else f"{value:.3f}"


def _millimetres(metres: float | None) -> str:
    return MISSING if metres is None else f"{1000 * metres:.2f}"
