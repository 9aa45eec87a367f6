"""Comparisons as tables: the paper's tables with our numbers, and the ablation."""

from collections.abc import Sequence

from datagen.data.config import TEST_SPLITS
from datagen.disk.records import Json
from eval.papers.comparisons import Comparison, Line, differences, find_entries
from eval.papers.published import PublishedRow
from eval.score.scores import SceneScores
from eval.score.seeds import SeedGroup, Spread, group_seeds
from eval.tables.grids import MISSING, Column, Grid, format_number

NOT_RUN = "not run"

WRAPPED_NOTE = (
    "Wrapped (authors' script): squared errors modulo 256, as the script that the paper's authors released counts "
    "them. No PSNR; only to be set beside the paper's own numbers. ±: sample standard deviation over seeds."
)

PUBLISHED_NOTE = (
    "Published: on other scenes, and most likely the wrapped PSNR; if anything, compare it with that column."
)

MAX_CHANGES = 2
"""Choices in which a run of the ablation may differ from the one that the others are compared with."""

SCORES = (
    *(Column(group="PSNR dB ↑", split=split) for split in TEST_SPLITS),
    Column(group="drop dB ↓"),
    *(Column(group="wrapped (authors' script)", split=split) for split in TEST_SPLITS),
)
"""The columns of `score_cells`."""


def spread_cell(value: Spread, decimals: int = 2) -> str:
    """`30.41 ± 0.12`, without spaces; the mean alone of one seed."""
    mean = format_number(value.mean, decimals)
    return mean if value.deviation is None else f"{mean}±{format_number(value.deviation, decimals)}"


def comparison_grid(comparison: Comparison, scene: SceneScores) -> Grid:
    """The runs of a scene in a comparison's lines, with what the paper printed; a line without runs says so."""
    parts = find_entries(comparison, group_seeds(scene.runs))
    entries = [entry for part in parts for entry in part]
    rows = [(entry.line.title, *_run_cells(entry.group), *_published(entry.line.published)) for entry in entries]
    empty = [line for line in comparison.lines if line.title not in {entry.line.title for entry in entries}]
    rows += [(line.title, NOT_RUN, *[MISSING] * 6, *_published(line.published)) for line in empty]
    notes = (*comparison.notes, WRAPPED_NOTE, PUBLISHED_NOTE)
    return _grid(scene, comparison.title, rows, first="", last="published (the paper)", notes=notes)


def ablation_grid(line: Line, scene: SceneScores) -> Grid:
    """What each choice is worth: beside a base, the runs that differ from it in a choice or two."""
    groups = [group for group in group_seeds(scene.runs) if line.fits(group.first) and group.first.config]
    base, others = _base_of(groups)
    rows = []
    if base is None:
        rows.append((NOT_RUN, *[MISSING] * 9))
    else:
        rows.append(("the base", *_run_cells(base), MISSING, MISSING))
        for group in others:
            changed = "; ".join(
                f"{key}: {_text(before)} → {_text(after)}"
                for key, (before, after) in differences(base.first, group.first).items()
            )
            changes = [_difference(group, base, place) for place in range(len(TEST_SPLITS))]
            rows.append((changed, *_run_cells(group), *changes))
    title = f"what each choice of {line.title} is worth"
    return _grid(scene, title, rows, first="changed", last="change dB", notes=(WRAPPED_NOTE,))


def _grid(
    scene: SceneScores, title: str, rows: Sequence[tuple[str, ...]], *, first: str, last: str, notes: tuple[str, ...]
) -> Grid:
    """A table of runs with their scores, between a column before and one for each split behind them."""
    return Grid(
        title=f"{scene.title}: {title}",
        columns=(
            Column(group=first, is_number=False),
            Column(group="run", is_number=False),
            Column(group="seeds"),
            *SCORES,
            *(Column(group=last, split=split) for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=(*notes, data_note(scene)),
    )


def _base_of(groups: Sequence[SeedGroup]) -> tuple[SeedGroup | None, list[SeedGroup]]:
    """The group from which most others differ in one choice, of equals the one of the shortest name; its neighbours."""

    def near(group: SeedGroup, changes: int) -> list[SeedGroup]:
        return [
            other
            for other in groups
            if other is not group
            and other.first.geometry == group.first.geometry
            and len(differences(group.first, other.first)) <= changes
        ]

    if not groups:
        return None, []
    base = min(groups, key=lambda group: (-len(near(group, 1)), len(group.name), group.name))
    return base, sorted(near(base, MAX_CHANGES), key=lambda group: group.name)


def _run_cells(group: SeedGroup) -> tuple[str, ...]:
    return (group.name, str(len(group.runs)), *score_cells(group))


def score_cells(group: SeedGroup) -> tuple[str, ...]:
    """PSNR on both splits, their drop, the wrapped PSNR on both."""
    near, far = (spread_cell(group.score("psnr_db", split)) for split in TEST_SPLITS)
    wrapped = (spread_cell(group.score("psnr_uint8_wrap_db", split)) for split in TEST_SPLITS)
    return (near, far, spread_cell(group.drop_db), *wrapped)


def _difference(group: SeedGroup, base: SeedGroup, place: int) -> str:
    one, other = (each.score("psnr_db", TEST_SPLITS[place]).mean for each in (group, base))
    return MISSING if one is None or other is None else f"{one - other:+.2f}"


def _published(row: PublishedRow | None) -> tuple[str, str]:
    return (MISSING, MISSING) if row is None else (f"{row.interpolating_db:.2f}", f"{row.extrapolating_db:.2f}")


def _text(value: Json) -> str:
    return MISSING if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def data_note(scene: SceneScores) -> str:
    return f"Data: {scene.title}, dataset seal {scene.dataset.seal[:12]}."
