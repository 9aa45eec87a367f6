"""What plug-ins bring to the report: tables of runs, and parts about a dataset, such as the fits of its glass."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.data.config import Split
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.terminal.plugins import Group

if TYPE_CHECKING:
    from datagen.data.dataset import Dataset
    from datagen.pages.html import Image8
    from eval.score.runs import Run
    from eval.score.scores import SceneScores
    from eval.tables.grids import Grid
    from eval.tables.results import Stored

EditedPsnr = Mapping[str, Mapping[str, Mapping[Split, float | None]]]
"""PSNR in dB where the edited object is or was, by the run's name, the edit and the split; None where none is seen."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table over runs: which of them it needs, and how it is made of their scores."""

    shows: "Callable[[Run], bool]"
    """True for a run that the table may show; only those are scored."""
    grids: "Callable[[Sequence[SceneScores], Callable[[SceneScores], EditedPsnr]], list[Grid]]"
    """The table, from the scores of each dataset's runs. Calling the second argument scores their edits, too."""
    is_swept: bool = True
    """True if `model sweep` trains its runs."""
    needs_more: bool = False
    """True if its runs need edits, larger pictures or proxies, which `model sweep` makes of its own datasets alone."""


TABLES: Group[Table] = Group(
    name="hyaline.tables",
    what="table",
    guide="docs/extending.md",
    kind="eval.tables.plugins:Table",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class PartPage:
    """A page of the report about one folder."""

    title: str
    note: str
    grids: "tuple[Grid, ...]"
    pictures: "dict[str, Callable[[], Image8]]"
    """By their captions."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundPart:
    """What a plug-in knows of one dataset."""

    data: Json
    """For results.json, among the analyses of the scene."""
    pages: tuple[PartPage, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportPart:
    """A part of the report."""

    head: str
    """The file that marks its folders among those of runs, such as fit.json."""
    find: "Callable[[Sequence[Dataset], Sequence[Path], list[HyalineError]], list[FoundPart | None]]"
    """What there is of each dataset in some folders; adds the errors of folders that cannot be read."""
    scene_grids: "Callable[[str, Stored], list[Grid]]"
    """Tables of a RESULTS page from the title of a scene and the stored `FoundPart.data`."""
    all_grids: "Callable[[dict[str, Stored]], list[Grid]]"
    """The same from those of all scenes, by title."""


REPORT_PARTS: Group[ReportPart] = Group(
    name="hyaline.report_parts",
    what="part of the report",
    guide="docs/architecture.md",
    kind="eval.tables.plugins:ReportPart",
)


def report_parts() -> dict[str, ReportPart]:
    """All parts by name, which is also the key of their data in results.json."""
    return {name: REPORT_PARTS.find(name) for name in REPORT_PARTS.names()}
