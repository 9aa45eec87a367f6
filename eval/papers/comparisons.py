"""Comparisons: runs found by their records, not by their names, and the tables that they are printed in."""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.geometries import NO_GEOMETRY
from datagen.data.paths import TRUTH
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from eval.score.runs import Run, read_costs
from eval.score.scores import SceneScores
from eval.score.seeds import SeedGroup, Spread, group_seeds, spread
from eval.tables.grids import MISSING, SHORT_SPLITS, Column, Grid, format_number
from eval.tables.named import Table
from eval.tables.published import PublishedRow

FREE_FLAGS = ("geometry", "seed", "steps", "batch", "updates", "lr", "texture-lr", "lr-decay", "hidden", "texture-size")
"""Runs of one line may differ in these: what they learn from, for how long, and how large they are."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """One line of a comparison: what a run must be to belong there."""

    title: str
    method: str
    flags: Mapping[str, str] | None = None
    """The flags of `model train METHOD` that it was trained with, without dashes, beside `FREE_FLAGS`; None: any."""
    geometry: str | None = TRUTH
    """None takes any."""
    published: PublishedRow | None = None
    """What the paper printed for it."""

    def fits(self, run: Run) -> bool:
        """True if the run belongs in this line."""
        return (
            run.method == self.method
            and self.geometry in (None, run.geometry)
            and (self.flags is None or (run.flags is not None and _flags(run, FREE_FLAGS) == self.flags))
        )


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """Two lines whose difference a comparison is about; a verdict compares it with the paper's."""

    first: str
    """Title of a line."""
    second: str
    is_better: bool | None = None
    """The paper states in words that the first is better, or worse; None: it does not, or gives numbers."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One of the paper's tables, or one that it should have had."""

    title: str
    lines: tuple[Line, ...]
    contrasts: tuple[Contrast, ...] = ()
    varied: str | None = None
    """The only flag in which runs of one comparison may differ; None: they may differ in all, as methods do."""
    notes: tuple[str, ...] = ()


CONFIRMED, SIGN_ALONE, WITHIN_SPREAD = "confirmed", "the paper's sign, another size", "within the spread of seeds"
CONTRADICTED, MEASURED, NOT_RUN = "contradicted", "measured, the paper states none", "not run"
VERDICTS = (CONFIRMED, SIGN_ALONE, WITHIN_SPREAD, CONTRADICTED, MEASURED, NOT_RUN)
MANY_SEEDS = 3

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
)
"""The columns of `score_cells`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
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
    most = max((_variety(part) for part in parts.values()), default=0)
    kept = [part for part in parts.values() if _variety(part) > 1 or most == 1]
    return sorted(kept, key=lambda part: -_variety(part))


def _same(run: Run, varied: str | None) -> bytes:
    """What two runs must share to be compared."""
    if varied is None:
        # Who knows cameras alone is compared with those who know the truth.
        return dump_json(TRUTH if run.geometry == NO_GEOMETRY else run.geometry)
    return dump_json([run.method, cast(Json, _flags(run, ("seed", varied)))])


def _flags(run: Run, besides: Collection[str]) -> dict[str, str]:
    """The flags that a run was trained with, and their values, besides some."""
    flags: dict[str, str] = {}
    for word in run.flags or ():
        if word.startswith("--"):
            flags[word.removeprefix("--")] = ""
        elif flags:
            flags[list(flags)[-1]] = word
    return {flag: value for flag, value in flags.items() if flag not in besides}


def _variety(part: Sequence[Entry]) -> int:
    """How many different things a part compares."""
    return len({(entry.line.title, entry.group.first.geometry) for entry in part})


# Tables of them


def spread_cell(value: Spread, decimals: int = 2) -> str:
    """`30.41 ± 0.12`, without spaces; the mean alone of one seed."""
    mean = format_number(value.mean, decimals)
    return mean if value.deviation is None else f"{mean}±{format_number(value.deviation, decimals)}"


def comparison_table(comparison: Comparison) -> Table:
    """A comparison as a table a dataset, with a sheet of what its runs drew."""
    return Table(
        shows=lambda run: any(line.fits(run) for line in comparison.lines),
        grids=lambda scenes, _: [comparison_grid(comparison, scene) for scene in scenes],
        picture=partial(_sheet, comparison),
    )


def comparison_grid(comparison: Comparison, scene: SceneScores) -> Grid:
    """The runs of a scene in a comparison's lines, with what the paper printed; a line without runs is marked."""
    parts = find_entries(comparison, group_seeds(scene.runs))
    entries = [entry for part in parts for entry in part]
    rows = [(entry.line.title, *_run_cells(entry.group), *_published(entry.line.published)) for entry in entries]
    empty = [line for line in comparison.lines if line.title not in {entry.line.title for entry in entries}]
    rows += [(line.title, NOT_RUN, *[MISSING] * 7, *_published(line.published)) for line in empty]
    notes = (*verdicts(comparison, parts), *comparison.notes, WRAPPED_NOTE, PUBLISHED_NOTE)
    return _grid(scene, comparison.title, rows, first="", last="published (the paper)", notes=notes)


def verdicts(comparison: Comparison, parts: Sequence[Sequence[Entry]]) -> tuple[str, ...]:
    """A sentence that sorts the differences between lines by what they say about the paper's; none without contrasts.

    A difference has the size of the paper's if it is within half of that, or within twice its standard error.
    """
    found: dict[str, list[str]] = {}
    groups: dict[str, SeedGroup] = {}
    # Of several in a line, the one with the fewest flags.
    for entry in sorted(parts[0] if parts else (), key=lambda entry: len(entry.group.first.flags or ())):
        groups.setdefault(entry.line.title, entry.group)
    published = {line.title: line.published for line in comparison.lines}
    for contrast in comparison.contrasts:
        name = f"{contrast.first} against {contrast.second}"
        if not {contrast.first, contrast.second} <= set(groups):
            found.setdefault(NOT_RUN, []).append(name)
            continue
        one, other = groups[contrast.first], groups[contrast.second]
        for split in TEST_SPLITS:
            ours, error = difference(one.score("psnr_db", split), other.score("psnr_db", split))
            wrapped, _ = difference(one.score("psnr_uint8_wrap_db", split), other.score("psnr_uint8_wrap_db", split))
            if ours is None or wrapped is None:
                continue
            text = f"{name}, {SHORT_SPLITS[split]}, {ours:+.2f} (wrapped {wrapped:+.2f}"
            theirs = _published_difference(published[contrast.first], published[contrast.second], split)
            text += ")" if theirs is None else f", published {theirs:+.2f})"
            found.setdefault(judge(ours, error, theirs, is_better=contrast.is_better), []).append(text)
    if not found:
        return ()
    is_few = any(len(group.runs) < MANY_SEEDS for group in groups.values()) and len(groups) > 1
    few = " Some rows have fewer than three seeds, so their spread is not known." if is_few else ""
    listed = " ".join(
        f"{verdict.capitalize()}: {'; '.join(found[verdict])}." for verdict in VERDICTS if verdict in found
    )
    return (f"Differences in dB. {listed}{few}",)


def difference(one: Spread, other: Spread) -> tuple[float | None, float]:
    """The difference of two means and its standard error, which is 0 if neither has several seeds."""
    error = math.sqrt(sum((value.deviation or 0.0) ** 2 / value.count for value in (one, other)))
    if one.mean is None or other.mean is None or not math.isfinite(one.mean - other.mean):
        return None, error
    return one.mean - other.mean, error


def judge(ours: float, error: float, theirs: float | None, *, is_better: bool | None) -> str:
    """What a difference says about the paper's: in numbers, or that there is one in words."""
    if theirs is None and is_better is None:
        return MEASURED
    if abs(ours) < 2 * error:
        return WITHIN_SPREAD
    should_be_positive = theirs > 0 if theirs is not None else is_better
    if (ours > 0) is not should_be_positive:
        return CONTRADICTED
    return CONFIRMED if theirs is None or abs(ours - theirs) <= max(abs(theirs) / 2, 2 * error) else SIGN_ALONE


def _published_difference(one: PublishedRow | None, other: PublishedRow | None, split: Split) -> float | None:
    if one is None or other is None:
        return None
    return one.value_db(split) - other.value_db(split)


def _sheet(comparison: Comparison, scene: SceneScores) -> bytes | None:
    from eval.figures import comparison_sheet

    entries = [entry for part in find_entries(comparison, group_seeds(scene.runs)) for entry in part]
    runs = tuple(entry.group.runs[0] for entry in entries)
    return comparison_sheet(dataclasses.replace(scene, runs=runs), comparison.title) if runs else None


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
            Column(group="CPU min"),
            *(Column(group=last, split=split) for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=(*notes, data_note(scene)),
    )


def _run_cells(group: SeedGroup) -> tuple[str, ...]:
    return (group.name, str(len(group.runs)), *score_cells(group), cpu_minutes_cell(group))


def cpu_minutes_cell(group: SeedGroup) -> str:
    """Processor minutes of training, where `model train --costs` counted them."""
    costs = [read_costs(scores.run.folder).get("cpu_seconds") for scores in group.runs]
    return spread_cell(spread([None if seconds is None else seconds / 60 for seconds in costs]))


def score_cells(group: SeedGroup) -> tuple[str, ...]:
    """PSNR on both splits, their drop, the wrapped PSNR on both."""
    near, far = (spread_cell(group.score("psnr_db", split)) for split in TEST_SPLITS)
    wrapped = (spread_cell(group.score("psnr_uint8_wrap_db", split)) for split in TEST_SPLITS)
    return (near, far, spread_cell(group.drop_db), *wrapped)


def _published(row: PublishedRow | None) -> tuple[str, str]:
    return (MISSING, MISSING) if row is None else (f"{row.interpolating_db:.2f}", f"{row.extrapolating_db:.2f}")


def data_note(scene: SceneScores) -> str:
    return f"Data: {scene.title}, dataset seal {scene.dataset.seal[:12]}."
