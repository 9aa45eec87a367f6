"""An export: the parts that are planned, and the folder that they are written to.

    OUT/hyaline-export.json          sealed, written first: format, dataset, settings, and the name of every file
    OUT/hyaline-export/PART.json     sealed, written last: SHA-256 of a part's files; a part without it is made again
    OUT/...                          what the tool reads

Whatever else a tool puts there stays, with --overwrite too.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.names import check_relative
from datagen.disk.ownership import (
    FolderKind,
    begin,
    holding,
    is_ours,
    refuse_others,
    refuse_taken,
    remove_files,
)
from datagen.disk.records import Json, from_json, shown
from datagen.disk.storage import check_files, commit, commit_sealed, load_sealed, seal_bytes, seal_of, sha256
from datagen.terminal.command import track


@dataclass(frozen=True, kw_only=True)
class Part:
    """Files that are made together; they exist when all of them are there."""

    name: str
    """Unique in the export, and the name of a file without its ending."""
    files: tuple[str, ...]
    """Paths relative to the export."""
    make: Callable[[], Mapping[str, bytes]]
    """The bytes of each of `files`; the same at each call."""


def one_file(name: str, file: str, make: Callable[[], bytes]) -> Part:
    """A part of one file."""
    return Part(name=name, files=(file,), make=lambda: {file: make()})


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All parts of an export, in the order in which they are made."""

    parts: tuple[Part, ...]
    hint: str
    """How the tool opens it, with OUT for the folder."""
    has_flow: bool = False
    """The format has a place for refractive flow, and takes `Source.flow` into account."""

    @property
    def files(self) -> list[str]:
        """All files, sorted."""
        return sorted(file for part in self.parts for file in part.files)


EXPORT = FolderKind(what="export", head="hyaline-export.json")
RECORDS = "hyaline-export"
EXPORT_VERSION = 2
"""Exports of version 1 have no licence; --overwrite makes them again."""


def write_export(out: Path, plan: Plan, settings: dict[str, Json], *, overwrite: bool) -> None:
    """Writes what is missing of an export.

    Args:
        settings: what the export is made of and how; another export in the same folder is not gone on with.
        overwrite: make all of it again, in place of any export in the folder.
    """
    files: list[Json] = [*plan.files, *(_record_file(part) for part in plan.parts)]
    head: dict[str, Json] = {"version": EXPORT_VERSION, **settings, "files": files}
    with _held(out, plan):
        _start(out, head, overwrite=overwrite)
        missing = [part for part in plan.parts if not _is_finished(out, part, seal_of(head))]
        done = len(plan.parts) - len(missing)
        for part in track(missing, label=f"export {out}", total=len(plan.parts), done=done):
            _write_part(out, part, seal_of(head))


@contextmanager
def _held(out: Path, plan: Plan) -> Iterator[None]:
    folders = {str(Path(file).parent) for file in plan.files} - {"."}
    tops = {Path(folder).parts[0] for folder in folders}
    with holding(out, dataclasses.replace(EXPORT, folders=(*sorted(tops), RECORDS))):
        yield


def _start(out: Path, head: dict[str, Json], *, overwrite: bool) -> None:
    """Makes the folder one of this export: begun, gone on with, or cleared of the one before."""
    if not is_ours(out, EXPORT):
        refuse_others(out, EXPORT)
        begin(out, EXPORT, seal_bytes(head))
        return
    before = load_sealed(out / EXPORT.head)
    if before == head and not overwrite:
        return
    if not overwrite:
        raise HyalineError(
            f"{out}: holds another export ({_difference(before, head)}); pass --overwrite to replace it, or choose "
            "another --out"
        )
    own = _files_of(before, out)
    refuse_taken(out, EXPORT, _files_of(head, out), own)
    records = [file for file in own if file.startswith(f"{RECORDS}/")]
    remove_files(out, records)  # First: without its record, no part is there any more.
    remove_files(out, own)
    commit(out / EXPORT.head, seal_bytes(head))


def _files_of(head: dict[str, Json], out: Path) -> list[str]:
    where, files = f"{out / EXPORT.head}: files", head.get("files")
    if not isinstance(files, list):
        raise HyalineError(f"{where}: is {shown(files)}; expected a list of paths")
    return [check_relative(str(file), where=where) for file in files]


def _difference(before: dict[str, Json], now: dict[str, Json]) -> str:
    keys = [key for key in sorted({*before, *now} - {"files"}) if before.get(key) != now.get(key)]
    return "; ".join(f"{key}: {before.get(key)} -> {now.get(key)}" for key in keys) or "of other views"


def _record_file(part: Part) -> str:
    return f"{RECORDS}/{part.name}.json"


def _is_finished(out: Path, part: Part, export: str) -> bool:
    try:
        record = load_sealed(out / _record_file(part))
        files = from_json(dict[str, str], record.get("files"), where=_record_file(part))
        check_files(out, files)
    except HyalineError:
        return False
    return record.get("export") == export and sorted(files) == sorted(part.files)


def _write_part(out: Path, part: Part, export: str) -> None:
    contents = part.make()
    assert sorted(contents) == sorted(part.files), "a part makes the files that it names"
    for file, data in contents.items():
        commit(out / file, data)
    hashes: dict[str, Json] = {file: sha256(data) for file, data in sorted(contents.items())}
    commit_sealed(out / _record_file(part), {"export": export, "files": hashes})
