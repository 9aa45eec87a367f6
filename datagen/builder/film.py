"""Films through a dataset's scene: their cameras, and their path-traced pictures."""

import functools
from collections.abc import Iterator
from pathlib import Path

from datagen.builder.build import refuse_unlit
from datagen.builder.choices import FilmChoices
from datagen.data.cameras import Cameras
from datagen.data.config import check_spp
from datagen.data.dataset import Dataset
from datagen.data.film import Picture, check_film, film_key, write_film
from datagen.data.images import srgb_from_linear, to_8bit
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.camera_path import make_path
from datagen.scene.folder import open_scene
from datagen.scene.soundness import check_cameras_outside
from datagen.terminal.command import track


def plan_film(dataset: Dataset, choices: FilmChoices, out: Path) -> Cameras:
    """The cameras of a film that can be written to `out`.

    Raises:
        HyalineError: a path, a number or a file that cannot be.
    """
    refuse_unlit(dataset, what="a film")
    cameras = make_path(dataset, choices.path, choices.frames, width=choices.width, height=choices.height)
    check_cameras_outside(open_scene(dataset), cameras.world_from_camera[:, :3, 3])
    check_film(out, choices.fps, frames=choices.frames, overwrite=choices.overwrite)
    return cameras


def film_scene(dataset: Dataset, cameras: Cameras, out: Path, *, fps: float, spp: int, overwrite: bool = False) -> None:
    """Path-trace a film and write it.

    Raises:
        HyalineError: too few samples per pixel, or too many.
    """
    check_spp(spp)
    draw, key = functools.partial(path_trace, dataset, cameras, spp=spp), film_key(cameras, dataset.seal, spp)
    write_film(out, draw, fps, frames=len(cameras), key=key, overwrite=overwrite)


def path_trace(dataset: Dataset, cameras: Cameras, first: int = 0, *, spp: int) -> Iterator[Picture]:
    """8-bit sRGB pictures, one a camera from the `first` on, each with noise of its own; seeds follow the dataset's."""
    use_mitsuba()
    from datagen.render.truth import Renderer, derive_seed, render_view

    renderer = Renderer(open_scene(dataset), max_depth=dataset.config.max_depth)
    for view in track(range(first, len(cameras)), label="render", total=len(cameras), done=first):
        seed = derive_seed(dataset.config.seed, "film", view)
        truth = render_view(renderer, cameras, view, spp=spp, view_seed=seed, ceiling_db=None)
        yield to_8bit(srgb_from_linear(truth.radiance))
