"""A report's folder, in which only the files of earlier reports are replaced.

REPORT/report.json     with checksum, written first: the names of all files that reports have written there
REPORT/results.json    every score (eval/tables/results.py)
REPORT/index.html      the page (eval/page/page.py)
REPORT/*.png, *.svg    contact sheets and figures
REPORT/kept/KEY.json   cached results (eval/score/kept.py)
REPORT/kept/drawn.json with checksum: what each picture and the page show, and their SHA-256, so that unchanged ones
                       are not drawn again
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name
from datagen.disk.ownership import (
    FolderKind,
    begin,
    holding,
    is_ours,
    refuse_links,
    refuse_others,
    refuse_taken,
    remove_files,
)
from datagen.disk.records import Json, from_json
from datagen.disk.storage import commit, commit_sealed, dump_json, load_sealed, seal_bytes, sha256, sha256_file
from eval.score.kept import FOLDER, KEPT_FILE, Kept, code_digest

REPORT = FolderKind(
    what="report", head="report.json", folders=(FOLDER,), way_out="choose another --out, or empty the folder"
)
REPORT_VERSION = 1
DRAWN = f"{FOLDER}/drawn.json"


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A file of a report."""

    draw: Callable[[], bytes]
    about: Json = None
    """Everything that the file depends on except code; unchanged files are not drawn again. None: always drawn."""


def check_report_folder(out: Path) -> None:
    """Raises a HyalineError if the folder contains something else, before anything is scored."""
    refuse_others(out, REPORT)


def kept_in(out: Path) -> Kept:
    """The cached results of earlier reports in a folder."""
    return Kept(out / FOLDER if is_ours(out, REPORT) else None)


def write_report(out: Path, files: Mapping[str, Drawing]) -> Iterator[Path]:
    """Commits the files of a report one by one; yields the paths of new and changed ones."""
    with holding(out, REPORT):
        own = _report_files(out) if is_ours(out, REPORT) else []
        refuse_taken(out, REPORT, files, own)
        names: list[Json] = [*sorted({*own, *files})]
        content: dict[str, Json] = {"version": REPORT_VERSION, "files": names}
        if not is_ours(out, REPORT):
            begin(out, REPORT, seal_bytes(content), {})
        elif sorted(own) != names:
            commit_sealed(out / REPORT.head, content)
        drawn = _read_drawn(out)
        for name, drawing in files.items():
            path = out / check_name(name, where="report")
            shown = _digest(drawing)
            if shown is not None and drawn.get(name) == [shown, _digest_of_file(path)]:
                continue
            data = drawing.draw()
            commit(path, data)
            drawn[name] = [shown, sha256(data)]
            yield path
        found: dict[str, Json] = {name: list[Json](pair) for name, pair in drawn.items() if name in names}
        if found != _read_drawn(out):
            refuse_links(out, Path(FOLDER))
            commit_sealed(out / DRAWN, {"files": found})


def keep(out: Path, kept: Kept, *, are_all: bool) -> None:
    """Writes new cached results next to a report; without a report, nothing is kept.

    Args:
        are_all: every run was scored, so unused results are removed.
    """
    if not is_ours(out, REPORT):
        return
    with holding(out, REPORT):
        refuse_links(out, Path(FOLDER))
        for name, content in kept.new.items():
            commit_sealed(out / FOLDER / name, content)
        if are_all:
            there = [path.name for path in (out / FOLDER).glob("*") if KEPT_FILE.fullmatch(path.name)]
            remove_files(out, [f"{FOLDER}/{name}" for name in there if name not in kept.used])


def _report_files(out: Path) -> list[str]:
    path = out / REPORT.head
    return list(from_json(tuple[str, ...], load_sealed(path).get("files"), where=f"{path}: files"))


def _read_drawn(out: Path) -> dict[str, list[str | None]]:
    """For each file in the folder, the hash of what it shows, and its own hash."""
    try:
        files = load_sealed(out / DRAWN).get("files")
        pairs = from_json(dict[str, tuple[str | None, ...]], files, where=f"{out / DRAWN}: files")
    except HyalineError:
        return {}  # Missing or damaged: everything is drawn again.
    return {name: list(pair) for name, pair in pairs.items()}


def _digest(drawing: Drawing) -> str | None:
    return None if drawing.about is None else sha256(dump_json([drawing.about, code_digest()]))


def _digest_of_file(path: Path) -> str | None:
    return sha256_file(path) if path.is_file() and not path.is_symlink() else None
