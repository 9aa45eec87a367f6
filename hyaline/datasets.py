"""Datasets: finding, opening and building them; layers along the rays of any camera; proxies of their objects."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.data import dataset as contract
from datagen.data import paths as finding
from datagen.data.cameras import Camera
from datagen.data.config import SPLITS as SPLITS
from datagen.data.config import TEST_SPLITS as TEST_SPLITS
from datagen.data.config import Split as Split
from datagen.data.dataset import Dataset, has_layers
from datagen.data.dataset import View as View
from datagen.data.geometries import geometry_key, read_meshes
from datagen.data.layers import Layers, check_settings, round_mantissa
from datagen.data.meshes import Mesh as Mesh
from datagen.data.paths import DATA_ROOT, PROXY_KINDS, TRUTH
from datagen.disk.errors import HyalineError as HyalineError
from datagen.disk.records import checked
from datagen.quantities import LightEnds as LightEnds
from datagen.quantities import ViewQuantities as ViewQuantities
from datagen.quantities import peeler_of
from datagen.quantities import quantities as quantities
from datagen.terminal.command import choose
from datagen.terminal.command import hush as hush
from datagen.terminal.parsing import flags_of
from datagen.terminal.plugins import naming_parts
from hyaline.scenes import Hemisphere, Scene
from model.settings import with_settings

if TYPE_CHECKING:
    from proxies.make import ProxyReport

NUM_LAYERS = 8
"""Layers kept per ray unless told."""


@checked
@naming_parts("hyaline.layers")
def layers(dataset: Dataset, camera: Camera, geometry: str = TRUTH, num_layers: int | None = None) -> Layers:
    """The surfaces along each pixel's straight ray, for any camera; for a view's camera, its stored layers.

    Args:
        geometry: whose surfaces: `truth`, or proxies such as `box`.
        num_layers: layers kept per ray; as many as are stored unless given, 8 where none are.

    Returns:
        `uv` (layer, h, w, 2), `object_id` and `depth` (layer, h, w), nearest first.

    Raises:
        HyalineError: a geometry that was not made.
    """
    if num_layers is None:
        is_peeled = geometry != TRUTH or has_layers(dataset)
        num_layers = dataset.layer_store(geometry).head.num_layers if is_peeled else NUM_LAYERS
    check_settings(num_layers=num_layers, workers=1)
    found, _ = peeler_of(geometry_key(dataset, geometry)).peel(camera.alone, 0, num_layers)
    return dataclasses.replace(found, depth=round_mantissa(found.depth))  # As stored layers are.


@checked
def list_datasets(root: Path | str = DATA_ROOT) -> list[str]:
    """The names of the datasets in a folder, sorted; `data` in the working folder unless given.

    >>> list_datasets()
    ['glass_table']
    """
    return [path.name for path in finding.list_datasets(Path(root))]


@checked
def open_dataset(name: Path | str | None = None, root: Path | str = DATA_ROOT) -> Dataset:
    """A dataset, its metadata verified.

    >>> dataset = open_dataset("glass_table")           # data/glass_table, or a folder
    >>> dataset.view("train", 3).image.shape
    (32, 32, 3)
    >>> dataset.num_views["train"], dataset.config.resolution.width
    (8, 32)
    >>> [item.name for item in dataset.objects]         # object ids are 1, 2, ... in this order
    ['pane', 'floor']

    Args:
        name: a name under `root`, or a folder; the only dataset under `root` unless given.

    Raises:
        HyalineError: no dataset there, damaged metadata, or another format version.
    """
    return contract.open_dataset(finding.find_dataset(None if name is None else str(name), Path(root)))


@checked
@naming_parts("datagen")
def build(
    scene: Scene | Path | str,
    folder: Path | str | None = None,
    *,
    preset: str = "demo",
    seed: int = 0,
    workers: int = 1,
    overwrite: bool = False,
    **size: int | float | str | None,
) -> Dataset:
    """Path-traces every view of a scene and peels its layers. If interrupted, the same call resumes.

        dataset = hyaline.build(scene, "data/vase", preset="demo")
        dataset = hyaline.build("glass_table", preset="tiny", views=16, resolution="64x48", workers=2)

    Args:
        scene: a `Scene`, the name of a built-in or random one such as `glass_table` or `random-0007`, a folder with a
            scene.json, or a file of another program such as `vase.glb`.
        folder: where the dataset is written; data/NAME of the scene unless given.
        preset: its size: tiny (seconds), small, demo (minutes), standard or paper.
        seed: of cameras and noise; the same seed gives the same bytes.
        workers: parallel processes; the bytes do not depend on their number.
        overwrite: replace a dataset with other settings in `folder`.
        size: what replaces single values of the preset: flags of `datagen build` with _ for -, `resolution`, `views`,
            `test_views`, `spp`, `test_spp`, `ceiling`, `num_layers` and `max_depth`.

    Raises:
        HyalineError: a scene that would render wrong, a setting out of range, or something else in `folder`.
    """
    from datagen.builder.build import build_dataset
    from datagen.builder.choices import SizeChoices, configure, fit_to_scene
    from datagen.scene.finding import find_scene

    for key in size:
        choose("datagen build: setting", key, [flag.replace("-", "_") for flag in flags_of(SizeChoices)])
    chosen = SizeChoices()
    if isinstance(scene, Scene) and isinstance(scene.cameras, Hemisphere):
        chosen = SizeChoices(views=scene.cameras.views, test_views=scene.cameras.test_views)
    chosen = with_settings(chosen, size)
    config = configure(preset, chosen, seed=seed)
    own = scene.described() if isinstance(scene, Scene) else None
    described = own or find_scene(str(scene), resolution=config.resolution)
    return build_dataset(
        described,
        Path(folder or DATA_ROOT / described.name),
        fit_to_scene(config, described, chosen),
        num_layers=chosen.num_layers,
        workers=workers,
        overwrite=overwrite,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Proxies:
    """The proxies of one geometry; `make_proxies` makes them."""

    dataset: Dataset
    geometry: str
    """The name to train with: `train(..., geometry=proxies.geometry)`."""
    reports: "tuple[ProxyReport, ...]" = field(repr=False)
    """For each object: kind, number of triangles, volume ratio, distances, and any problem of its proxy."""

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """One for each object, in the dataset's order."""
        return read_meshes(self.dataset, self.geometry)


@checked
@naming_parts("proxies")
def make_proxies(
    dataset: Dataset | Path | str,
    kind: str = "ellipsoid",
    *,
    num_layers: int = NUM_LAYERS,
    workers: int = 1,
    overwrite: bool = False,
) -> Proxies:
    """Fits a proxy to every object and peels the proxies for every view; images are not rendered again.

        proxies = hyaline.make_proxies(dataset, "ellipsoid")
        run = hyaline.train("paper", dataset, geometry=proxies.geometry)

    Args:
        dataset: a dataset, its name under data/, or its folder.
        kind: box, ellipsoid, hull or wrap.
        num_layers: layers kept per ray.
        workers: parallel processes that peel.
        overwrite: replace existing proxies and layers; they are kept otherwise.

    Raises:
        HyalineError: an unknown kind, or an object that cannot have a proxy of it.
    """
    from proxies.make import make_and_peel

    choose("kind", kind, PROXY_KINDS)
    if isinstance(dataset, (str, Path)):
        dataset = open_dataset(dataset)
    reports = make_and_peel(dataset, kind, num_layers=num_layers, workers=workers, overwrite=overwrite)
    return Proxies(dataset=dataset, geometry=kind, reports=reports)
