"""Comparisons as tables: the paper's tables with our numbers, the proxy ladder, the ablation."""

from collections.abc import Sequence

from datagen.data.config import TEST_SPLITS
from datagen.disk.records import Json
from eval.analyses.proxy_error import ProxyError, proxy_error
from eval.papers.comparisons import LADDER, Comparison, Entry, Line, differences, find_entries
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

PSNR = tuple(Column(group="PSNR dB ↑", split=split) for split in TEST_SPLITS)
WRAPPED = tuple(Column(group="wrapped (authors' script)", split=split) for split in TEST_SPLITS)
DROP = Column(group="drop dB ↓")


def spread_cell(value: Spread, decimals: int = 2) -> str:
    """`30.41 ± 0.12`, without spaces; the mean alone of one seed."""
    mean = format_number(value.mean, decimals)
    return mean if value.deviation is None else f"{mean}±{format_number(value.deviation, decimals)}"


def comparison_grid(comparison: Comparison, scene: SceneScores) -> Grid:
    """The runs of a scene in a comparison's lines, with what the paper printed; a line without runs says so."""
    parts = find_entries(comparison, group_seeds(scene.runs))
    rows = [row for part in parts for row in map(_entry_row, part)]
    filled = {entry.line.title for part in parts for entry in part}
    rows += [_empty_row(line) for line in comparison.lines if line.title not in filled]
    return Grid(
        title=f"{scene.title}: {comparison.title}",
        columns=(
            Column(group="", is_number=False),
            Column(group="run", is_number=False),
            Column(group="seeds"),
            *PSNR,
            DROP,
            *WRAPPED,
            *(Column(group="published (the paper)", split=split) for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=(*comparison.notes, WRAPPED_NOTE, PUBLISHED_NOTE, *_data_note(scene)),
    )


def find_ladder(scene: SceneScores) -> list[tuple[Entry, ProxyError]]:
    """The runs of the proxy ladder, method by method, the geometry nearest to the truth first.

    Raises:
        HyalineError: the proxies of a run are not there any more.
    """
    entries = [entry for part in find_entries(LADDER, group_seeds(scene.runs)) for entry in part]
    with_errors = [(entry, proxy_error(scene.dataset, entry.group.first.geometry or "")) for entry in entries]
    return sorted(with_errors, key=lambda pair: (LADDER.lines.index(pair[0].line), pair[1].mean_mm))


def ladder_grid(scene: SceneScores) -> Grid:
    """Each method on each geometry, and how far that is from the truth."""
    rows = []
    for entry, error in find_ladder(scene):
        group = entry.group
        rows.append(
            (
                entry.line.title,
                group.first.geometry or MISSING,
                str(len(group.runs)),
                f"{error.mean_mm:.2f}",
                f"{error.max_mm:.1f}",
                *_scores(group),
            )
        )
    empty = [line for line in LADDER.lines if line.title not in {row[0] for row in rows}]
    rows += [(line.title, NOT_RUN, *[MISSING] * 8) for line in empty]
    columns = [
        Column(group="method", is_number=False),
        Column(group="geometry", is_number=False),
        Column(group="seeds"),
        Column(group="mean distance mm"),
        Column(group="max distance mm"),
        *PSNR,
        DROP,
        *WRAPPED,
    ]
    return Grid(
        title=f"{scene.title}: {LADDER.title}",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(
            "Mean distance: from points on an object's proxy to its true surface, then the mean over objects; max: of "
            "any object.",
            WRAPPED_NOTE,
            *_data_note(scene),
        ),
    )


def ablation_grid(line: Line, scene: SceneScores) -> Grid:
    """What each choice is worth: beside a base, the runs that differ from it in a choice or two."""
    groups = [group for group in group_seeds(scene.runs) if line.fits(group.first) and group.first.config]
    base, others = _base_of(groups)
    rows = []
    if base is not None:
        rows.append(("the base", base.name, str(len(base.runs)), *_scores(base), MISSING, MISSING))
        for group in others:
            changed = "; ".join(
                f"{key}: {_text(before)} → {_text(after)}"
                for key, (before, after) in differences(base.first, group.first).items()
            )
            changes = [_difference(group, base, place) for place in range(len(TEST_SPLITS))]
            rows.append((changed, group.name, str(len(group.runs)), *_scores(group), *changes))
    else:
        rows.append((NOT_RUN, *[MISSING] * 9))
    return Grid(
        title=f"{scene.title}: what each choice of {line.title} is worth",
        columns=(
            Column(group="changed", is_number=False),
            Column(group="run", is_number=False),
            Column(group="seeds"),
            *PSNR,
            DROP,
            *WRAPPED,
            *(Column(group="change dB", split=split) for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=(WRAPPED_NOTE, *_data_note(scene)),
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


def _entry_row(entry: Entry) -> tuple[str, ...]:
    group = entry.group
    return (entry.line.title, group.name, str(len(group.runs)), *_scores(group), *_published(entry.line.published))


def _empty_row(line: Line) -> tuple[str, ...]:
    return (line.title, NOT_RUN, MISSING, *[MISSING] * 5, *_published(line.published))


def _scores(group: SeedGroup) -> tuple[str, ...]:
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


def _data_note(scene: SceneScores) -> tuple[str, ...]:
    return (f"Data: {scene.title}, dataset seal {scene.dataset.seal[:12]}.",)
