"""The pages of docs/results, made from stored results.json files."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import load_json
from eval.tables.grids import TABLE_WIDTH, Column, Grid
from eval.tables.looks import grid_text, markdown_escaped
from eval.tables.plugins import report_parts
from eval.tables.results import RESULTS_VERSION
from eval.tables.scenes import Stored, scene_grids

SEEDS_NOTE = "±: sample standard deviation over seeds."


def results_page(place: Path) -> str:
    """The page of a results.json in Markdown, or of all in a folder; it lies beside that.

    Each file has its command, and named tables of the report if it has some, else the scores of each scene.
    """
    parts: list[str] = []
    said: list[str] = []
    for path in sorted(place.glob("*.json")) if place.is_dir() else [place]:
        data = _read(path)
        command, code = _made_by(data)
        link = path.relative_to(place.parent).as_posix()
        parts += [f"# {path.stem}\n", f"```\n{command}\n```\n", f"[{path.name}]({link}); hyaline {code}.\n"]
        grids = _page_grids(path, data)
        own = data["notes"] if "tables" in data else [*data["notes"][:-1], SEEDS_NOTE]  # The last: the wrapped metric.
        parts += [f"{markdown_escaped(note)}\n" for note in own if note not in said]
        said += own
        for grid in grids:
            parts.append(grid_text(_without(grid, said), "markdown", width=TABLE_WIDTH))
            said += grid.notes
    return "\n".join(parts)


def _without(grid: Grid, said: Sequence[str]) -> Grid:
    """The table without notes that the page has already."""
    return dataclasses.replace(grid, notes=tuple(note for note in grid.notes if note not in said))


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
            return [_grid_of(grid) for table in data["tables"].values() for grid in table]
        parts, grids = report_parts(), []
        found: dict[str, dict[str, Stored]] = {name: {} for name in parts}
        for scene in data["scenes"]:
            grids += scene_grids(scene, is_page=True)
            for name, part in parts.items():
                if stored := scene["analyses"].get(name):
                    grids += part.scene_grids(scene["scene"], stored)
                    found[name][scene["scene"]] = stored
        return grids + [grid for name, part in parts.items() for grid in part.all_grids(found[name])]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise HyalineError(f"{path}: lacks {error}; expected a results.json of `eval report`") from error
