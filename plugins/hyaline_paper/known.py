"""A table that the paper lacks: what is known of the glass against what is reached."""

from datagen.data.config import TEST_SPLITS
from datagen.data.geometries import NO_GEOMETRY
from datagen.data.paths import TRUTH, is_fitted
from eval.score.runs import Run
from eval.score.scores import SceneScores, SeedGroup, group_seeds
from eval.tables.grids import MISSING, Column, Grid
from eval.tables.plugins import Table
from hyaline_paper.comparisons import NOT_RUN, Line, cpu_minutes_cell, data_note, spread_cell

FITTED_MATERIALS, FITTED_HULL = "fitted-materials", "fitted-hull"
"""Geometries of `model fit`: true shapes with materials found, and hulls as solid glass."""

KNOWLEDGE = (
    "everything",
    "materials unknown",
    "shapes from masks",
    "shapes, materials from masks",
    "pictures alone",
)
"""What a run knows of the glass, beside pictures and cameras; from most to least."""

USUAL = (
    *(Line(title="", method=method, flags={}, geometry=None) for method in ("light-path", "paper-best", "paper")),
    Line(title="", method="deepvoxels", geometry=NO_GEOMETRY),
)
"""The methods that are compared, as they are by default; other methods count if they know no geometry."""


def known_to(run: Run) -> str | None:
    """One of `KNOWLEDGE`; None for runs that are not compared: other settings, and proxies made of the truth."""
    if run.record.geometry != NO_GEOMETRY and not any(line.fits(run) for line in USUAL):
        return None
    return knowledge_of(run)


def knowledge_of(run: Run) -> str | None:
    """What a run of any method was told, by its record: one of `KNOWLEDGE`; None for proxies made of the truth."""
    told, shapes, hulls, fitted, pictures = KNOWLEDGE
    geometry = run.record.geometry or ""
    if geometry == NO_GEOMETRY:
        return pictures
    if geometry == TRUTH:
        return told if run.record.method == "light-path" else shapes
    if not is_fitted(geometry):
        return None
    if run.dataset.imported is not None:
        return pictures
    if any(item.is_glass for item in run.dataset.objects if item.name in (run.record.told or ())):
        return told if run.record.method == "light-path" else shapes  # Some glass is the true one.
    return {FITTED_MATERIALS: shapes, FITTED_HULL: hulls}.get(geometry, fitted)


def known_grid(scene: SceneScores) -> Grid:
    """Runs by what they were told, with their scores and what training took."""
    groups = group_seeds(scene.runs)
    rows: list[tuple[str, ...]] = []
    for known in KNOWLEDGE:
        found = [group for group in groups if known_to(group.first) == known]
        rows += [(known, *_cells(group)) for group in found] or [(known, NOT_RUN, *[MISSING] * 5)]
    return Grid(
        title=f"{scene.title}: what is known against what is reached",
        columns=(
            Column(group="known", is_number=False),
            Column(group="run", is_number=False),
            Column(group="geometry", is_number=False),
            Column(group="seeds"),
            *(Column(group="PSNR dB ↑", split=split) for split in TEST_SPLITS),
            Column(group="CPU min"),
        ),
        rows=tuple(rows),
        notes=(
            "Pictures and cameras are known to all. Shapes from masks: hulls as solid glass. Pictures alone: imported "
            "datasets, and methods without geometry. CPU min: processor minutes of training, counted with `model train "
            "--costs`, without `model fit`. ±: sample standard deviation over seeds.",
            data_note(scene),
        ),
    )


def _cells(group: SeedGroup) -> tuple[str, ...]:
    psnr = (spread_cell(group.score("psnr_db", split)) for split in TEST_SPLITS)
    return (group.name, group.first.record.geometry or MISSING, str(len(group.runs)), *psnr, cpu_minutes_cell(group))


KNOWN = Table(
    shows=lambda run: known_to(run) is not None,
    grids=lambda scenes, _: [known_grid(scene) for scene in scenes],
    is_swept=False,
)
