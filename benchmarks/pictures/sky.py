"""The sky that a run has learned beside the true one, as latitude-longitude maps on one scale."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure

from datagen.data.dataset import Dataset, open_dataset
from datagen.data.images import srgb_from_linear
from datagen.disk.errors import HyalineError
from datagen.render.environment import radiance_of_sky
from datagen.scene.folder import load_scene
from eval.figures.sheets import DPI, figure_png
from model.methods.light_path.net import LightPathRenderer
from model.run.predict import load_renderer
from model.run.run_folder import read_run

SIZE = (180, 360)
"""Rows and columns of a map: one for each degree."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

Sky = Float[np.ndarray, "h w 3"]
"""Linear radiance by direction: straight up in the first row, azimuth from -180 to 180 degrees."""


def draw_skies(runs: tuple[Path, ...], names: tuple[str, ...] = ()) -> bytes:
    """The PNG of the true sky and of each run's learned one: colours, and luminance with the scale of the true one.

    Args:
        names: of the runs, instead of their folders' names.

    Raises:
        HyalineError: a run is not of `light-path`, or of another dataset than the first.
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
    """What the dataset was rendered under."""
    return radiance_of_sky(load_scene(dataset.root / "scene"), map_directions())


def learned_sky(folder: Path, dataset: Dataset) -> Sky:
    """What a run has learned."""
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
