"""Reports: the scores of runs as tables, data and a page."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.data.paths import DATA_ROOT
from datagen.disk.checked import checked
from datagen.disk.errors import HyalineError
from datagen.terminal.command import say
from hyaline.runs import RUNS, Run

if TYPE_CHECKING:
    from eval.page.report import Scored


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """The scores of runs; a notebook shows it as tables. `report` makes it."""

    page: Path
    """The page with pictures, tables and analyses; open it in a browser."""
    scored: "Scored" = field(repr=False)
    """The scores themselves: of each dataset, run, split, picture and metric."""

    @property
    def rows(self) -> list[dict[str, str]]:
        """What `report --format csv` prints: a row for each run, and one for each scene's noise ceiling. pandas makes a
        frame of them: `pandas.DataFrame(report.rows)`."""
        from eval.tables.results import results_csv

        return list(csv.DictReader(io.StringIO(results_csv(self.scored.scenes))))

    def _repr_html_(self) -> str:
        from eval.tables.grids import html_table

        return "".join(html_table(part.grids[0]) for part in self.scored.parts)


@checked
def report(
    runs: Run | Path | str | Sequence[Run | Path | str] | None = None,
    out: Path | str | None = None,
    *,
    root: Path | str = RUNS,
    data: Path | str = DATA_ROOT,
    views: int = 3,
) -> Report:
    """Scores runs against the truth and writes a page of them, as `eval report` does.

        report = hyaline.report([run])
        pandas.DataFrame(report.rows)[["run", "psnr_db_interpolating"]]

    Args:
        runs: opened runs (or one), names under `root`, or folders of 8-bit sRGB pictures of any method, SCENE/NAME
            with predictions/SPLIT/0000.png; all runs under `root` unless given.
        out: folder of the page; unless given, `report` in `root`, or beside the scenes' folders of the first run.
        root: folder of the runs.
        data: folder with the datasets, DATA/SCENE, of runs that name none.
        views: views of each split and run on the page, the worst, the median and the best first.

    Raises:
        HyalineError: no run, one without pictures or dataset, none that can be scored, or something else in `out`.
    """

    from datagen.disk.ownership import refuse_others
    from eval.page.report import REPORT, score_runs, write_page
    from eval.score.runs import has_predictions, list_run_folders, open_run

    root, others = Path(root), []
    if runs is None:
        others = list_run_folders(root, besides=Path(out or root / "report"))
        runs = list(filter(has_predictions, others))
    opened = []
    for item in [runs] if isinstance(runs, (Run, str, Path)) else runs:
        folder = item.folder if isinstance(item, Run) else Path(item) if Path(item).is_dir() else root / item
        if not has_predictions(folder):
            raise HyalineError(f"{folder}: has no predictions; expected predictions/SPLIT/0000.png, ...")
        opened.append(open_run(folder, Path(data), item.dataset if isinstance(item, Run) else None))
    if not opened:
        raise HyalineError(f"{root}: no run there has pictures; make one with hyaline.train")
    place = Path(out or (root if others else opened[0].folder.parent.parent) / "report")
    refuse_others(place, REPORT)
    errors: list[HyalineError] = []
    scored = score_runs(opened, errors, others, command="hyaline.report")
    for error in errors[:-1] if scored is None else errors:
        say(f"error: {error}")
    if scored is None:
        raise errors[-1]
    return Report(page=write_page(scored, place, most_views=views), scored=scored)
