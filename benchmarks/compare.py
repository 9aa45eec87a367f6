"""A run's page beside Python: how close the pictures are, view by view, and how far each is from the truth."""

import dataclasses
import math
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from benchmarks.browser import open_file, running_browser, watched_page
from datagen.builder.build import peel_dataset
from datagen.builder.variants import plan_edit
from datagen.data.config import TEST_SPLITS, Split, Variant
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.meshes import is_there
from datagen.data.paths import TRUTH
from datagen.data.variants import variant_root
from datagen.data.writing import write_head
from datagen.scene.edits import CLEAR_GLASS, GREY, Edit, edit_scene, parse_edit
from datagen.scene.folder import open_scene
from datagen.terminal.command import track
from eval.score.metrics import psnr
from hyaline_web.page.export import export_run
from hyaline_web.page.scene import Quality
from model.methods.light_path.config import LightPathConfig
from model.methods.paper.config import PaperConfig
from model.methods.protocol import open_inputs
from model.methods.renderer import Renderer
from model.run.predict import check_can_draw, load_renderer, predict_pixels, show_edited_scene
from model.run.run_folder import RunRecord, read_run


@dataclass(frozen=True, kw_only=True)
class Compared:
    """One view of a page, in dB."""

    split: Split
    view: int
    to_python: float
    page_to_truth: float
    python_to_truth: float
    """PSNR against the truth; NaN for an edited scene, which has none."""
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
        edits: of the scene, which both draw, as `datagen add --edit` takes them.
    """
    record = read_run(run)
    opened = open_dataset(dataset or Path(record.dataset))
    renderer = load_renderer(run, record.config, opened)
    chosen: list[tuple[Split, int]] = [
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
    pixels = even.load(open_inputs(even, dataset, record.geometry), split, [view], with_images=False)
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


def edited_dataset(base: Dataset, edits: tuple[Edit, ...], folder: Path, *, with_layers: bool) -> Dataset:
    """The dataset after edits, without any picture, in a folder of its own."""
    plan = plan_edit(base, edits)
    beside = folder / base.name
    beside.mkdir()
    shutil.copyfile(base.root / "dataset.json", beside / "dataset.json")
    record = Variant(of=base.seal, splits=tuple(plan.cameras), edit=plan.edit)
    root = variant_root(beside, plan.name)
    edited = write_head(root, plan.config, plan.objects, plan.cameras, plan.scene, variant=record)
    if with_layers:
        peel_dataset(edited, TRUTH, num_layers=base.layer_store().head.num_layers, overwrite=False)
    return edited


def page_edits(base: Dataset, edits: tuple[Edit, ...], *, knows_materials: bool) -> dict[str, dict[str, object]]:
    """The same, as a page's `picture` takes them: copies come first, made of objects that no edit has changed yet."""
    before = open_scene(base)
    edited = edit_scene(before, edits)
    old = {item.name: item for item in before.objects}
    known = {CLEAR_GLASS: "clear glass", GREY: "matt"}
    changes: dict[str, dict[str, object]] = {name: {"copyOf": original} for name, original in edited.copies.items()}
    for item in edited.scene.objects:
        change = changes.setdefault(item.name, {})
        original = old[edited.copies.get(item.name, item.name)]
        if is_there(original.mesh):
            change["shown"] = is_there(item.mesh)
        change["offset"] = np.array(edited.offsets.get(item.name, (0, 0, 0))).tolist()
        if knows_materials and item.material != original.material and item.material in known:
            change["material"] = known[item.material]
    return changes


def take_screenshot(page: Path, *, width: int, height: int, rays: int, link: str) -> bytes:
    """The PNG of a page in a window of this size, when all its pixels have this number of rays.

    Args:
        rays: 0 for a page that draws none, such as a report.
        link: the part after the # of the page's address.
    """
    with running_browser() as browser, watched_page(browser, width=width, height=height) as watched:
        if not rays:
            watched.page.goto(page.resolve().as_uri() + (f"#{link}" if link else ""))
            return watched.page.screenshot(animations="disabled")
        open_file(watched, page, link=link)
        # Drawn by the processor, a frame takes seconds for every 100,000 pixels.
        watched.evaluate("async (rays) => (await hyaline).frames.still(rays)", rays, patience_ms=1_800_000)
        return watched.page.screenshot(animations="disabled")
