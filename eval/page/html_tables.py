"""Tables as HTML: whole without scripts, sorted by a script where there is one."""

from collections.abc import Mapping

from datagen.pages.html import Markup, Part, join, prose, tag
from eval.tables.grids import Column, Grid

CONTINUED = "±"
"""Begins a row that belongs to the one above: such a table is not sorted."""
LONGEST_LINE = 32
"""A row's name of so many characters stays on one line."""


def html_table(grid: Grid, links: Mapping[str, str] | None = None) -> Markup:
    """A table with its notes below; best values are marked, the row apart is its foot.

    Args:
        links: names in the first column that lead somewhere in the page.
    """
    links = links or {}
    body = grid.rows[:-1] if grid.last_row_apart else grid.rows
    foot = grid.rows[len(body) :]
    rows = [_row(grid, number, row, links) for number, row in enumerate(body)]
    is_sortable = len(body) > 1 and not any(row[0].strip() == CONTINUED for row in body)
    table = tag(
        "table",
        tag("caption", grid.title),
        tag("thead", tag("tr", *map(_head, grid.columns))),
        tag("tbody", *rows),
        tag("tfoot", *(_row(grid, len(body), row, {}) for row in foot)) if foot else None,
        class_="sortable" if is_sortable else None,
    )
    notes = [tag("p", prose(note), class_="note") for note in grid.notes]
    # One may scroll a wide table by keyboard only where it can be reached.
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
