"""Owns the making of annexes: splits by angle, and the test splits at larger sizes."""

import dataclasses

from datagen.build.angles import make_angle_cameras
from datagen.build.build import peel_dataset, render_dataset
from datagen.build.shards import Shard
from datagen.data.cameras import Cameras
from datagen.data.clear import clear_dataset
from datagen.data.config import TEST_SPLITS, DatasetConfig, Split, SplitConfig, config_difference
from datagen.data.dataset import Dataset, head_files, open_dataset, read_cameras
from datagen.data.dataset_head import dataset_files, head_contents, view_files, write_head
from datagen.data.geometries import list_geometries
from datagen.data.layer_store import LayersHead, read_layers_head
from datagen.data.paths import layers_root
from datagen.data.variants import ANGLES, annex_root, evenly, list_annex_folders, scale_name
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, holding, is_ours, refuse_taken
from datagen.disk.storage import load_sealed, sha256
from datagen.scene.folder import load_scene

MAX_SCALE = 8


def build_angles(dataset: Dataset, *, workers: int, shard: Shard | None = None) -> Dataset:
    """Renders and peels the splits by angle (datagen/build/angles.py), each of as many views as `extrapolating` has.

    Raises:
        HyalineError: the scene has no place for such cameras, or another process writes there.
    """
    cameras = make_angle_cameras(load_scene(dataset.root / "scene", is_sealed=True), dataset.config)
    return _build(dataset, ANGLES, dataset.config, cameras, workers=workers, shard=shard)


def build_scaled(dataset: Dataset, scale: int, *, views: int | None, workers: int,
                 shard: Shard | None = None) -> Dataset:  # fmt: skip
    """Renders and peels the test splits so many times as wide and high, with as many samples per pixel.

    Args:
        views: of each split, evenly chosen; all unless told.

    Raises:
        HyalineError: an unfit scale or number of views, or another process writes there.
    """
    if not 2 <= scale <= MAX_SCALE:
        raise HyalineError(f"super_resolution: is {scale}; expected 2 to {MAX_SCALE} times the dataset's size")
    sizes: dict[str, SplitConfig] = {}
    cameras: dict[Split, Cameras] = {}
    for split in TEST_SPLITS:
        there = dataset.config.split(split)
        count = there.views if views is None else views
        if not 1 <= count <= there.views:
            raise HyalineError(f"super_resolution_views: is {count}; expected 1 to {there.views}, as {split} has")
        sizes[split] = dataclasses.replace(there, views=count)
        poses = read_cameras(dataset, split)
        cameras[split] = dataclasses.replace(
            poses,
            world_from_camera=poses.world_from_camera[evenly(count, there.views)],
            width=scale * poses.width,
            height=scale * poses.height,
        )
    config = dataclasses.replace(dataset.config, resolution=scale * dataset.config.resolution, **sizes)
    return _build(dataset, scale_name(scale), config, cameras, workers=workers, shard=shard)


def peel_annexes(dataset: Dataset, *, workers: int, shard: Shard | None = None) -> None:
    """Peels straight layers in every annex, of each geometry that has them in the dataset itself, and in as many."""
    for folder in list_annex_folders(dataset.root):
        annex = open_dataset(folder)
        for geometry in list_geometries(dataset):
            if not (layers_root(dataset.root, geometry, "straight") / "layers.json").is_file():
                continue
            head, _ = read_layers_head(dataset, geometry, "straight")
            assert isinstance(head, LayersHead)
            stands = (layers_root(annex.root, geometry, "straight") / "layers.json").is_file()
            is_other = stands and read_layers_head(annex, geometry, "straight")[0].num_layers != head.num_layers  # pyright: ignore
            peel_dataset(
                annex,
                geometry,
                kinds=("straight",),
                num_layers=head.num_layers,
                overwrite=is_other and shard is None,
                workers=workers,
                shard=shard,
            )


def _build(dataset: Dataset, name: str, config: DatasetConfig, cameras: dict[Split, Cameras], *,
           workers: int, shard: Shard | None) -> Dataset:  # fmt: skip
    root = annex_root(dataset.root, name)
    with holding(root, DATASET, within=dataset.root, shared=shard is not None):
        annex = _open_or_start(dataset, name, config, cameras, is_alone=shard is None)
        render_dataset(annex, workers=workers, shard=shard)
    return annex


def _open_or_start(dataset: Dataset, name: str, config: DatasetConfig, cameras: dict[Split, Cameras], *,
                   is_alone: bool) -> Dataset:  # fmt: skip
    """The annex, when it is of these cameras and of this dataset; an empty one where none is, or an outdated one.

    Args:
        is_alone: False: other processes may be doing the same; nothing is deleted.
    """
    root = annex_root(dataset.root, name)
    if is_ours(root, DATASET) and load_sealed(root / DATASET.head).get("annex_of") == dataset.seal:
        annex = open_dataset(root)
        if difference := config_difference(annex.config, config):
            raise HyalineError(f"{root}: holds an annex with another configuration ({difference}); delete the folder")
        wanted = {path: sha256(data) for path, data in head_contents({}, cameras).items()}
        if head_files(root) == wanted:
            return write_head(root, config, dataset.objects, cameras, {}, parent=dataset)
    if is_ours(root, DATASET):
        if not is_alone:
            raise HyalineError(f"{root}: holds an outdated annex; build without --shard, which replaces it")
        refuse_taken(root, DATASET, [*view_files(config, tuple(cameras)), *head_contents({}, cameras)],
                     dataset_files(root))  # fmt: skip
        clear_dataset(root)
    return write_head(root, config, dataset.objects, cameras, {}, parent=dataset, replace=is_alone)
