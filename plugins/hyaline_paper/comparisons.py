"""Comparisons: runs found by their records, not by their names, and the paper's tables and ours that print them."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

from datagen.data.config import TEST_SPLITS
from datagen.data.geometries import NO_GEOMETRY
from datagen.data.paths import TRUTH
from datagen.disk.records import Json, dump_json
from eval.score.runs import Run, read_costs
from eval.score.scores import SceneScores, SeedGroup, Spread, group_seeds, spread
from eval.tables.grids import MISSING, Column, Grid, format_number
from eval.tables.plugins import Table

FREE_FLAGS = ("geometry", "seed", "steps", "batch", "updates", "lr", "texture-lr", "lr-decay", "hidden", "texture-size")
FREE_FLAGS += ("vgg-weights",)
"""Runs of one line may differ in these: what they learn from and by, for how long, and how large they are."""

LOSSES = {"none": " (L1 alone)", "random": " (L1, random VGG16)"}
"""What tells runs without the paper's loss from others, by their weights of VGG16."""

Published = tuple[float, float]
"""PSNR in dB, interpolating and extrapolating."""
NO_EXTRINSICS, VIEW_VECTOR, SPHERICAL_HARMONICS, DNR = (33.09, 32.96), (33.19, 32.99), (33.80, 32.52), (33.52, 30.86)
PUBLISHED: tuple[Published, ...] = (NO_EXTRINSICS, VIEW_VECTOR, SPHERICAL_HARMONICS, DNR)
"""Source: the paper's Tables 1 and 2."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """One line of a comparison: what a run must be to belong there."""

    title: str
    method: str
    flags: Mapping[str, str] | None = None
    """The flags of `model train METHOD` that it was trained with, without dashes, beside `FREE_FLAGS`; None: any."""
    geometry: str = TRUTH
    published: Published | None = None
    """What the paper printed for it."""

    def fits(self, run: Run) -> bool:
        """True if the run belongs in this line."""
        return (
            run.record.method == self.method
            and self.geometry == run.record.geometry
            and (self.flags is None or (run.record.flags is not None and _flags(run, FREE_FLAGS) == self.flags))
        )


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One of the paper's tables, or one that it should have had."""

    title: str
    lines: tuple[Line, ...]
    varied: str | None = None
    """The only flag in which runs of one comparison may differ; None: they may differ in all, as methods do."""
    notes: tuple[str, ...] = ()


NOT_RUN = "not run"

WRAPPED_NOTE = (
    "Wrapped (authors' script): squared errors modulo 256, as the script that the paper's authors released counts "
    "them. This is not a PSNR; compare it only with the paper's own numbers. ±: sample standard deviation over seeds."
)

PUBLISHED_NOTE = (
    "Published: on other scenes, and most likely the wrapped PSNR; if anything, compare it with that column."
)

SCORES = (
    *(Column(group="PSNR dB ↑", split=split) for split in TEST_SPLITS),
    Column(group="drop dB ↓"),
    *(Column(group="wrapped (authors' script)", split=split) for split in TEST_SPLITS),
    Column(group="CPU min"),
)
"""The columns of `score_cells`."""


class Entry(NamedTuple):
    """A group of runs in its line."""

    line: Line
    group: SeedGroup


def find_entries(comparison: Comparison, groups: Sequence[SeedGroup]) -> list[list[Entry]]:
    """Runs that may be compared: alike but for the flag that the comparison varies; each part in the lines' order.

    Parts with a single line are left out where others have more: there is nothing to compare them with.
    """
    parts: dict[bytes, list[Entry]] = {}
    for line in comparison.lines:
        for group in groups:
            if line.fits(group.first):
                parts.setdefault(_same(group.first, comparison.varied), []).append(Entry(line=line, group=group))
    variety = {key: len({entry.line.title for entry in part}) for key, part in parts.items()}
    most = max(variety.values(), default=0)
    kept = [key for key in parts if variety[key] > 1 or most == 1]
    return [parts[key] for key in sorted(kept, key=lambda key: -variety[key])]


def _same(run: Run, varied: str | None) -> bytes:
    """What two runs must share to be compared."""
    if varied is None:
        # Who knows cameras alone is compared with those who know the truth.
        return dump_json(TRUTH if run.record.geometry == NO_GEOMETRY else run.record.geometry)
    return dump_json([run.record.method, cast(Json, _flags(run, ("seed", varied)))])


def _flags(run: Run, besides: Collection[str]) -> dict[str, str]:
    """The flags that a run was trained with, and their values, besides some."""
    return {flag: value for flag, value in (run.record.flags or {}).items() if flag not in besides}


# Tables of them


def loss_mark(group: SeedGroup) -> str:
    """What follows the name of runs of the paper's methods that lack its loss; empty for others."""
    record = group.first.record
    terms = (record.config or {}).get("loss")
    if record.method not in ("paper", "mlp-first") or not isinstance(terms, dict):
        return ""
    return LOSSES.get(str(terms.get("vgg_weights")), "")


def spread_cell(value: Spread, decimals: int = 2) -> str:
    """`30.41 ± 0.12`, without spaces; the mean alone of one seed."""
    mean = format_number(value.mean, decimals)
    return mean if value.deviation is None else f"{mean}±{format_number(value.deviation, decimals)}"


def comparison_table(comparison: Comparison) -> Table:
    """A comparison as a table a dataset."""
    return Table(
        shows=lambda run: any(line.fits(run) for line in comparison.lines),
        grids=lambda scenes, _: [comparison_grid(comparison, scene) for scene in scenes],
    )


def comparison_grid(comparison: Comparison, scene: SceneScores) -> Grid:
    """The runs of a scene in a comparison's lines, with what the paper printed; a line without runs is marked."""
    parts = find_entries(comparison, group_seeds(scene.runs))
    entries = [entry for part in parts for entry in part]
    rows = [
        (f"{line.title}{loss_mark(group)}", group.name, str(len(group.runs)), *score_cells(group), *_published(line))
        for line, group in entries
    ]
    empty = [line for line in comparison.lines if line.title not in {entry.line.title for entry in entries}]
    rows += [(line.title, NOT_RUN, *[MISSING] * 7, *_published(line)) for line in empty]
    return Grid(
        title=f"{scene.title}: {comparison.title}",
        columns=(
            Column(group="", is_number=False),
            Column(group="run", is_number=False),
            Column(group="seeds"),
            *SCORES,
            *(Column(group="published (the paper)", split=split) for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=(*comparison.notes, WRAPPED_NOTE, PUBLISHED_NOTE, data_note(scene)),
    )


def score_cells(group: SeedGroup) -> tuple[str, ...]:
    """PSNR on both splits, their drop, the wrapped PSNR on both; CPU minutes, where `--costs` counted them."""
    near, far = (spread_cell(group.score("psnr_db", split)) for split in TEST_SPLITS)
    wrapped = (spread_cell(group.score("psnr_uint8_wrap_db", split)) for split in TEST_SPLITS)
    costs = [read_costs(scores.run.folder).get("cpu_seconds") for scores in group.runs]
    minutes = spread([None if seconds is None else seconds / 60 for seconds in costs])
    return (near, far, spread_cell(group.drop_db), *wrapped, spread_cell(minutes))


def _published(line: Line) -> list[str]:
    return [MISSING] * 2 if line.published is None else [f"{score:.2f}" for score in line.published]


def data_note(scene: SceneScores) -> str:
    return f"Data: {scene.title}, dataset seal {scene.dataset.seal[:12]}."


# The paper's tables, and those that it should have had

OURS = Line(title="paper", method="paper", flags={}, published=VIEW_VECTOR)
BEST = Line(title="paper-best", method="paper-best", flags={})
DEEP_VOXELS = Line(title="DeepVoxels, small", method="deepvoxels", geometry=NO_GEOMETRY)
BEST_NOTE = "paper-best: the paper's idea, tuned: more rays, textures and steps."
LOSS_NOTE = "L1 alone: without the paper's perceptual loss. Unless a run's name says so, none has its 200 passes."

TABLE1 = comparison_table(
    Comparison(
        title="Table 1, what each layer knows of the camera",
        lines=(
            Line(title="no extrinsics", method="paper", flags={"extrinsics": "none"}, published=NO_EXTRINSICS),
            dataclasses.replace(OURS, title="view vector"),
            Line(
                title="spherical harmonics",
                method="paper",
                flags={"extrinsics": "sh"},
                published=SPHERICAL_HARMONICS,
            ),
        ),
        varied="extrinsics",
        notes=(LOSS_NOTE,),
    )
)
TABLE2 = comparison_table(
    Comparison(
        title="Table 2, Deferred Neural Rendering against the paper",
        lines=(
            Line(title="DNR", method="dnr", published=DNR),
            OURS,
            BEST,
            Line(title="DNR, as the paper ran it", method="dnr-authors"),
            Line(title="the network of its code (L1 alone)", method="authors-code"),
            DEEP_VOXELS,
        ),
        notes=(
            "The paper names no number for DeepVoxels; which of its runs fed Table 2 is not known. The scripts of its "
            "code ask for a perceptual loss, 14 layers and 200 passes, none of which the network of its code has here.",
            LOSS_NOTE,
            BEST_NOTE,
        ),
    )
)
SQUARE = comparison_table(
    Comparison(
        title="What earns the gain, layers or the per-pixel network",
        lines=(
            Line(title="U-Net, first layer (DNR)", method="dnr", published=DNR),
            Line(title="U-Net, all layers", method="dnr-layers"),
            Line(title="per pixel, first layer", method="mlp-first"),
            dataclasses.replace(OURS, title="per pixel, all layers"),
            dataclasses.replace(BEST, title="per pixel, all layers, tuned"),
        ),
        notes=(LOSS_NOTE, BEST_NOTE),
    )
)
