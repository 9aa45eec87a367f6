"""The views of a report's page: which are shown of each run, and truth, prediction and error of each."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.pages.html import Markup, anchor, tag
from datagen.pages.pictures import Gallery
from eval.score.runs import Run, read_prediction
from eval.score.scores import SplitScores
from eval.tables.grids import psnr_text


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """One split that a run predicted, of its dataset or of a variant."""

    run: Run
    split: Split
    scores: SplitScores
    digests: Sequence[str]
    """SHA-256 of each picture."""

    @property
    def dataset(self) -> Dataset:
        return self.run.dataset

    @property
    def title(self) -> str:
        return self.split if self.dataset.variant is None else f"{self.dataset.name}: {self.split}"

    def psnr_db(self, view: int) -> float | None:
        return self.scores.images["psnr_db"][view]


@dataclass(frozen=True, kw_only=True)
class ShownView:
    """A view that found room in the page, and what it stands for among the others."""

    view: int
    rank: str
    """Worst, median, best, or nothing."""


def ranked_views(scores: SplitScores) -> list[ShownView]:
    """All views of a split: the worst, the median and the best by PSNR, then the others from the worst on."""
    values = [-math.inf if value is None else value for value in scores.images["psnr_db"]]
    rising = sorted(range(len(values)), key=lambda view: (values[view], view))
    named: dict[int, str] = {}
    for rank, view in (("worst", rising[0]), ("best", rising[-1]), ("median", rising[(len(rising) - 1) // 2])):
        named.setdefault(view, rank)
    first = sorted(named, key=lambda view: ("worst", "median", "best").index(named[view]))
    return [ShownView(view=view, rank=named.get(view, "")) for view in (*first, *(v for v in rising if v not in named))]


def store_views(gallery: Gallery, compared: Sequence[Compared], most: int) -> dict[Compared, list[ShownView]]:
    """Puts truth and prediction of up to so many views of each into the gallery; those that found room.

    The first views of all go before the second ones, so that what a full page lacks are the least important.
    """
    shown: dict[Compared, list[ShownView]] = {item: [] for item in compared}
    for item, candidate in _by_rank(compared, most):
        if store_view(gallery, item, candidate.view):
            shown[item].append(candidate)
    return shown


def store_view(gallery: Gallery, item: Compared, view: int) -> bool:
    """Puts truth and prediction of a view into the gallery; False where there is no room for both."""
    return store_truth(gallery, item.dataset, item.split, view) and gallery.add(
        _prediction_name(item, view), lambda: read_prediction(item.run, item.split, view)
    )


def store_truth(gallery: Gallery, dataset: Dataset, split: Split, view: int) -> bool:
    """Puts a true picture into the gallery; False where there is no room."""
    return gallery.add(truth_name(dataset, split, view), lambda: dataset.view(split, view).image)


def truth_name(dataset: Dataset, split: Split, view: int) -> str:
    """What the gallery calls a true picture."""
    return anchor("truth", dataset.seal, split, view_name(view))


def draw_views(gallery: Gallery, item: Compared, shown: Sequence[ShownView]) -> Markup:
    """Truth, prediction and error of each of these views, which the gallery has."""
    return tag("div", *(_draw_view(gallery, item, view) for view in shown), class_="views")


def prediction_panel(gallery: Gallery, item: Compared, view: int) -> Markup:
    """A prediction alone with its score; it has to be in the gallery."""
    label = f"{item.run.name}, {item.title} view {view_name(view)}"
    picture = gallery.show(_prediction_name(item, view), label=label)
    caption = tag("figcaption", item.run.name, ": ", psnr_text(item.psnr_db(view)))
    return tag("figure", picture, caption)


def _draw_view(gallery: Gallery, item: Compared, shown: ShownView) -> Markup:
    what = f"{item.title} view {view_name(shown.view)}"
    truth, pred = truth_name(item.dataset, item.split, shown.view), _prediction_name(item, shown.view)
    panels = [
        ("truth", gallery.show(truth, label=f"truth, {what}")),
        ("prediction", gallery.show(pred, label=f"prediction, {what}")),
        ("error × 8", gallery.show(truth, pred, label=f"error, {what}", class_="error")),  # noqa: RUF001
    ]
    rank = f" ({shown.rank})" if shown.rank else ""
    caption = f"{what}{rank}: {psnr_text(item.psnr_db(shown.view))}"
    drawn = tag("div", *(tag("div", picture, tag("span", name)) for name, picture in panels), class_="panels")
    return tag("figure", tag("figcaption", caption), drawn, class_="compare")


def _prediction_name(item: Compared, view: int) -> str:
    return anchor("prediction", item.digests[view])


def _by_rank(compared: Sequence[Compared], most: int) -> Iterator[tuple[Compared, ShownView]]:
    ranked = [(item, ranked_views(item.scores)) for item in compared]
    for rank in range(most):
        for item, views in ranked:
            if rank < len(views):
                yield item, views[rank]
