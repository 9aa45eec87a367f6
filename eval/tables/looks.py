"""Formats of tables: plain text for terminals, Markdown, LaTeX, HTML."""

import dataclasses
import re
from collections.abc import Mapping, Sequence

from datagen.disk.errors import printable
from datagen.pages.html import Markup, Part, join, prose, tag
from eval.tables.grids import MISSING, SHORT_SPLITS, TABLE_WIDTH, Column, Grid

LONGEST_LINE = 32
"""Row names up to this number of characters stay on one line."""


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
    """Best values are bold with colour, and have an asterisk without."""
    import io

    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    buffer = io.StringIO()
    console = Console(file=buffer, width=width, force_terminal=color, no_color=not color, highlight=False)
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
    for place, row in enumerate(grid.rows):
        best = [(place, column) in grid.best for column in range(len(row))]
        cells = [
            Text(f"{cell}*" if is_best and not color else cell, style="bold" if is_best else "")
            for cell, is_best in zip(row, best, strict=True)
        ]
        table.add_row(*cells, end_section=grid.last_row_apart and place == len(grid.rows) - 2)
    console.print(table)
    text = "\n".join(line.rstrip() for line in buffer.getvalue().splitlines())
    notes = (*grid.notes, *(["* the best of its column."] if grid.best and not color else []))
    return f"{text.rstrip()}\n" + paragraphs(notes, "table", width)


def paragraphs(notes: Sequence[str], output_format: str, width: int) -> str:
    """Notes below tables."""
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
    return f"### {markdown_escaped(grid.title)}\n\n{body}" + paragraphs(grid.notes, "markdown", TABLE_WIDTH)


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
    heads = [f"{c.group} {SHORT_SPLITS[c.split]}" if c.split else c.group for c in grid.columns]
    rows = [
        [
            rf"\textbf{{{latex_escaped(cell)}}}" if (place, column) in grid.best else latex_escaped(cell)
            for column, cell in enumerate(row)
        ]
        for place, row in enumerate(grid.rows)
    ]
    lines = [" & ".join(row) + r" \\" for row in rows]
    if grid.last_row_apart:
        lines.insert(-1, r"\midrule")
    head = " & ".join(map(latex_escaped, heads)) + r" \\"
    begin = [f"% {grid.title}", rf"\begin{{tabular}}{{{alignment}}}", r"\toprule", head, r"\midrule"]
    text = "\n".join([*begin, *lines, r"\bottomrule", r"\end{tabular}"])
    return f"{text}\n{paragraphs(grid.notes, 'latex', TABLE_WIDTH)}"


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
