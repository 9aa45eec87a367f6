"""Printed tables: for each scene one of scores and one of what the runs are, for people and for papers."""

import dataclasses
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from datagen.data.config import TEST_SPLITS, Split
from datagen.disk.names import printable
from eval.score.scores import METRICS, Metric, RunScores, SceneScores, metric_notes
from eval.score.seeds import SeedGroup, Spread, group_seeds

if TYPE_CHECKING:
    from rich.table import Table

MISSING = "–"  # noqa: RUF001  An en dash, as tables have it.
CEILING = "truth's noise (ceiling)"
SHORT_SPLITS: dict[Split, str] = {
    "train": "train",
    "interpolating": "inter",
    "extrapolating": "extra",
    "extrapolating-10deg": "10°",
    "extrapolating-20deg": "20°",
    "extrapolating-40deg": "40°",
}
TABLE_WIDTH = 120

MEANS_NOTE = "Of runs that differ in their seed alone: means over the seeds."


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column's head: neighbours with the same group share it."""

    group: str
    split: Split | None = None
    is_number: bool = True


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table before it has a look."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    last_row_apart: bool = False
    notes: tuple[str, ...] = ()
    best: frozenset[tuple[int, int]] = frozenset()
    """Row and column of the values that are the best of their columns."""
    is_detail: bool = False
    """Printed only when everything is asked for."""


def scene_grids(scene: SceneScores, *, is_wrapped: bool = False) -> tuple[Grid, ...]:
    """The scores of a scene's runs, with the noise ceiling below them; means over seeds, if any; what the runs are.

    Args:
        is_wrapped: also print what the paper's authors' script would.
    """
    groups = [group for group in group_seeds(scene.runs) if len(group.runs) > 1]
    metrics = tuple(metric for metric in METRICS if metric.is_printed or (is_wrapped and metric.is_wrapped))
    seeds = [_seed_grid(scene, groups, metrics)] if groups else []
    return _score_grid(scene, metrics), *seeds, _run_grid(scene)


def format_number(value: float | None, decimals: int) -> str:
    if value is None:
        return MISSING
    return "∞" if math.isinf(value) else f"{value:.{decimals}f}"


def ceiling_text(value: float | None) -> str:
    """A noise ceiling in dB; of imported pictures it is unknown."""
    return "unknown" if value is None else format_number(value, 2)


def psnr_text(value: float | None) -> str:
    """The PSNR of one picture as its caption; nothing where it has none."""
    if value is None:
        return ""
    return "PSNR ∞ (identical)" if math.isinf(value) else f"PSNR {value:.2f} dB"


def _score_grid(scene: SceneScores, metrics: tuple[Metric, ...]) -> Grid:
    """The best run first, by its PSNR on the interpolating split."""
    columns = [Column(group="run", is_number=False)]
    signs = [0]
    """Of each column: 1 where more is better, -1 where less is, 0 where neither."""
    for metric in metrics:
        columns += [Column(group=metric.title, split=split) for split in TEST_SPLITS]
        signs += [metric.sign] * len(TEST_SPLITS)
        if metric.key == "psnr_db":
            columns.append(Column(group="drop dB ↓"))
            signs.append(0)
    runs = sorted(scene.runs, key=_rank)
    rows, values = [], []
    for scores in runs:
        row, numbers = [scores.run.name], [None]
        for metric in metrics:
            means = [scores.mean(metric.key, split) for split in TEST_SPLITS]
            row += [format_number(mean, metric.decimals) for mean in means]
            numbers += means
            if metric.key == "psnr_db":
                row.append(format_number(scores.drop_db, 2))
                numbers.append(None)
        rows.append(tuple(row))
        values.append(numbers)
    ceiling = [ceiling_text(scene.ceilings_db[split]) for split in TEST_SPLITS]
    rows.append((CEILING, *ceiling, *[MISSING] * (len(columns) - 1 - len(ceiling))))
    views = " + ".join(f"{scene.dataset.config.split(split).views} {split}" for split in TEST_SPLITS)
    return Grid(
        title=f"{scene.title}: {views} views of {scene.dataset.config.resolution} pixels",
        columns=tuple(columns),
        rows=tuple(rows),
        last_row_apart=True,
        notes=left_out_notes(scene),
        best=_best(rows[:-1], values, signs) if len(runs) > 1 else frozenset(),
    )


def _rank(scores: RunScores) -> tuple[float, str]:
    mean = scores.mean("psnr_db", "interpolating")
    return (math.inf if mean is None else -mean, scores.run.name)


def _best(
    rows: list[tuple[str, ...]], values: list[list[float | None]], signs: list[int]
) -> frozenset[tuple[int, int]]:
    """The places of each column's best value, and of those that are printed alike."""
    best = set()
    for column, sign in enumerate(signs):
        known = [(sign * value, row) for row, line in enumerate(values) if (value := line[column]) is not None]
        if sign and known:
            text = rows[max(known)[1]][column]
            best |= {(row, column) for row, line in enumerate(rows) if line[column] == text}
    return frozenset(best)


def _seed_grid(scene: SceneScores, groups: list[SeedGroup], metrics: tuple[Metric, ...]) -> Grid:
    """Two lines a group: the mean of its runs' scores, and their standard deviation."""
    columns = [Column(group="runs", is_number=False), Column(group="seeds")]
    for metric in metrics:
        columns += [Column(group=metric.title, split=split) for split in TEST_SPLITS]
        if metric.key == "psnr_db":
            columns.append(Column(group="drop dB ↓"))
    rows = []
    for group in groups:
        cells: list[tuple[Spread, int]] = []
        for metric in metrics:
            cells += [(group.score(metric.key, split), metric.decimals) for split in TEST_SPLITS]
            if metric.key == "psnr_db":
                cells.append((group.drop_db, 2))
        means = (format_number(cell.mean, decimals) for cell, decimals in cells)
        rows.append((group.name, str(len(group.runs)), *means))
        rows.append(("  ±", "", *(format_number(cell.deviation, decimals) for cell, decimals in cells)))
    return Grid(
        title=f"{scene.title}: mean and standard deviation over seeds",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=("Each run's score is as in the table above; ± is the sample standard deviation (n - 1) over seeds.",),
    )


def _run_grid(scene: SceneScores) -> Grid:
    texts = ("run", "method", "label", "geometry", "knowledge")
    return Grid(
        title=f"{scene.title}: the runs",
        columns=(
            *(Column(group=text, is_number=False) for text in texts),
            Column(group="parameters"),
            Column(group="seed"),
        ),
        rows=tuple(_run_row(scores) for scores in scene.runs),
        notes=(f"Data: dataset seal {scene.dataset.seal[:12]}.",),
        is_detail=True,
    )


def _run_row(scores: RunScores) -> tuple[str, ...]:
    run = scores.run
    texts = (run.method, run.label, run.geometry, run.knowledge)
    return (
        run.name,
        *(text or MISSING for text in texts),
        MISSING if run.num_parameters is None else f"{run.num_parameters:,}",
        MISSING if run.seed is None else str(run.seed),
    )


def left_out_notes(scene: SceneScores) -> tuple[str, ...]:
    """Which means do not cover all pictures, and why."""
    notes = [] if scene.has_glass_mask else ["PSNR glass: no layers of the true geometry tell which pixels see glass."]
    for scores in scene.runs:
        for split, values in scores.splits.items():
            if values is None:
                notes.append(f"{scores.run.name}: has no predictions for the {split} split.")
                continue
            total = len(values.images["psnr_db"])
            for metric in METRICS:
                if count := values.identical(metric.key):
                    title = metric.title.removesuffix(" ↑")
                    notes.append(
                        f"{scores.run.name}, {split}: {title} is infinite in {count} of {total} pictures, left out."
                    )
    for split, count in _without_glass(scene).items():
        notes.append(f"{split}: {count} of the pictures show no glass and are left out of PSNR glass.")
    return tuple(notes)


def _without_glass(scene: SceneScores) -> dict[Split, int]:
    counts: dict[Split, int] = {}
    for scores in scene.runs:
        for split, values in scores.splits.items():
            if scene.has_glass_mask and values is not None and (count := values.undefined("glass_psnr_db")):
                counts[split] = count
    return counts


# Looks


def tables_text(
    scenes: list[SceneScores],
    output_format: str,
    *,
    width: int,
    color: bool = False,
    more: Sequence[Grid] = (),
    is_full: bool = True,
    is_wrapped: bool = False,
) -> str:
    """The tables, and the notes that explain them, as `table` (plain text), `markdown` or `latex`.

    Args:
        more: further tables, behind those of the scenes.
        is_full: with the tables that are details.
        is_wrapped: with what the paper's authors' script would print.
    """

    def write(grid: Grid) -> str:
        return grid_text(grid, output_format, width=width, color=color)

    grids = [grid for scene in scenes for grid in scene_grids(scene, is_wrapped=is_wrapped)]
    parts = [write(grid) for grid in grids if is_full or not grid.is_detail]
    parts.append(_paragraphs(metric_notes(is_wrapped=is_wrapped), output_format, width))
    parts += [write(grid) for grid in more if is_full or not grid.is_detail]
    return "\n".join(parts)


def grid_text(grid: Grid, output_format: str, *, width: int, color: bool = False) -> str:
    """One table as `table` (plain text of so many columns), `markdown` or `latex`."""
    # Names come from folders and files: in no format may they end a line, or tell a terminal to do something.
    grid = dataclasses.replace(
        grid,
        title=printable(grid.title),
        rows=tuple(tuple(map(printable, row)) for row in grid.rows),
        notes=tuple(map(printable, grid.notes)),
    )
    if output_format == "table":
        return _plain(grid, width, color)
    return {"markdown": _markdown, "latex": _latex}[output_format](grid)


def _plain(grid: Grid, width: int, color: bool) -> str:
    import io

    from rich.console import Console
    from rich.measure import Measurement

    buffer = io.StringIO()
    console = Console(file=buffer, width=width, force_terminal=color, no_color=not color, highlight=False)
    is_marked = bool(grid.best) and not color
    table = _rich_table(grid, is_marked=is_marked)
    unbounded = console.options.update(max_width=10 * width)
    if is_marked and Measurement.get(console, unbounded, table).maximum > width:
        is_marked, table = False, _rich_table(grid, is_marked=False)
    console.print(table)
    text = "\n".join(line.rstrip() for line in buffer.getvalue().splitlines())
    notes = (*grid.notes, *(["* the best of its column."] if is_marked else []))
    return f"{text.rstrip()}\n" + _paragraphs(notes, "table", width)


def _rich_table(grid: Grid, *, is_marked: bool) -> "Table":
    """Best values are bold, which a terminal shows, and have an asterisk where asked for."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    # Names may hold square brackets, which rich would take for mark-up: so every string goes in as Text.
    table = Table(
        title=Text(grid.title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 0, 0, 1)
    )
    for column in grid.columns:
        header = column.group if column.split is None else f"{column.group} {SHORT_SPLITS[column.split]}"
        lines = header.replace(" ", "\n").replace("\n↑", " ↑").replace("\n↓", " ↓") if column.is_number else header
        table.add_column(
            Text(lines), justify="right" if column.is_number else "left", vertical="top", no_wrap=column.is_number
        )
        table.columns[-1].overflow = "fold"
    marked = {column for _, column in grid.best} if is_marked else set()
    for place, row in enumerate(grid.rows):
        cells = []
        for column, cell in enumerate(row):
            is_best = (place, column) in grid.best
            mark = ("*" if is_best else " ") if column in marked else ""
            cells.append(Text(cell + mark, style="bold" if is_best else ""))
        table.add_row(*cells, end_section=grid.last_row_apart and place == len(grid.rows) - 2)
    return table


def _paragraphs(notes: tuple[str, ...], output_format: str, width: int) -> str:
    import textwrap

    if output_format == "markdown":
        return "".join(f"\n{markdown_escaped(note)}\n" for note in notes)
    if output_format == "latex":
        return "".join(f"% {note}\n" for note in notes)
    return "".join(f"{textwrap.fill(note, width - 2, subsequent_indent='  ')}\n" for note in notes)


def markdown_escaped(text: str) -> str:
    """Text that Markdown shows as it is: no tag, link, code or column of a table begins in it."""
    return re.sub(r"([\\`|<>\[\]])", r"\\\1", text)


def _markdown(grid: Grid) -> str:
    heads = [column.group if column.split is None else f"{column.group}, {column.split}" for column in grid.columns]
    rules = ["---:" if column.is_number else "---" for column in grid.columns]
    rows = [
        [
            f"**{markdown_escaped(cell)}**" if (place, column) in grid.best else markdown_escaped(cell)
            for column, cell in enumerate(row)
        ]
        for place, row in enumerate(grid.rows)
    ]
    lines = [[markdown_escaped(head) for head in heads], rules, *rows]
    body = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return f"### {markdown_escaped(grid.title)}\n\n{body}" + _paragraphs(grid.notes, "markdown", TABLE_WIDTH)


LATEX_SPELLING = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "$": r"\$", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "∞": r"$\infty$", "Δ": r"$\Delta$", "↑": r"$\uparrow$",
    "↓": r"$\downarrow$", "±": r"$\pm$", "→": r"$\to$", MISSING: "--",
}  # fmt: skip


def latex_escaped(text: str) -> str:
    return "".join(LATEX_SPELLING.get(character, character) for character in text)


def _latex(grid: Grid) -> str:
    """A booktabs tabular; \\usepackage{booktabs} is all it needs."""
    alignment = "".join("r" if column.is_number else "l" for column in grid.columns)
    top, rules, below, place = [], [], [], 0
    while place < len(grid.columns):
        group = grid.columns[place].group
        span = next(
            (count for count, column in enumerate(grid.columns[place:]) if column.group != group),
            len(grid.columns) - place,
        )
        name = latex_escaped(group)
        top.append(rf"\multicolumn{{{span}}}{{c}}{{{name}}}" if span > 1 else name)
        if span > 1:
            rules.append(rf"\cmidrule(lr){{{place + 1}-{place + span}}}")
        below += [SHORT_SPLITS[column.split] if column.split else "" for column in grid.columns[place : place + span]]
        place += span
    rows = [
        " & ".join(
            rf"\textbf{{{latex_escaped(cell)}}}" if (line, column) in grid.best else latex_escaped(cell)
            for column, cell in enumerate(row)
        )
        + r" \\"
        for line, row in enumerate(grid.rows)
    ]
    if grid.last_row_apart:
        rows.insert(-1, r"\midrule")
    heads = [" & ".join(top) + r" \\"]
    if rules:
        heads += [" ".join(rules), " & ".join(below) + r" \\"]
    lines = [
        f"% {grid.title}",
        rf"\begin{{tabular}}{{{alignment}}}",
        r"\toprule",
        *heads,
        r"\midrule",
        *rows,
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n" + _paragraphs(grid.notes, "latex", TABLE_WIDTH)
