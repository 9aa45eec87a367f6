"""A report's folder, in which only the files of earlier reports are replaced.

REPORT/report.json     with checksum, written first: the names of all files that reports have written there
REPORT/results.json    every score (eval/tables/results.py)
REPORT/index.html      the page (eval/page/page.py)
REPORT/*.png, *.svg    contact sheets and figures
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from datagen.disk.names import check_name
from datagen.disk.ownership import FolderKind, begin, holding, is_ours, refuse_others, refuse_taken
from datagen.disk.records import Json, from_json
from datagen.disk.storage import commit, commit_sealed, load_sealed, seal_bytes

REPORT = FolderKind(what="report", head="report.json", way_out="choose another --out, or empty the folder")
REPORT_VERSION = 1

Draw = Callable[[], bytes]
"""Makes the content of a file."""


def check_report_folder(out: Path) -> None:
    """Raises a HyalineError if the folder contains something else, before anything is scored."""
    refuse_others(out, REPORT)


def write_report(out: Path, files: Mapping[str, Draw]) -> Iterator[Path]:
    """Commits the files of a report one by one, and yields their paths."""
    with holding(out, REPORT):
        own = _report_files(out) if is_ours(out, REPORT) else []
        refuse_taken(out, REPORT, files, own)
        names: list[Json] = [*sorted({*own, *files})]
        content: dict[str, Json] = {"version": REPORT_VERSION, "files": names}
        if not is_ours(out, REPORT):
            begin(out, REPORT, seal_bytes(content))
        elif sorted(own) != names:
            commit_sealed(out / REPORT.head, content)
        for name, draw in files.items():
            path = out / check_name(name, where="report")
            commit(path, draw())
            yield path


def _report_files(out: Path) -> list[str]:
    path = out / REPORT.head
    return list(from_json(tuple[str, ...], load_sealed(path).get("files"), where=f"{path}: files"))
