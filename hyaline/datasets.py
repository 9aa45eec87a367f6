"""Datasets: finding, opening and building them; layers along the rays of any camera."""

import dataclasses
import functools
from pathlib import Path
from typing import TYPE_CHECKING, cast

from PIL import Image

from datagen.data import dataset as contract
from datagen.data import paths as finding
from datagen.data.cameras import Camera, check_camera
from datagen.data.config import Resolution, Split, square
from datagen.data.geometries import GeometryKey, geometry_key, read_meshes
from datagen.data.layer_writing import check_settings
from datagen.data.layers import Layers, round_mantissa
from datagen.data.paths import DATA_ROOT, TRUTH
from datagen.terminal.command import say_all
from datagen.terminal.distribution import naming_parts
from hyaline.pictures import in_a_row
from hyaline.scenes import Hemisphere, Scene

if TYPE_CHECKING:
    from datagen.trace.peel import Peeler

NUM_LAYERS = 8
"""Layers kept per ray unless told."""


class View(contract.View):
    """One view of a dataset. Each attribute is read from disk, and every byte verified, when it is accessed.

    >>> view = open_dataset("glass_table").view("interpolating", 0)
    >>> origin, directions = view.camera.rays()         # rays need no layers: (3,) metres, (h, w, 3) unit vectors
    >>> directions.shape, view.layers().depth.shape
    ((32, 32, 3), (4, 32, 32))
    >>> view.show().height                              # the picture, glass, depth, normals and each layer
    256
    """

    def show(self) -> Image.Image:
        """The picture and what is stored with it, side by side: glass, depth, normals and the objects of each layer."""
        from datagen.look.view_pictures import stored_pictures

        stored = stored_pictures(self, has_layers=contract.has_layers(self.dataset))
        return in_a_row([item.pixels for item in stored.values()])


class Dataset(contract.Dataset):
    """An opened dataset. Views are read, and verified, when they are accessed.

    >>> dataset = open_dataset("glass_table")
    >>> dataset.num_views["train"], dataset.config.resolution.width
    (8, 32)
    >>> [item.name for item in dataset.objects]         # object ids are 1, 2, ... in this order
    ['pane', 'floor']
    """

    def __repr__(self) -> str:
        return (
            f"Dataset({str(self.root)!r}, {', '.join(f'{count} {split}' for split, count in self.num_views.items())})"
        )

    def view(self, split: Split, index: int) -> View:
        """One view of a split.

        Raises:
            HyalineError: no such split or view.
        """
        found = super().view(split, index)
        return View(dataset=self, split=found.split, index=found.index)

    def views(self, split: Split) -> list[View]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Every view of a split, in order."""
        return cast(list[View], super().views(split))

    @naming_parts("hyaline.Dataset.layers")
    def layers(self, camera: Camera, geometry: str = TRUTH, num_layers: int | None = None) -> Layers:
        """The surfaces along each pixel's straight ray, for any camera; for a view's camera, its stored layers.

        Args:
            geometry: whose surfaces: `truth`, or proxies such as `box`.
            num_layers: layers kept per ray; as many as are stored unless given, 8 where none are.

        Returns:
            `uv` (layer, h, w, 2), `object_id` and `depth` (layer, h, w), nearest first.

        Raises:
            HyalineError: a camera that cannot render, or a geometry that was not made.
        """
        check_camera(camera)
        if num_layers is None:
            is_peeled = contract.has_layers(self) if geometry == TRUTH else True
            num_layers = self.layer_store(geometry).head.num_layers if is_peeled else NUM_LAYERS
        check_settings(num_layers=num_layers, workers=1)
        layers, _ = _peeler(geometry_key(self, geometry)).peel(camera.alone, 0, num_layers)
        return dataclasses.replace(layers, depth=round_mantissa(layers.depth))  # As stored layers are.

    def show(self) -> Image.Image:
        """The first view of each split, side by side."""
        return in_a_row([self.view(split, 0).image for split in self.splits])


@functools.lru_cache(maxsize=2)
def _peeler(key: GeometryKey) -> "Peeler":
    from datagen.machine.mitsuba_variant import use_mitsuba
    from datagen.trace.peel import Peeler

    use_mitsuba(quiet=True)
    return Peeler(read_meshes(key.dataset, key.geometry))


def list_datasets(root: Path | str = DATA_ROOT) -> list[str]:
    """The names of the datasets in a folder, sorted; `data` in the working folder unless given.

    >>> list_datasets()
    ['glass_table']
    """
    return [path.name for path in finding.list_datasets(Path(root))]


def open_dataset(name: Path | str | None = None, root: Path | str = DATA_ROOT) -> Dataset:
    """A dataset, its metadata verified.

    >>> dataset = open_dataset("glass_table")           # data/glass_table, or a folder
    >>> dataset.view("train", 3).image.shape
    (32, 32, 3)

    Args:
        name: a name under `root`, or a folder; the only dataset under `root` unless given.

    Raises:
        HyalineError: no dataset there, damaged metadata, or another format version.
    """
    return opened(contract.open_dataset(finding.find_dataset(None if name is None else str(name), Path(root))))


def opened(dataset: contract.Dataset) -> Dataset:
    """The dataset as a `hyaline.Dataset`."""
    if isinstance(dataset, Dataset):
        return dataset
    return Dataset(**{item.name: getattr(dataset, item.name) for item in dataclasses.fields(dataset)})


@naming_parts("datagen")
def build(
    scene: Scene | Path | str,
    folder: Path | str | None = None,
    *,
    preset: str = "demo",
    resolution: int | tuple[int, int] | None = None,
    views: int | None = None,
    test_views: int | None = None,
    spp: int | None = None,
    test_spp: int | None = None,
    ceiling_db: float | None = None,
    max_depth: int = 24,
    num_layers: int = NUM_LAYERS,
    seed: int = 0,
    workers: int = 1,
    overwrite: bool = False,
) -> Dataset:
    """Path-traces every view of a scene and peels its layers. If interrupted, the same call resumes.

        dataset = hyaline.build(scene, "data/vase", preset="demo")
        dataset = hyaline.build("glass_table", preset="tiny", workers=2)

    Args:
        scene: a `Scene`, the name of a built-in or random one such as `glass_table` or `random-0007`, a folder with a
            scene.json, or a file of another program such as `vase.glb`.
        folder: where the dataset is written; data/NAME of the scene unless given.
        preset: its size: tiny (seconds), small, demo (minutes), standard or paper.
        resolution: pixels, one number for squares, or (width, height); the preset's unless given.
        views: training views; the scene's or the preset's number unless given.
        test_views: views in each test split; the scene's or the preset's number unless given.
        spp: samples per pixel of training views, a power of two; the preset's number unless given.
        test_spp: the same of test views; with `ceiling_db`, the number to start from.
        ceiling_db: render each test view until its noise ceiling is this high.
        max_depth: maximum number of segments of a light path.
        num_layers: layers kept per ray.
        seed: of cameras and noise; the same seed gives the same bytes.
        workers: parallel processes; the bytes do not depend on their number.
        overwrite: replace a dataset in `folder` that has other settings.

    Raises:
        HyalineError: a scene that would render wrong, a setting out of range, or something else in `folder`.
    """
    from datagen.build.build import build_dataset, summary
    from datagen.build.presets import configure, fit_to_scene
    from datagen.scene.finding import find_scene

    if isinstance(scene, Scene) and isinstance(scene.cameras, Hemisphere):
        views = scene.cameras.views if views is None else views
        test_views = scene.cameras.test_views if test_views is None else test_views
    config = configure(
        preset,
        resolution=_pixels(resolution),
        views=views,
        test_views=test_views,
        spp=spp,
        test_spp=test_spp,
        ceiling_db=ceiling_db,
        max_depth=max_depth,
        seed=seed,
    )
    if isinstance(scene, Scene):
        described = scene.described()
    else:
        built = None if overwrite else Path(folder or DATA_ROOT / scene)
        described = find_scene(str(scene), built=built, resolution=config.resolution)
    are_views_chosen = views is not None or test_views is not None
    config = fit_to_scene(config, described, keep_resolution=resolution is not None, keep_views=are_views_chosen)
    made = build_dataset(
        described,
        Path(folder or DATA_ROOT / described.name),
        config,
        num_layers=num_layers,
        workers=workers,
        overwrite=overwrite,
    )
    say_all(summary(made, TRUTH))
    return opened(made)


def _pixels(resolution: int | tuple[int, int] | None) -> Resolution | None:
    if resolution is None or isinstance(resolution, int):
        return None if resolution is None else square(resolution)
    return Resolution(width=resolution[0], height=resolution[1])
