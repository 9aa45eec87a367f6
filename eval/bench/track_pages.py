"""Pages of RESULTS: a track's tables in Markdown, from stored files of `hyaline-bench score`."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.records import shown
from eval.bench.leaderboard import NOTES, check_comparable, scene_grid, track_grid
from eval.bench.protocol import ALL, Protocol, left_out, load_protocol
from eval.bench.score import Scored, read_scored
from eval.tables.grids import MISSING, TABLE_WIDTH, Column, Grid, format_number
from eval.tables.looks import grid_text, markdown_escaped
from eval.tables.pages import Row

TRACKS = "bench"
"""Folder in docs/results with the scores, METHOD.json, and the pages, TRACK.md."""


OTHERS = (
    "The sweep trains built-in methods on public scenes. Hidden scenes and other people's methods are run by hand, as "
    "docs/bench.md says."
)
"""What the command of a page does not make."""


def read_scores(folder: Path) -> list[Scored]:
    """The scored submissions in a folder, named by their files if two have one name.

    A file of another version, or of a track that the protocol does not have, is named and left out.
    """
    found: dict[str, Scored] = {}
    for path in sorted(folder.glob("*.json")):
        with left_out():
            scored, protocol = read_scored(path), load_protocol()
            if scored.version != protocol.version:
                raise HyalineError(f"{path}: was scored with protocol {scored.version}; expected {protocol.version}")
            if scored.track not in protocol.tracks:
                known = ", ".join(protocol.tracks)
                raise HyalineError(f"{path}: is of the track {shown(scored.track)}; expected one of {known}")
            found[path.stem] = scored
    if len({scored.name for scored in found.values()}) == len(found):
        return list(found.values())
    return [dataclasses.replace(scored, name=name) for name, scored in found.items()]


def track_rows(folder: Path) -> dict[Row, str]:
    """For the list of pages: a row for each track that has submissions, and the page's text."""
    found, protocol = read_scores(folder), load_protocol()
    rows: dict[Row, str] = {}
    for track in protocol.tracks:
        inside = [scored for scored in found if scored.track == track]
        if not inside:
            continue
        scenes = max(len(scored.scenes) for scored in inside)
        seeds = {scene.seed for scored in inside for scene in scored.scenes.values() if scene.seed is not None}
        rows[
            (
                f"[{TRACKS}: {track}]({(folder / track).as_posix()}.md)",
                f"{scenes} datasets",
                "scores",
                str(len(seeds)) if seeds else MISSING,
                ", ".join(sorted({scored.packed_by for scored in inside})),
            )
        ] = track_page(track, found, protocol)
    return rows


def track_page(track: str, found: Sequence[Scored], protocol: Protocol) -> str:
    """The page of one track, with every score's dataset, seed and processor time."""
    check_comparable(found, protocol)
    inside = [scored for scored in found if scored.track == track]
    if not inside:
        raise HyalineError(f"{track}: the track has no submission")
    preset = inside[0].preset
    grids = [
        track_grid("all scenes", inside, protocol),
        _methods_grid(inside, protocol),
        *(scene_grid(scored, protocol) for scored in inside),
    ]
    return "\n".join(
        [
            f"# hyaline-bench {protocol.version}, {preset}: {track}\n",
            "Allowed inputs:\n",
            *(f"- {markdown_escaped(told)}" for told in _told(track, protocol)),
            "",
            f"```\nmodel sweep {'bench-fitted' if track == 'masks' else 'bench'} --preset {preset}",
            f"hyaline-bench leaderboard --preset {preset} --track {track}\n```\n",
            f"{OTHERS}\n",
            *(f"{markdown_escaped(note)}\n" for note in NOTES),
            *(grid_text(grid, "markdown", width=TABLE_WIDTH) for grid in grids),
        ]
    )


def _told(track: str, protocol: Protocol) -> list[str]:
    """What the track allows, and the tracks before it."""
    names = list(protocol.tracks)
    allowed = [protocol.tracks[name].removeprefix("And ") for name in names[: names.index(track) + 1]]
    return [text[0].upper() + text[1:] for text in allowed]


def _methods_grid(found: Sequence[Scored], protocol: Protocol) -> Grid:
    """Scenes by methods."""
    scenes = [scene for scene in protocol.all_scenes(found[0].preset) if any(scene in each.scenes for each in found)]
    values = [[_psnr_db(scored, scene) for scored in found] for scene in scenes]
    return Grid(
        title="PSNR of each scene, dB",
        columns=(Column(group="scene", is_number=False), *(Column(group=scored.name) for scored in found)),
        rows=tuple(
            (scene, *(format_number(value, 2) for value in row)) for scene, row in zip(scenes, values, strict=True)
        ),
        best=_best(values),
    )


def _psnr_db(scored: Scored, scene: str) -> float | None:
    return scored.scenes[scene].psnr_db(ALL) if scene in scored.scenes else None


def _best(values: Sequence[Sequence[float | None]]) -> frozenset[tuple[int, int]]:
    """Places of the highest value of each row, after a first column of names."""
    best = set()
    for place, row in enumerate(values):
        known: Mapping[int, float] = {column: value for column, value in enumerate(row) if value is not None}
        if len(known) > 1:
            best.add((place, 1 + max(known, key=lambda column: known[column])))
    return frozenset(best)
