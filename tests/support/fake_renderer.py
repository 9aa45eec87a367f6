"""A renderer and a peeler that take no time: what `datagen build` calls for each view, without Mitsuba.

The pictures and layers are those of the pane and the floor (tests/synthetic.py), whatever the scene's meshes are: a
function of dataset, split and view alone, as the real ones are.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import pixel_rays, shade, trace

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import read_meshes
from datagen.data.images import png_bytes
from datagen.data.layers import Layers
from datagen.data.writing import commit_view

Task = tuple[Split, int]


class FakeJob:
    """Stands for RenderJob and PeelJob."""

    def __init__(self, threads: int, root: Path, geometry: str | None = None) -> None:
        self.dataset, self.geometry = open_dataset(root), geometry
        if geometry is not None:
            read_meshes(self.dataset, geometry)  # As the real ones do, it refuses damaged meshes.


def render(job: FakeJob, task: Task) -> None:
    split, view = task
    layers = _trace(job.dataset, split, view, 4)
    noise = np.random.default_rng([view, len(split)]).bytes(50)
    commit_view(
        job.dataset,
        split,
        view,
        {".png": png_bytes(shade(layers)), ".exr": noise},
        seed=view,
        spp=4,
        noise_mse=1e-5,
        variant="none",
    )


def peel(job: FakeJob, task: Task) -> None:
    assert job.geometry is not None
    layers = _trace(job.dataset, *task, job.dataset.layer_store(job.geometry).head.num_layers)
    job.dataset.layer_store(job.geometry).write(*task, layers, overflow_share=0.0)


def _trace(dataset: Dataset, split: Split, view: int, num_layers: int) -> Layers:
    return trace(*pixel_rays(dataset.cameras(split), view), num_layers)


def film(cameras: Cameras) -> Iterator[np.ndarray]:
    for view in range(len(cameras)):
        yield np.full((cameras.height, cameras.width, 3), view, np.uint8)


def install(patch: pytest.MonkeyPatch) -> None:
    """Lets builds in this process call these."""
    import datagen.builder.build
    import datagen.builder.film
    import datagen.builder.variants
    import datagen.machine.mitsuba_variant

    for name, function in (("render", render), ("peel", peel)):
        patch.setattr(datagen.builder.build, f"{name.title()}Job", FakeJob)
        patch.setattr(datagen.builder.build, f"{name}_task", function)
    patch.setattr(datagen.machine.mitsuba_variant, "use_mitsuba", lambda **options: "none")
    patch.setattr(datagen.builder.variants, "_read_halves", _read_halves)
    patch.setattr(datagen.builder.film, "path_trace", lambda dataset, cameras, *, spp: film(cameras))


def _read_halves(dataset: Dataset, split: Split, view: int) -> np.ndarray:
    shape = dataset.config.resolution.shape
    return np.random.default_rng([view, len(split), len(dataset.objects)]).random((2, *shape, 3))
