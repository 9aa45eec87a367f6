"""Writing a dataset: its head, the scene and cameras that the head lists, then view by view; and clearing it.

Clearing removes from each folder only the files that its own head lists; a folder whose head does not verify keeps all
of its files. Heads go last, so an interrupted clearing can be repeated.
"""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from datagen.data.cameras import Cameras
from datagen.data.config import (
    DATASET_VERSION,
    RENDERED,
    DatasetConfig,
    DatasetObject,
    Head,
    Imported,
    Split,
    Variant,
    ViewRecord,
)
from datagen.data.dataset import Dataset, open_dataset, read_head
from datagen.data.geometries import proxy_files
from datagen.data.layers import layers_files
from datagen.data.transforms import TRANSFORMS_FILES, transforms_bytes
from datagen.data.variants import edit_mask_files
from datagen.disk.ownership import DATASET, EDIT_MASKS, LAYERS, PROXIES, begin, holding, is_ours, remove_files
from datagen.disk.records import Json, commit_sealed, seal_of, to_json
from datagen.disk.storage import commit_all, commit_same, sha256


def write_head(
    root: Path,
    config: DatasetConfig,
    objects: tuple[DatasetObject, ...],
    cameras: dict[Split, Cameras],
    scene: Mapping[str, bytes],
    *,
    variant: Variant | None = None,
    imported: Imported | None = None,
    stated_license: str | None = None,
    replace: bool = False,
) -> Dataset:
    """Commits the head of a dataset, then the scene and the cameras that it lists; the caller holds the folder.

    Several processes may do the same at once. An existing head stays, and its dataset is returned; if it is the same
    one, lost or damaged files of it are written again.

    Args:
        scene: the files of the scene's folder, by path relative to it; none in a variant of the same scene.
        imported: the source of pictures that are not rendered here.
        stated_license: licence of the data; a variant has its parent's.
        replace: replaces a head of ours, after the caller has removed its views and other files.
    """
    files = head_contents(scene, cameras)
    record = Head(
        version=DATASET_VERSION,
        config=config,
        objects=objects,
        files={path: sha256(data) for path, data in files.items()},
        variant=variant,
        imported=imported,
        license=stated_license,
    )
    head = {key: to_json(value) for key, value in vars(record).items() if value is not None}
    begin(root, DATASET, head, replace=replace)
    dataset = open_dataset(root)
    if dataset.seal == seal_of(head):
        for path, data in files.items():
            commit_same(root / path, data)
    return dataset


def head_contents(scene: Mapping[str, bytes], cameras: Mapping[Split, Cameras]) -> dict[str, bytes]:
    """The files that a head lists, by path relative to the dataset.

    Cameras that the scene lists lie beside its folder, once: with the resolution and the depth range of the dataset.
    """
    files = {f"scene/{path}": data for path, data in scene.items() if path not in TRANSFORMS_FILES.values()}
    return files | {TRANSFORMS_FILES[split]: transforms_bytes(poses, split) for split, poses in cameras.items()}


def dataset_files(root: Path) -> list[str]:
    """The files that a dataset's folder may contain besides heads, layers and everything with its own head.

    Paths are relative to `root`; records come first, since a view exists only with its record.
    """
    head, _ = read_head(root)
    return [*view_files(head.config, head.splits, head.endings), *head.files]


def view_files(config: DatasetConfig, splits: Sequence[Split], endings: Sequence[str] = RENDERED) -> list[str]:
    """The files of all views, by path relative to the dataset: records first."""
    views = [f"{split}/{view:04d}" for split in splits for view in range(config.split(split).views)]
    records = [f"records/{view}.json" for view in views]
    return [*records, *(f"images/{view}{ending}" for ending in endings for view in views)]


def commit_view(
    dataset: Dataset,
    split: Split,
    view: int,
    files: Mapping[str, bytes],
    *,
    seed: int | None = None,
    spp: int | None = None,
    noise_mse: float | None = None,
    variant: str | None = None,
) -> None:
    """Commits one view: its files, then the record that makes them exist.

    Args:
        files: the bytes by each of `dataset.endings`.
        seed: this and what follows is known of rendered views.
    """
    assert set(files) == set(dataset.endings), "a view has the files that its dataset names"
    name = f"{split}/{view:04d}"
    record = ViewRecord(
        dataset=dataset.seal,
        split=split,
        view=view,
        seed=seed,
        spp=spp,
        noise_mse=noise_mse,
        variant=variant,
        files=commit_all(dataset.root, {f"images/{name}{ending}": data for ending, data in files.items()}),
    )
    commit_sealed(dataset.root / f"records/{name}.json", cast(dict[str, Json], to_json(record)))


CLEARED = {
    DATASET: ("variants/*",),
    LAYERS: ("layers/*", "proxies/*/layers/*"),
    PROXIES: ("proxies/*",),
    EDIT_MASKS: ("edit-masks",),
}
"""Where folders with a head of their own lie in a dataset, in the order in which they are cleared."""


def clear_dataset(root: Path) -> None:
    """Removes all files that the head of a dataset and those below it list, but not this head; the caller holds it."""
    for kind, patterns in CLEARED.items():
        for folder in [path for pattern in patterns for path in sorted(root.glob(pattern)) if is_ours(path, kind)]:
            with holding(folder, kind, within=root):
                if kind is DATASET:
                    clear_dataset(folder)
                else:
                    listed = {LAYERS: layers_files, PROXIES: proxy_files, EDIT_MASKS: edit_mask_files}[kind]
                    remove_files(folder, listed(folder))
                remove_files(folder, [kind.head])
            with contextlib.suppress(OSError):  # Its parents go, too, while they are empty.
                while folder != root:
                    folder.rmdir()
                    folder = folder.parent
    remove_files(root, dataset_files(root))
