"""A run's page beside Python: how close the pictures are, view by view, and how far each is from the truth."""

import dataclasses
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from benchmarks.pages.browser import open_file, running_browser, watched_page
from benchmarks.pages.edited import edited_dataset, page_edits
from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.scene.edits import parse_edit
from datagen.terminal.command import track
from eval.score.metrics import psnr
from model.methods.light_path.config import LightPathConfig
from model.methods.paper.config import PaperConfig
from model.methods.renderer import Renderer
from model.methods.table import open_inputs
from model.run.edits import show_edited_scene
from model.run.predict import check_can_draw, load_renderer, predict_pixels
from model.run.run_folder import RunRecord, read_run
from model.web.export import export_run
from model.web.packing import Quality


@dataclass(frozen=True, kw_only=True)
class Compared:
    """One view of a page, in dB."""

    split: Split
    view: int
    to_python: float
    page_to_truth: float
    python_to_truth: float
    """Of an edited scene no truth is known: NaN."""
    seconds: float
    """That the page took for the picture."""


@dataclass(frozen=True, kw_only=True)
class PageReport:
    """A page of some quality."""

    quality: Quality
    size: int
    """Bytes."""
    samples: int
    edits: tuple[str, ...]
    views: list[Compared]
    complaints: list[str]


def compare_page(
    run: Path, dataset: Path | None, quality: Quality, *, samples: int, views: int, edits: tuple[str, ...] = ()
) -> PageReport:
    """Draws a run's test views by Python and by its page in a headless browser, each with `samples` rays a pixel.

    Args:
        dataset: where the run's dataset lies now; None: where the run found it.
        views: of each split; 0: all.
        edits: of the scene, which both draw, as `datagen build --edit` takes them.
    """
    record = read_run(run)
    opened = open_dataset(dataset or Path(record.dataset))
    renderer = load_renderer(run, record.config, opened)
    chosen = [
        (split, view)
        for split in TEST_SPLITS
        for view in range(min(views or opened.num_views[split], opened.num_views[split]))
    ]
    compared = []
    with tempfile.TemporaryDirectory() as folder, running_browser() as browser, watched_page(browser) as page:
        file = Path(folder) / "scene.html"
        export_run(run, record, opened, file, quality)
        open_file(page, file)
        asked, changes, is_light_path = opened, {}, isinstance(record.config.net, LightPathConfig)
        if edits:
            parsed = tuple(map(parse_edit, edits))
            asked = edited_dataset(opened, parsed, Path(folder), with_layers=not is_light_path)
            check_can_draw(record.config, opened, asked)
            show_edited_scene(renderer, opened, asked, record.geometry)
            changes = page_edits(opened, parsed, knows_materials=is_light_path)
        for split, view in track(chosen, label="compare", total=len(chosen)):
            mine = python_picture(renderer, record, asked, split, view, samples)
            truth = None if edits else opened.view(split, view).image
            before = time.perf_counter()
            drawn = page.picture(f"{split}/{view}", mine.shape[:2], samples, changes)
            seconds = time.perf_counter() - before
            compared.append(
                Compared(
                    split=split,
                    view=view,
                    to_python=psnr(drawn, mine),
                    page_to_truth=math.nan if truth is None else psnr(drawn, truth),
                    python_to_truth=math.nan if truth is None else psnr(mine, truth),
                    seconds=seconds,
                )
            )
        size, complaints = file.stat().st_size, page.complaints
    return PageReport(quality=quality, size=size, samples=samples, edits=edits, views=compared, complaints=complaints)


def python_picture(
    renderer: Renderer, record: RunRecord, dataset: Dataset, split: Split, view: int, samples: int
) -> UInt8[np.ndarray, "h w 3"]:
    """A view with the same number of rays in every pixel."""
    config = record.config.net
    assert isinstance(config, LightPathConfig | PaperConfig)
    even = dataclasses.replace(config, render_samples=samples)
    if isinstance(even, LightPathConfig):
        even = dataclasses.replace(even, refined_samples=1)
    pixels = even.load(open_inputs(even, dataset, record.geometry), split, [view], with_images=False, mapped=False)
    return predict_pixels(renderer, pixels).reshape(*dataset.config.resolution.shape, 3)


def page_table(report: PageReport) -> str:
    """The report as a table, the splits' means last."""
    rows = [(f"{item.split} {item.view}", [item]) for item in report.views]
    for split in dict.fromkeys(item.split for item in report.views):
        rows.append((f"{split}, mean", [item for item in report.views if item.split == split]))
    lines = [
        f"{report.quality}: {report.size:,} bytes, {report.samples} rays a pixel, "
        f"{len(report.complaints)} complaints of the browser" + "".join(f", {edit}" for edit in report.edits),
        "",
        "| view | page to Python | page to truth | Python to truth | seconds |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, items in rows:
        columns = [
            [getattr(item, key) for item in items]
            for key in ("to_python", "page_to_truth", "python_to_truth", "seconds")
        ]
        lines.append(
            f"| {name} | "
            + " | ".join("" if np.isnan(column).any() else f"{np.mean(column):.2f}" for column in columns)
            + " |"
        )
    worst = min(item.to_python for item in report.views)
    return "\n".join([*lines, "", f"worst view: {worst:.2f} dB to Python"])
