"""Prints a results.json, or those of a folder, as a page of Markdown; `make results` writes docs/results that way."""

import dataclasses
import sys
from pathlib import Path
from typing import cast

from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import load_json
from eval.tables.grids import TABLE_WIDTH, Column, Grid, grid_text, markdown_escaped
from eval.tables.plugins import report_parts
from eval.tables.results import RESULTS_VERSION, Stored, scene_grids

SEEDS_NOTE = "±: sample standard deviation over seeds."


def results_page(place: Path) -> str:
    """The page of a results.json in Markdown, or of all in a folder; it lies beside that.

    Each file has its command, and named tables of the report if it has some, else the scores of each scene.
    """
    parts: list[str] = []
    said: list[str] = []
    for path in sorted(place.glob("*.json")) if place.is_dir() else [place]:
        data = cast(Stored, load_json(path))
        if (version := data.get("version")) != RESULTS_VERSION:
            raise HyalineError(f"{path}: format version {shown(version)}; this program reads {RESULTS_VERSION}")
        command, code = (data.get("made_by", {}).get(key, "not recorded") for key in ("command", "code"))
        link = path.relative_to(place.parent).as_posix()
        parts += [f"# {path.stem}\n", f"```\n{command}\n```\n", f"[{path.name}]({link}); hyaline {code}.\n"]
        grids = _page_grids(path, data)
        own = data["notes"] if "tables" in data else [*data["notes"][:-1], SEEDS_NOTE]  # The last: the wrapped metric.
        parts += [f"{markdown_escaped(note)}\n" for note in own if note not in said]
        said += own
        for grid in grids:
            new = tuple(note for note in grid.notes if note not in said)
            parts.append(grid_text(dataclasses.replace(grid, notes=new), "markdown", width=TABLE_WIDTH))
            said += new
    return "\n".join(parts).replace("\n### ", "\n## ")  # Each table is a chapter of its file's.


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


def _grid_of(stored: Stored) -> Grid:
    return Grid(
        title=stored["title"],
        columns=tuple(Column(group=group, split=split, is_number=number) for group, split, number in stored["columns"]),
        rows=tuple(map(tuple, stored["rows"])),
        notes=tuple(stored["notes"]),
    )


if __name__ == "__main__":
    sys.stdout.write(results_page(Path(sys.argv[1])))
