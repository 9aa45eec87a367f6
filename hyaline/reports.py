"""Scores of one picture, and reports: those of runs as tables, data and a page."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, UInt8

from datagen.data.paths import DATA_ROOT
from datagen.disk.errors import HyalineError
from datagen.disk.records import checked
from datagen.terminal.command import say
from eval.score import metrics
from hyaline.runs import RUNS, Run

if TYPE_CHECKING:
    from eval.page.report import Scored


@dataclass(frozen=True, kw_only=True)
class Scores:
    """The scores of one picture."""

    psnr_db: float
    """Peak signal-to-noise ratio, peak 255; inf where both are identical."""
    ssim: float | None
    """Wang et al. 2004, at most 1; None for pictures of fewer than 11 pixels a side."""
    delta_e: float
    """CIE DE2000 under D65, mean over pixels."""
    flip: float | None
    """LDR-FLIP at 67 pixels per degree, 0 to 1; None without the package flip-evaluator."""
    lpips: float | None
    """LPIPS 0.1 with AlexNet; None without the package lpips and torchvision's weights."""
    masked_psnr_db: float | None
    """PSNR of the pixels in the mask alone; None without a mask, or with an empty one."""


@checked
def score(
    pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None = None
) -> Scores:
    """Scores a picture; a split's score is the mean of its pictures' scores.

    >>> import numpy as np
    >>> target = np.full((16, 16, 3), 100, np.uint8)
    >>> scores = score(target + np.uint8(10), target, mask=np.ones((16, 16), bool))
    >>> round(scores.psnr_db, 2) == round(scores.masked_psnr_db, 2) == 28.13   # 10 log10(255^2 / 10^2)
    True

    Args:
        pred: 8-bit sRGB.
        target: 8-bit sRGB, the ground truth.
        mask: pixels for `masked_psnr_db`, for example `view.mask("glass")`.

    Raises:
        HyalineError: pictures that are not 8-bit, a mask that is not bool, or sizes that differ.
    """
    if pred.shape != target.shape or not target.size:
        raise HyalineError(f"pred: has shape {pred.shape}; expected {target.shape}, that of target, and not empty")
    if mask is not None and mask.shape != target.shape[:2]:
        raise HyalineError(f"mask: has shape {mask.shape}; expected {target.shape[:2]}, that of target")
    is_large = min(target.shape[:2]) >= metrics.SSIM_WINDOW
    return Scores(
        psnr_db=metrics.psnr(pred, target),
        ssim=metrics.ssim(pred, target) if is_large else None,
        delta_e=float(metrics.delta_e_2000(pred, target).mean()),
        flip=metrics.flip(pred, target),
        lpips=metrics.lpips(pred, target),
        masked_psnr_db=metrics.masked_psnr(pred, target, mask) if mask is not None and mask.any() else None,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """The scores of runs; a notebook shows it as tables. `report` makes it."""

    page: Path
    """The page with pictures, tables and analyses; open it in a browser."""
    scored: "Scored" = field(repr=False)
    """The scores themselves: of each dataset, run, split, picture and metric."""

    @property
    def rows(self) -> list[dict[str, str | float | None]]:
        """A row for each run: its record, and the mean of each metric on each split, such as `psnr_db_interpolating`;
        "inf" in dB of identical pictures. pandas makes a frame of them: `pandas.DataFrame(report.rows)`."""
        rows = []
        for scene in self.scored.results["scenes"]:
            for run in scene["runs"]:
                about, splits = {key: value for key, value in run.items() if key != "splits"}, run["splits"].items()
                means = {f"{key}_{split}": each["mean"] for split, of in splits if of for key, each in of.items()}
                rows.append({"scene": scene["scene"], **about, **means})
        return rows

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
        say(f"error: {error}", is_error=True)
    if scored is None:
        raise errors[-1]
    return Report(page=write_page(scored, place), scored=scored)
