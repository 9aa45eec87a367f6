"""Reports: the scores of runs as tables, data and a page."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.data.config import MAX_VIEWS
from datagen.data.paths import DATA_ROOT
from datagen.disk.checked import checked
from datagen.disk.errors import HyalineError
from datagen.terminal.command import say
from hyaline.runs import RUNS, Run

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]

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
        """What `report --format csv` prints: a row for each run, two for each group of seeds (mean and deviation), and
        one for each scene's noise ceiling."""
        return list(csv.DictReader(io.StringIO(self._csv())))

    def to_frame(self) -> "pandas.DataFrame":
        """The same as a DataFrame of pandas.

        Raises:
            HyalineError: pandas is not installed.
        """
        try:
            import pandas  # pyright: ignore[reportMissingImports]
        except ModuleNotFoundError:
            raise HyalineError("hyaline.Report.to_frame: needs pandas; `pip install pandas` brings it") from None
        return pandas.read_csv(io.StringIO(self._csv()))

    def _csv(self) -> str:
        from eval.tables.results import results_csv

        return results_csv(self.scored.scenes)

    def _repr_html_(self) -> str:
        from eval.tables.looks import html_table
        from eval.tables.scenes import scene_grids

        return "".join(html_table(grid) for scene in self.scored.results["scenes"] for grid in scene_grids(scene)[:1])


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
        report.to_frame()[["run", "psnr_db_interpolating"]]

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
    from eval.page.report_folder import check_report_folder

    from eval.page.report import score_runs, write_page
    from eval.score.runs import has_predictions, list_run_folders, open_run

    if not 1 <= views <= MAX_VIEWS:
        raise HyalineError(f"views: is {views}; expected 1 to {MAX_VIEWS:,} of each split and run")
    if runs is None:
        every = list_run_folders(Path(root), besides=Path(out or Path(root) / "report"))
        given = list(filter(has_predictions, every))
    else:
        given = [runs] if isinstance(runs, (Run, str, Path)) else list(runs)
    if not given:
        raise HyalineError(f"{root}: no run there has pictures; make one with hyaline.train")
    folders = [item.folder if isinstance(item, Run) else _folder(item, Path(root)) for item in given]
    for folder in folders:
        if not has_predictions(folder):
            raise HyalineError(f"{folder}: has no predictions; expected predictions/SPLIT/0000.png, ...")
    datasets = [item.dataset if isinstance(item, Run) else None for item in given]
    beside = Path(root) if runs is None else folders[0].parent.parent
    place = Path(out) if out is not None else beside / "report"
    check_report_folder(place)
    errors = []
    opened = [open_run(folder, Path(data), dataset) for folder, dataset in zip(folders, datasets, strict=True)]
    others = list_run_folders(Path(root), besides=place) if runs is None else []
    scored = score_runs(opened, errors, others, made_by={"command": "hyaline.report"})
    for error in errors[:-1] if scored is None else errors:
        say(f"error: {error}")
    if scored is None:
        raise errors[-1]
    page = write_page(scored, place, most_views=views)
    return Report(page=page, scored=scored)


def _folder(name: Path | str, root: Path) -> Path:
    return Path(name) if Path(name).is_dir() else root / name
