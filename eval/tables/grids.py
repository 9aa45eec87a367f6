"""Tables: their cells, and their formats: plain text for terminals, Markdown, HTML."""

import dataclasses
import io
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

from datagen.data.config import Split
from datagen.disk.errors import printable
from datagen.pages.html import Markup, Part, join, prose, tag

MISSING = "–"  # noqa: RUF001  An en dash, as tables have it.
CEILING = "noise ceiling"
SHORT_SPLITS: dict[Split, str] = {
    "train": "train",
    "interpolating": "inter",
    "extrapolating": "extra",
    "extrapolating-10deg": "10°",
    "extrapolating-20deg": "20°",
    "extrapolating-40deg": "40°",
}
TABLE_WIDTH = 120
FOLDS = " (?![↑↓])"
"""Where the head of a column of numbers goes on in the next line."""
LONGEST_LINE = 32
"""Row names up to this number of characters stay on one line."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column's header; neighbours with the same group share it."""

    group: str
    split: Split | None = None
    is_number: bool = True

    @property
    def short(self) -> str:
        return self.group if self.split is None else f"{self.group} {SHORT_SPLITS[self.split]}"


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table without formatting."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    last_row_apart: bool = False
    notes: tuple[str, ...] = ()
    best: frozenset[tuple[int, int]] = frozenset()
    """Row and column of the best values of their columns."""


def format_number(value: float | None, decimals: int) -> str:
    if value is None:
        return MISSING
    return "∞" if math.isinf(value) else f"{value:.{decimals}f}"


def ceiling_text(value: float | None) -> str:
    """A noise ceiling in dB; unknown for imported pictures."""
    return "unknown" if value is None else format_number(value, 2)


def psnr_text(value: float | None) -> str:
    """The PSNR of one picture for its caption; empty if it has none."""
    if value is None:
        return ""
    return "PSNR ∞ (identical)" if math.isinf(value) else f"PSNR {value:.2f} dB"


def grid_text(grid: Grid, output_format: str, *, width: int, color: bool = False) -> str:
    """One table as `table` (plain text, `width` columns wide) or `markdown`."""
    # Names come from folders and files: they must not contain line breaks or control a terminal in any format.
    grid = dataclasses.replace(
        grid,
        title=printable(grid.title),
        rows=tuple(tuple(map(printable, row)) for row in grid.rows),
        notes=tuple(map(printable, grid.notes)),
    )
    if output_format == "table":
        return _plain(_narrowed(grid, width) if width < TABLE_WIDTH else grid, width, color)
    return _markdown(grid)


def _narrowed(grid: Grid, width: int) -> Grid:
    """The grid without the last columns, if all do not fit; a note says so."""
    heads = [re.split(FOLDS, column.short) for column in grid.columns]
    cells = zip(heads, zip(*grid.rows, strict=True), strict=True)
    ends = list(accumulate(max(map(len, (*head, *column))) + 2 for head, column in cells))
    count = max(1, sum(end < width for end in ends))
    if count == len(ends):
        return grid
    note = f"{len(ends) - count} columns left out: the terminal is {width} wide. --json has them."
    rows = tuple(row[:count] for row in grid.rows)
    return dataclasses.replace(grid, columns=grid.columns[:count], rows=rows, notes=(*grid.notes, note))


def _plain(grid: Grid, width: int, color: bool) -> str:
    """Best values are bold with colour, and have an asterisk without."""
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
        lines = re.sub(FOLDS, "\n", column.short) if column.is_number else column.short
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
    if output_format == "markdown":
        return "".join(f"\n{markdown_escaped(note)}\n" for note in notes)
    return "".join(f"{textwrap.fill(note, width - 2, subsequent_indent='  ')}\n" for note in notes)


def markdown_escaped(text: str) -> str:
    """Text that Markdown shows literally: without tags, links, code or columns of a table."""
    return re.sub(r"([\\`|<>\[\]])", r"\\\1", text)


def _markdown(grid: Grid) -> str:
    heads = [column.group if column.split is None else f"{column.group}, {column.split}" for column in grid.columns]
    rules = ["---:" if column.is_number else "---" for column in grid.columns]
    rows = [
        [f"**{escaped}**" if (place, column) in grid.best else escaped for column, escaped in enumerate(cells)]
        for place, cells in enumerate([*map(markdown_escaped, row)] for row in grid.rows)
    ]
    body = "".join(f"| {' | '.join(line)} |\n" for line in ([*map(markdown_escaped, heads)], rules, *rows))
    return f"### {markdown_escaped(grid.title)}\n\n{body}" + paragraphs(grid.notes, "markdown", TABLE_WIDTH)


def html_table(grid: Grid, links: Mapping[str, str] | None = None) -> Markup:
    """A table with its notes below; best values are marked, and a separate last row is its footer.

    Args:
        links: anchors on the page for names in the first column.
    """
    links = links or {}
    kinds = ["number" if column.is_number else None for column in grid.columns]
    heads = [
        tag("th", column.group, column.split and join([" ", tag("small", column.split)]), scope="col", class_=kind)
        for column, kind in zip(grid.columns, kinds, strict=True)
    ]

    def row(number: int) -> Markup:
        name, *others = grid.rows[number]
        content: Part = tag("a", name, href=f"#{links[name]}") if name in links else name
        cells = [tag("th", content, scope="row", class_="short" if len(name) <= LONGEST_LINE else None)]
        for place, text in enumerate(others, start=1):
            is_best = (number, place) in grid.best
            class_ = " ".join([*filter(None, [kinds[place]]), *(["best"] if is_best else [])])
            cells.append(tag("td", text, class_=class_ or None, title="best of its column" if is_best else None))
        return tag("tr", *cells)

    rows = [row(number) for number in range(len(grid.rows))]
    foot = [rows.pop()] if grid.last_row_apart else []
    table = tag(
        "table",
        tag("caption", grid.title),
        tag("thead", tag("tr", *heads)),
        tag("tbody", *rows),
        tag("tfoot", *foot) if foot else None,
        class_="sortable" if len(rows) > 1 else None,
    )
    notes = [tag("p", prose(note), class_="note") for note in grid.notes]
    # With a tab index, a wide table can be scrolled by keyboard.
    return join([tag("div", table, class_="scroll", tabindex=0, role="region", aria_label=grid.title), *notes])
