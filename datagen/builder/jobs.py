"""What is done for one view of a dataset: rendered or peeled, and committed. Runs in workers."""

from pathlib import Path

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import read_meshes
from datagen.data.layer_writing import write_layers
from datagen.data.writing import commit_view
from datagen.scene.folder import open_scene

Task = tuple[Split, int]


class RenderJob:
    """What a worker keeps between the views that it renders."""

    def __init__(self, threads: int, root: Path) -> None:
        from datagen.machine.mitsuba_variant import use_mitsuba
        from datagen.render.truth import Renderer

        self.variant = use_mitsuba(threads=threads)
        self.dataset = open_dataset(root)
        self.cameras = _all_cameras(self.dataset)
        self.renderer = Renderer(open_scene(self.dataset), max_depth=self.dataset.config.max_depth)


def render_task(job: RenderJob, task: Task) -> None:
    """Renders one view and commits it."""
    from datagen.render.truth import picture_bytes, radiance_bytes, render_view, view_seed

    split, view = task
    config = job.dataset.config
    seed, spp = view_seed(config.seed, split, view), config.split(split).spp
    assert spp is not None, "an imported dataset is not rendered"
    truth = render_view(
        job.renderer,
        job.cameras[split],
        view,
        spp=spp,
        view_seed=seed,
        ceiling_db=config.ceiling_db if split != "train" else None,
    )
    commit_view(
        job.dataset,
        split,
        view,
        png=picture_bytes(truth),
        exr=radiance_bytes(truth),
        seed=seed,
        spp=truth.spp,
        noise_mse=truth.noise_mse,
        variant=job.variant,
    )


class PeelJob:
    """What a worker keeps between the views that it peels."""

    def __init__(self, threads: int, root: Path, geometry: str) -> None:
        from datagen.machine.mitsuba_variant import use_mitsuba
        from datagen.trace.peel import Peeler

        use_mitsuba(threads=threads)
        self.dataset, self.geometry = open_dataset(root), geometry
        self.cameras = _all_cameras(self.dataset)
        self.peeler = Peeler(read_meshes(self.dataset, geometry))
        self.num_layers = self.dataset.layer_store(geometry).head.num_layers


def peel_task(job: PeelJob, task: Task) -> None:
    """Peels one view into layers and commits them."""
    split, view = task
    layers, overflow_share = job.peeler.peel(job.cameras[split], view, job.num_layers)
    write_layers(job.dataset, job.geometry, split, view, layers, overflow_share=overflow_share)


def _all_cameras(dataset: Dataset) -> dict[Split, Cameras]:
    return {split: dataset.cameras(split) for split in dataset.splits}
