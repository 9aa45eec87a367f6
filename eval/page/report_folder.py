"""A report's folder: the files that reports have written there, and no others, are replaced.

REPORT/report.json     sealed, written first: the names of all files that reports have written there
REPORT/results.json    every score (eval/tables/results.py)
REPORT/index.html      the page (eval/page/page.py)
REPORT/*.png           contact sheets and figures
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from datagen.disk.names import check_name
from datagen.disk.ownership import FolderKind, begin, holding, is_ours, refuse_others, refuse_taken
from datagen.disk.records import Json, from_json
from datagen.disk.storage import commit, commit_sealed, load_sealed, seal_bytes

REPORT = FolderKind(what="report", head="report.json", way_out="choose another --out, or empty the folder")
REPORT_VERSION = 1


def check_report_folder(out: Path) -> None:
    """Refuses a folder that holds something else, before anything is scored.

    Raises:
        HyalineError: naming what stands there.
    """
    refuse_others(out, REPORT)


def write_report(out: Path, files: Mapping[str, Callable[[], bytes]]) -> Iterator[Path]:
    """Commits the files of a report, each as it is made; yields their paths.

    Raises:
        HyalineError: something else stands there, or another report is being written.
    """
    with holding(out, REPORT):
        own = _report_files(out) if is_ours(out, REPORT) else []
        refuse_taken(out, REPORT, files, own)
        names: list[Json] = [*sorted({*own, *files})]
        content: dict[str, Json] = {"version": REPORT_VERSION, "files": names}
        if is_ours(out, REPORT):
            commit_sealed(out / REPORT.head, content)
        else:
            begin(out, REPORT, seal_bytes(content), {})
        for name, make in files.items():
            commit(out / check_name(name, where="report"), make())
            yield out / name


def _report_files(out: Path) -> list[str]:
    path = out / REPORT.head
    return list(from_json(tuple[str, ...], load_sealed(path).get("files"), where=f"{path}: files"))
