"""Writing a dataset: its head, then the scene and the cameras that the head promises, then view by view."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from datagen.data.cameras import TRANSFORMS_FILES, Cameras, transforms_bytes
from datagen.data.config import SPLITS, DatasetConfig, Split
from datagen.data.dataset import (
    DATASET_VERSION,
    Dataset,
    DatasetObject,
    Variant,
    ViewRecord,
    config_of,
    head_files,
    open_dataset,
    variant_of,
)
from datagen.data.paths import image_path, record_path
from datagen.disk.errors import HyalineError
from datagen.disk.heads import keep_head
from datagen.disk.ownership import DATASET, begin, is_ours
from datagen.disk.records import Json, to_json
from datagen.disk.storage import commit, commit_same, commit_sealed, load_sealed, seal_bytes, seal_of, sha256


def write_head(
    root: Path,
    config: DatasetConfig,
    objects: tuple[DatasetObject, ...],
    cameras: dict[Split, Cameras],
    scene: Mapping[str, bytes],
    *,
    variant: Variant | None = None,
    replace: bool = False,
) -> Dataset:
    """Commits the head of a dataset, then the scene and the cameras that it promises; the caller holds the folder.

    Several processes may do the same at once. A head that stands there stays: whose it is says what is returned. Where
    it is the same, files of it that were lost or damaged are written anew.

    Args:
        scene: the files of the scene's folder, by path relative to it; none in a variant of the same scene.
        variant: what a variant says of itself.
        replace: take the place of a head of ours, whose views and further files the caller has removed.

    Raises:
        HyalineError: something else stands at `root`.
    """
    files = head_contents(scene, cameras)
    head: dict[str, Json] = {
        "version": DATASET_VERSION,
        "config": to_json(config),
        "objects": to_json(objects),
        "files": {path: sha256(data) for path, data in sorted(files.items())},
        **({} if variant is None else {"variant": to_json(variant)}),
    }
    if replace and is_ours(root, DATASET):
        commit(root / DATASET.head, seal_bytes(head))
    else:
        begin(root, DATASET, seal_bytes(head), files, is_proven=lambda: _has_record_of(root, seal_of(head)))
    dataset = open_dataset(root)
    if dataset.seal == seal_of(head):
        for path, data in files.items():
            commit_same(root / path, data)
    keep_head(root, root / DATASET.head)
    return dataset


def head_contents(scene: Mapping[str, bytes], cameras: Mapping[Split, Cameras]) -> dict[str, bytes]:
    """The files that a head promises, by path relative to the dataset."""
    files = {f"scene/{path}": data for path, data in scene.items()}
    return files | {TRANSFORMS_FILES[split]: transforms_bytes(poses, split) for split, poses in cameras.items()}


def _has_record_of(root: Path, seal: str) -> bool:
    """True when a view there was made under the head of this seal, which may have been lost since."""
    for path in root.glob("records/*/*.json"):
        try:
            if load_sealed(path).get("dataset") == seal:
                return True
        except HyalineError:
            continue
    return False


def dataset_files(root: Path) -> list[str]:
    """What may stand in a dataset's folder besides its head, its layers and what has a head of its own.

    By path relative to `root`, records first: without them, no view is there any more.
    """
    path = root / DATASET.head
    head = load_sealed(path)
    config = config_of(head, path)
    variant = variant_of(head, path)
    return [*view_files(config, SPLITS if variant is None else variant.splits), *head_files(root)]


def view_files(config: DatasetConfig, splits: Sequence[Split]) -> list[str]:
    """The files of all views, by path relative to the dataset: records first."""
    here = Path()
    views: list[tuple[Split, int]] = [(split, view) for split in splits for view in range(config.split(split).views)]
    records = [record_path(here, split, view) for split, view in views]
    pictures = [image_path(here, split, view) for split, view in views]
    return [path.as_posix() for path in (*records, *pictures, *(path.with_suffix(".exr") for path in pictures))]


def commit_view(
    dataset: Dataset,
    split: Split,
    view: int,
    *,
    png: bytes,
    exr: bytes,
    seed: int,
    spp: int,
    noise_mse: float,
    variant: str,
) -> None:
    """Commits one rendered view: its pictures, then the record that makes them exist."""
    path = image_path(dataset.root, split, view)
    files = {}
    for file, data in ((path, png), (path.with_suffix(".exr"), exr)):
        commit(file, data)
        files[file.relative_to(dataset.root).as_posix()] = sha256(data)
    record = ViewRecord(
        dataset=dataset.seal,
        split=split,
        view=view,
        seed=seed,
        spp=spp,
        noise_mse=noise_mse,
        variant=variant,
        files=files,
    )
    commit_sealed(record_path(dataset.root, split, view), cast(dict[str, Json], to_json(record)))
