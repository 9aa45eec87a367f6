"""The tables that `report --table NAME` prints: those of the paper, and those that other distributions bring."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from datagen.data.config import Split
from datagen.terminal.plugins import Group
from eval.score.runs import Run
from eval.score.scores import SceneScores
from eval.tables.grids import Grid

EditedPsnr = Mapping[str, Mapping[str, Mapping[Split, float | None]]]
"""PSNR in dB where the edited object is or was, by the run's name, the edit and the split; None where none is seen."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table over runs: which of them it needs, and how it is made of their scores."""

    shows: Callable[[Run], bool]
    """True for a run that the table may show; only those are scored."""
    grids: Callable[[Sequence[SceneScores], Callable[[SceneScores], EditedPsnr]], list[Grid]]
    """The table, from the scores of each dataset's runs. Calling the second argument scores their edits, too."""
    picture: Callable[[SceneScores], bytes | None] = lambda _: None
    """A PNG beside the table; None: there is none."""
    is_swept: bool = True
    """True if `model sweep` trains its runs."""
    needs_more: bool = False
    """True if its runs need edits, larger pictures or proxies, which `model sweep` makes of its own datasets alone."""


TABLES: Group[Table] = Group(
    name="hyaline.tables",
    what="table",
    built_in={},
    guide="docs/adding-a-table.md",
    kind="eval.tables.named:Table",
)
