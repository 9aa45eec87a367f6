"""Formats of tables: plain text for terminals, Markdown, LaTeX, HTML."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from datagen.disk.names import printable
from datagen.pages.html import Markup, Part, join, prose, tag
from eval.score.scores import metric_notes
from eval.tables.grids import MISSING, SHORT_SPLITS, TABLE_WIDTH, Column, Grid
from eval.tables.scenes import Stored, scene_grids

if TYPE_CHECKING:
    from rich.table import Table


LONGEST_LINE = 32
"""Row names up to this number of characters stay on one line."""


def tables_text(
    scenes: Sequence[Stored],
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
        scenes: the scenes of results.json.
        more: further tables, after those of the scenes.
        is_full: include detailed tables.
        is_wrapped: include the metric of the paper's authors' script.
    """

    def write(grid: Grid) -> str:
        return grid_text(grid, output_format, width=width, color=color)

    grids = [grid for scene in scenes for grid in scene_grids(scene, is_wrapped=is_wrapped)]
    parts = [write(grid) for grid in grids if is_full or not grid.is_detail]
    parts.append(_paragraphs(metric_notes(is_wrapped=is_wrapped), output_format, width))
    parts += [write(grid) for grid in more if is_full or not grid.is_detail]
    return "\n".join(parts)


def grid_text(grid: Grid, output_format: str, *, width: int, color: bool = False) -> str:
    """One table as `table` (plain text, `width` columns wide), `markdown` or `latex`."""
    # Names come from folders and files: they must not contain line breaks or control a terminal in any format.
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
    """Best values are bold, and with `is_marked` have an asterisk."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    # rich would interpret square brackets in names as mark-up, so every string is passed as Text.
    table = Table(
        title=Text(grid.title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 0, 0, 1)
    )
    for column in grid.columns:
        header = column.group if column.split is None else f"{column.group} {SHORT_SPLITS[column.split]}"
        lines = header.replace(" ", "\n").replace("\n↑", " ↑").replace("\n↓", " ↓") if column.is_number else header
        table.add_column(Text(lines), justify="right" if column.is_number else "left", vertical="top")
        table.columns[-1].overflow = "fold"
    # Scores over several seeds break after their ± before a name breaks.
    table.columns[0].no_wrap = all(len(row[0]) <= LONGEST_LINE for row in grid.rows)
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
    """Text that Markdown shows literally: without tags, links, code or columns of a table."""
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
    """A booktabs tabular; it only needs \\usepackage{booktabs}."""
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


def html_table(grid: Grid, links: Mapping[str, str] | None = None) -> Markup:
    """A table with its notes below; best values are marked, and a separate last row is its footer.

    Args:
        links: anchors on the page for names in the first column.
    """
    links = links or {}
    body = grid.rows[:-1] if grid.last_row_apart else grid.rows
    foot = grid.rows[len(body) :]
    rows = [_row(grid, number, row, links) for number, row in enumerate(body)]
    table = tag(
        "table",
        tag("caption", grid.title),
        tag("thead", tag("tr", *map(_head, grid.columns))),
        tag("tbody", *rows),
        tag("tfoot", *(_row(grid, len(body), row, {}) for row in foot)) if foot else None,
        class_="sortable" if len(body) > 1 else None,
    )
    notes = [tag("p", prose(note), class_="note") for note in grid.notes]
    # With a tab index, a wide table can be scrolled by keyboard.
    return join([tag("div", table, class_="scroll", tabindex=0, role="region", aria_label=grid.title), *notes])


def _head(column: Column) -> Markup:
    below = None if column.split is None else join([" ", tag("small", column.split)])
    return tag("th", column.group, below, scope="col", class_=_class(column))


def _row(grid: Grid, number: int, row: tuple[str, ...], links: Mapping[str, str]) -> Markup:
    cells: list[Part] = []
    for place, (column, text) in enumerate(zip(grid.columns, row, strict=True)):
        content: Part = tag("a", text, href=f"#{links[text]}") if not place and text in links else text
        if place == 0:
            cells.append(tag("th", content, scope="row", class_="short" if len(text) <= LONGEST_LINE else None))
        elif (number, place) in grid.best:
            cells.append(tag("td", content, class_=f"{_class(column) or ''} best".strip(), title="best of its column"))
        else:
            cells.append(tag("td", content, class_=_class(column)))
    return tag("tr", *cells)


def _class(column: Column) -> str | None:
    return "number" if column.is_number else None
