"""RESULTS.md and the pages that it lists, made from stored results.json files."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import cast

from datagen.disk.errors import HyalineError
from datagen.disk.records import load_json, shown
from datagen.terminal.plugins import Group
from eval.tables.grids import TABLE_WIDTH, Column, Grid
from eval.tables.looks import grid_text, markdown_escaped
from eval.tables.named import TABLES
from eval.tables.results import RESULTS_VERSION
from eval.tables.scenes import Stored, coverage_grids, page_grids

MOST_NAMES = 3
"""So many datasets are named in the list of pages."""

HEAD = """# Results

Every table is in one of the pages below, each made from a `results.json` that `eval report` wrote, or, for the tracks \
of [hyaline-bench](docs/bench.md), from the files of `hyaline-bench score`. To add one, copy it to \
[docs/results](docs/results) and run `make results`, which writes the pages and this list. [Claims](docs/claims.md) \
says what we conclude from them, and what speaks against it; the [history](docs/notes/history.md) has older results.
"""

NOTES = (
    "dB per 10°: how PSNR falls with the angle between a test ray and the nearest training ray that met its texel. ±: "
    "sample standard deviation over seeds.",
)

INDEX_COLUMNS = ("page", "datasets", "tables", "seeds", "hyaline")

Row = tuple[str, str, str, str, str]
"""A row of the list, by `INDEX_COLUMNS`."""

RESULT_LISTS: Group[Callable[[Path], dict[Row, str]]] = Group(
    name="hyaline.result_lists", what="list of results", built_in={}, guide="docs/adding-a-table.md"
)
"""Functions that find further rows in the folder docs/results/NAME, each with its page's text."""


def results_page(path: Path) -> str:
    """The page of one file in Markdown: named tables of the report if it has some, else the scores of each scene."""
    data = _read(path)
    command, code = _made_by(data)
    about = f"[{path.name}]({path.name}); hyaline {code}."
    has_tables = "tables" in data
    tables, grids = [], _page_grids(path, data)
    notes = [*data["notes"]] if has_tables else [*data["notes"][:-1], *NOTES]  # The last is about the wrapped metric.
    said = "".join(f"\n{markdown_escaped(note)}\n" for note in notes)
    for grid in grids:
        tables.append(grid_text(_without(grid, notes), "markdown", width=TABLE_WIDTH))
        notes += grid.notes
    return "\n".join([f"# {path.stem}\n", f"```\n{command}\n```\n", f"{about}\n{said}", *tables])


def _without(grid: Grid, said: Sequence[str]) -> Grid:
    """The table without notes that the page has already."""
    return dataclasses.replace(grid, notes=tuple(note for note in grid.notes if note not in said))


def results_index(paths: Sequence[Path], others: Mapping[Row, str] | None = None) -> str:
    """The list of all pages in Markdown, the shortest first.

    Args:
        paths: results.json files, each with its page beside it.
        others: rows of further pages, and the pages' text.
    """
    lengths = {row: len(text) for row, text in (others or {}).items()}
    for path in paths:
        data = _read(path)
        runs = [run for scene in data["scenes"] for run in scene["runs"]]
        seeds = {run["seed"] for run in runs if run["seed"] is not None}
        names = [scene["scene"] for scene in data["scenes"]]
        shown = ", ".join(names) if len(names) <= MOST_NAMES else f"{len(names)} datasets"
        page = path.with_suffix(".md").as_posix()
        tables = _in_order(data.get("tables", {})) or ["scores"]
        row = (f"[{path.stem}]({page})", shown, ", ".join(tables), str(len(seeds)), _made_by(data)[1])
        lengths[row] = len(results_page(path))
    rows = sorted(lengths, key=lambda row: (lengths[row], row))
    rules = ["---" if column != "seeds" else "---:" for column in INDEX_COLUMNS]
    lines = (f"| {' | '.join(cells)} |" for cells in (INDEX_COLUMNS, rules, *rows))
    return HEAD + "\n" + "\n".join(lines) + "\n"


def _in_order(tables: Stored) -> list[str]:
    """The names of stored tables, as `report --help` lists them; those of other distributions last."""
    order = [*TABLES.names(), *tables]
    return sorted(tables, key=order.index)


def _grid_of(stored: Stored) -> Grid:
    return Grid(
        title=stored["title"],
        columns=tuple(Column(group=group, split=split, is_number=number) for group, split, number in stored["columns"]),
        rows=tuple(map(tuple, stored["rows"])),
        notes=tuple(stored["notes"]),
    )


def _read(path: Path) -> Stored:
    data = cast(Stored, load_json(path))
    if data.get("version") != RESULTS_VERSION:
        raise HyalineError(
            f"{path}: format version {shown(data.get('version'))}; this program reads {RESULTS_VERSION}, as "
            "`eval report` writes it"
        )
    return data


def _made_by(data: Stored) -> tuple[str, str]:
    """The command that made the results, and the code's version."""
    command, code = (data.get("made_by", {}).get(key, "not recorded") for key in ("command", "code"))
    return command, code


def _page_grids(path: Path, data: Stored) -> list[Grid]:
    try:
        if "tables" in data:
            return [_grid_of(grid) for name in _in_order(data["tables"]) for grid in data["tables"][name]]
        return [*(grid for scene in data["scenes"] for grid in page_grids(scene)), *coverage_grids(data["scenes"])]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise HyalineError(f"{path}: lacks {error}; expected a results.json of `eval report`") from error
