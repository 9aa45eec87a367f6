"""The page of one run: its pictures, its training, what it was told, and how to make it again."""

import json
import shlex
from collections.abc import Mapping, Sequence

from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.pages.document import anchor, command, definitions, section
from datagen.pages.html import Markup, Part, join, prose, tag
from datagen.pages.pictures import Gallery
from eval.page.html_tables import html_table
from eval.page.training import read_training, training_charts
from eval.page.views import Compared, ShownView, draw_views
from eval.score.runs import Run
from eval.score.scores import METRICS, RunScores, SceneScores
from eval.tables.grids import Column, Grid, format_number


def run_anchor(scene: SceneScores, run: Run) -> str:
    """Where in the page a run stands."""
    return anchor("run", scene.title, run.folder.parent.name, run.name)


def run_page(
    scene: SceneScores, scores: RunScores, views: Mapping[Compared, Sequence[ShownView]], gallery: Gallery
) -> Markup:
    """Everything that is known of one run.

    Args:
        views: those to show of each split that it predicted.
    """
    run, place = scores.run, run_anchor(scene, scores.run)
    pictures: list[Part] = [
        join(
            [
                tag("h3", item.title, _mean_psnr(item)),
                draw_views(gallery, item, shown),
                _how_many(item, len(shown)),
                _every_picture(item),
            ]
        )
        for item, shown in views.items()
    ]
    parts: list[Part] = [
        tag("p", "On ", scene.title, class_="note"),
        *pictures,
        tag("h3", "Training"),
        training_charts(read_training(run.folder), _training_ceiling_db(run)),
        tag("h3", "What it was told"),
        definitions(_facts(scores)),
        tag("h3", "Make it again"),
        _how_to_make(run),
    ]
    return tag("div", section(run.name, *parts, id_=place), class_="page", id=f"{place}-page")


def _how_many(item: Compared, shown: int) -> Markup | None:
    count = len(item.scores.images["psnr_db"])
    if shown == count:
        return None
    more = prose(f"{shown} of {count} views; `eval report --views {count}` shows as many as find room.")
    return tag("p", more, class_="note")


def _training_ceiling_db(run: Run) -> float | None:
    """None where nobody knows, or training views are not there any more."""
    try:
        return run.dataset.noise_ceiling_db("train")
    except HyalineError:
        return None


def _every_picture(item: Compared) -> Markup:
    return tag("details", tag("summary", f"Every picture of {item.title}"), html_table(every_picture_grid(item)))


def every_picture_grid(item: Compared) -> Grid:
    """Every metric of every picture of a split."""
    metrics = [metric for metric in METRICS if metric.is_printed]
    views = range(len(item.scores.images[metrics[0].key]))
    return Grid(
        title=f"{item.title}: every picture",
        columns=(Column(group="view"), *(Column(group=metric.title) for metric in metrics)),
        rows=tuple(
            (str(view), *(format_number(item.scores.images[m.key][view], m.decimals) for m in metrics))
            for view in views
        ),
    )


def _mean_psnr(item: Compared) -> str:
    mean = item.scores.mean("psnr_db")
    return f": {format_number(mean, 2)} dB" + (" in the mean" if len(item.scores.images["psnr_db"]) > 1 else "")


def _facts(scores: RunScores) -> list[tuple[str, Part]]:
    run = scores.run
    known: list[tuple[str, Part]] = [
        ("method", run.method),
        ("label", run.label),
        ("knows", run.knowledge),
        ("geometry", run.geometry),
        ("layers", run.num_layers),
        ("parameters", None if run.num_parameters is None else f"{run.num_parameters:,}"),
        ("seed", run.seed),
        ("dataset", run.dataset.seal[:12]),
        ("predictions", scores.predictions_sha256[:12]),
    ]
    return [(term, value if value is not None else "not told") for term, value in known]


def _how_to_make(run: Run) -> Markup:
    if run.method is None or run.config is None:
        return tag("p", "A foreign method's pictures: its folder does not tell how they were made.", class_="note")
    words = ["model", "train", run.method, "--dataset", f"data/{run.dataset.name}"]
    choices = definitions([(key, value) for key, value in flattened(run.config)])
    if run.flags is None:
        words += [] if run.geometry in (None, "truth") else ["--geometry", run.geometry]
        words += [] if not run.seed else ["--seed", str(run.seed)]
        note = tag("p", "With the parameters below, where they are not the method's defaults.", class_="note")
    else:
        words += run.flags
        note = None
    return join([command(shlex.join(words)), note, tag("details", tag("summary", "All parameters"), choices)])


def flattened(config: Mapping[str, Json], above: str = "") -> list[tuple[str, str]]:
    """Every choice by its path, such as `net.branches`."""
    choices: list[tuple[str, str]] = []
    for key, value in config.items():
        if isinstance(value, dict):
            choices += flattened(value, f"{above}{key}.")
        elif key != "type":
            choices.append((f"{above}{key}", value if isinstance(value, str) else json.dumps(value)))
    return choices
