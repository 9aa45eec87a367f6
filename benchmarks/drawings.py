"""Pictures of runs: error maps of two runs side by side, learned skies beside the true one, and films."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from benchmarks.sky import radiance_of_sky
from datagen.build.film import path_trace
from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.film import check_film, write_film
from datagen.data.images import srgb_from_linear
from datagen.data.paths import view_name
from datagen.data.variants import ANGLES, has_variant, open_variant, variant_root
from datagen.disk.errors import HyalineError
from datagen.scene.camera_path import make_path
from datagen.scene.folder import load_scene
from eval.figures import DPI, Panel, Row, draw_sheet, figure_png
from eval.score.metrics import psnr
from eval.score.runs import Run, has_split, open_run, read_prediction, within
from eval.tables.grids import psnr_text
from model.methods.light_path.net import LightPathRenderer
from model.run.predict import film_pictures, load_renderer
from model.run.run_folder import check_trained_on, read_run

HEADS = ("truth", "before", "after", "error before, levels of 255", "error after")


def draw_errors(before: Path, after: Path, *, views: int) -> bytes:
    """The PNG of the `views` worst views of the run in `before`, worst first, with both runs' errors on one scale."""
    runs = [open_run(folder, Path("data")) for folder in (before, after)]
    if runs[0].dataset.seal != runs[1].dataset.seal:
        raise HyalineError(
            f"{after}: was made for {runs[1].dataset.root}; expected {runs[0].dataset.root}, as {before}"
        )
    rows = [_row(*place, runs) for place in find_worst(runs, views)]
    title = f"{runs[0].dataset.name}: the {len(rows)} worst views before, and after"
    return draw_sheet(title, HEADS, rows, size=runs[0].dataset.config.resolution)


def find_worst(runs: list[Run], views: int) -> list[tuple[Split, int]]:
    """Split and number of the views that the first run predicts worst, among those of splits that all predicted."""
    found: list[tuple[float, Split, int]] = []
    for split, home in _homes(runs[0].dataset).items():
        homed = [_run_at(run, home) for run in runs]
        if all(has_split(run, split) for run in homed):
            for view in range(home.config.split(split).views):
                pair = read_prediction(homed[0], split, view), home.view(split, view).image
                found.append((psnr(*pair), split, view))
    if not found:
        raise HyalineError(
            f"{runs[0].folder}: shares no predicted split with {runs[-1].folder}; run `model predict` on both"
        )
    return [(split, view) for _, split, view in sorted(found)[:views]]


def _homes(dataset: Dataset) -> dict[Split, Dataset]:
    """The dataset or the variant that has a test split, those by angle where they were built."""
    angles = [open_variant(dataset, ANGLES)] if has_variant(dataset, ANGLES) else []
    return {**dict.fromkeys(TEST_SPLITS, dataset), **{split: variant for variant in angles for split in variant.splits}}


def _run_at(run: Run, home: Dataset) -> Run:
    return run if home.parent is None else within(run, variant_root(run.folder, home.name), home)


def _row(split: Split, view: int, runs: list[Run]) -> Row:
    home = _homes(runs[0].dataset)[split]
    truth = home.view(split, view).image
    drawn = [read_prediction(_run_at(run, home), split, view) for run in runs]
    errors = [np.abs(picture.astype(np.float64) - truth).mean(axis=-1) for picture in drawn]
    return Row(
        split=split,
        panels=(
            Panel(image=truth, caption=f"view {view_name(view)}"),
            *(Panel(image=picture, caption=psnr_text(psnr(picture, truth))) for picture in drawn),
            *(Panel(image=error, caption=f"mean {error.mean():.1f}, largest {error.max():.0f}") for error in errors),
        ),
    )


SIZE = (180, 360)
"""Rows and columns of a map: one for each degree."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

Sky = Float[np.ndarray, "h w 3"]
"""Linear radiance by direction: straight up in the first row, azimuth from -180 to 180 degrees."""


def draw_skies(runs: tuple[Path, ...], names: tuple[str, ...] = ()) -> bytes:
    """The PNG of the true sky and of each run's learned one: colours, and luminance with the scale of the true one.

    Args:
        names: of the runs, instead of their folders' names.
    """
    names = names or tuple(folder.as_posix() for folder in runs)
    if not runs or len({"true", *names}) != len(runs) + 1:
        raise HyalineError(f"names: are {', '.join(names)} for {len(runs)} runs; expected another one for each run")
    dataset = open_dataset(Path(read_run(runs[0]).dataset))
    skies = {"true": true_sky(dataset)} | {
        name: learned_sky(folder, dataset) for name, folder in zip(names, runs, strict=True)
    }
    return _draw(skies, title=dataset.name)


def true_sky(dataset: Dataset) -> Sky:
    """The sky that the dataset was rendered with."""
    return radiance_of_sky(load_scene(dataset.root / "scene"), map_directions())


def learned_sky(folder: Path, dataset: Dataset) -> Sky:
    """The sky that a run has learned."""
    record = read_run(folder)
    if record.dataset_seal != dataset.seal:
        raise HyalineError(f"{folder}: was made for {record.dataset}; expected {dataset.root}, as the first run")
    renderer = load_renderer(folder, record.config, dataset)
    if not isinstance(renderer, LightPathRenderer) or not record.config.net.composite:  # pyright: ignore[reportAttributeAccessIssue]
        raise HyalineError(f"{folder}: is of method {record.method} and learns no sky; expected light-path by physics")
    directions = torch.from_numpy(map_directions().reshape(-1, 3).astype(np.float32))
    with torch.inference_mode():
        return renderer.environment(directions).numpy().reshape(*SIZE, 3)


def map_directions() -> Float[np.ndarray, "h w 3"]:
    """Unit directions through the centres of a map's pixels."""
    height, width = SIZE
    polar = (np.arange(height) + 0.5)[:, None] * np.pi / height
    azimuth = (np.arange(width) + 0.5)[None] * 2 * np.pi / width - np.pi
    up = np.broadcast_to(np.cos(polar), SIZE)
    return np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), up], axis=-1)


def _draw(skies: dict[str, Sky], *, title: str) -> bytes:
    brightest = float((skies["true"] @ LUMINANCE).max())
    figure = Figure(
        figsize=(1150 / DPI, (60 + 270 * len(skies)) / DPI), dpi=DPI, facecolor="white", layout="constrained"
    )
    figure.suptitle(f"{title}: the light from outside, by direction", weight="bold")
    grid = figure.subplots(len(skies), 2, squeeze=False)
    for (name, sky), (colors, levels) in zip(skies.items(), grid, strict=True):
        luminance = sky @ LUMINANCE
        colors.imshow(srgb_from_linear(np.clip(sky / brightest, 0, 1)), extent=(-180, 180, -90, 90))
        colors.set_ylabel(f"{name}\nelevation (degrees)")
        colors.set_title(f"colours, {brightest:.1f} is white", fontsize=10)
        image = levels.imshow(luminance, extent=(-180, 180, -90, 90), cmap="inferno", vmin=0, vmax=brightest)
        levels.set_title(f"luminance, at most {luminance.max():.2f}", fontsize=10)
        figure.colorbar(image, ax=levels, shrink=0.8)
        for axes in (colors, levels):
            axes.set(xticks=range(-180, 181, 90), yticks=range(-90, 91, 45))
    for axes in grid[-1]:
        axes.set_xlabel("azimuth (degrees)")
    return figure_png(figure)


Picture = UInt8[np.ndarray, "h w 3"]

CAPTION = 20
"""Rows under each picture for its name."""

GAP = 4
"""Columns between two pictures."""


def draw_turntable(
    runs: tuple[Path, ...],
    names: tuple[str, ...],
    out: Path,
    *,
    path: str,
    frames: int,
    size: int,
    spp: int,
    fps: float,
    overwrite: bool,
) -> None:
    """Write the film.

    Args:
        names: of the runs, under their pictures, instead of their folders' names.
        size: width in pixels of each of the pictures.
    """
    names = names or tuple(folder.name for folder in runs)
    if not runs or len(names) != len(runs):
        raise HyalineError(f"names: are {', '.join(names)} for {len(runs)} runs; expected one for each run")
    check_film(out, fps, frames=frames, overwrite=overwrite)
    dataset = open_dataset(Path(read_run(runs[0]).dataset))
    cameras = make_path(dataset, path, frames, width=size, height=None)
    columns = [list(path_trace(dataset, cameras, spp=spp))]
    for folder in runs:
        config = read_run(folder).config
        check_trained_on(folder, config, dataset)
        columns.append(list(film_pictures(folder, config, dataset, cameras, device=torch.device("cpu"))(0)))
    pages = _side_by_side(columns, ("truth, path-traced", *names))
    write_film(out, lambda _: pages, fps, frames=frames, key="", overwrite=True)


def _side_by_side(columns: list[list[Picture]], names: tuple[str, ...]) -> Iterator[Picture]:
    height, width = columns[0][0].shape[:2]
    font = ImageFont.load_default(13)
    for pictures in zip(*columns, strict=True):
        page = Image.new("RGB", (len(names) * (width + GAP) - GAP, height + CAPTION), "white")
        pen = ImageDraw.Draw(page)
        for place, (picture, name) in enumerate(zip(pictures, names, strict=True)):
            left = place * (width + GAP)
            page.paste(Image.fromarray(picture), (left, 0))
            pen.text((left + width / 2, height + CAPTION / 2), name, fill="black", font=font, anchor="mm")
        yield np.asarray(page)
