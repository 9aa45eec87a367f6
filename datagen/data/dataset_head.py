"""Writing a dataset: its head, then the scene and the cameras that the head promises, then view by view."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from datagen.data.cameras import TRANSFORMS_FILES, Cameras, transforms_bytes
from datagen.data.config import DATASET_VERSION, SPLITS, DatasetConfig, Split, config_of
from datagen.data.dataset import Dataset, DatasetObject, head_files, open_dataset
from datagen.data.imported import RENDERED, Imported, imported_of
from datagen.data.paths import image_path, record_path
from datagen.data.variant_record import Variant, variant_of
from datagen.data.view_record import ViewRecord
from datagen.disk.errors import HyalineError
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
    imported: Imported | None = None,
    stated_license: str | None = None,
    replace: bool = False,
) -> Dataset:
    """Commits the head of a dataset, then the scene and the cameras that it promises; the caller holds the folder.

    Several processes may do the same at once. A head that stands there stays: whose it is says what is returned. Where
    it is the same, files of it that were lost or damaged are written anew.

    Args:
        scene: the files of the scene's folder, by path relative to it; none in a variant of the same scene.
        variant: what a variant says of itself.
        imported: where the pictures come from, unless they are rendered here.
        stated_license: of the data; a variant has that of the dataset around it.
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
        **({} if imported is None else {"imported": to_json(imported)}),
        **({} if stated_license is None else {"license": stated_license}),
    }
    if replace and is_ours(root, DATASET):
        commit(root / DATASET.head, seal_bytes(head))
    else:
        begin(root, DATASET, seal_bytes(head), files, is_proven=lambda: _has_record_of(root, seal_of(head)))
    dataset = open_dataset(root)
    if dataset.seal == seal_of(head):
        for path, data in files.items():
            commit_same(root / path, data)
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
    variant, imported = variant_of(head, path), imported_of(head, path)
    endings = RENDERED if imported is None else imported.endings
    return [*view_files(config, SPLITS if variant is None else variant.splits, endings), *head_files(root)]


def view_files(config: DatasetConfig, splits: Sequence[Split], endings: Sequence[str] = RENDERED) -> list[str]:
    """The files of all views, by path relative to the dataset: records first."""
    here = Path()
    views: list[tuple[Split, int]] = [(split, view) for split in splits for view in range(config.split(split).views)]
    records = [record_path(here, split, view) for split, view in views]
    pictures = [image_path(here, split, view) for split, view in views]
    files = (path.with_suffix(ending) for ending in endings for path in pictures)
    return [path.as_posix() for path in (*records, *files)]


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
    files = _commit_files(dataset, split, view, {".png": png, ".exr": exr})
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


def commit_imported_view(dataset: Dataset, split: Split, view: int, files: Mapping[str, bytes]) -> None:
    """Commits one view whose picture comes from elsewhere.

    Args:
        files: the bytes of each of `dataset.endings`.
    """
    assert set(files) == set(dataset.endings), "an imported view has the files that its dataset names"
    hashes = _commit_files(dataset, split, view, files)
    record = ViewRecord(dataset=dataset.seal, split=split, view=view, files=hashes)
    commit_sealed(record_path(dataset.root, split, view), cast(dict[str, Json], to_json(record)))


def _commit_files(dataset: Dataset, split: Split, view: int, files: Mapping[str, bytes]) -> dict[str, str]:
    """Writes the files of a view, by ending; their SHA-256 by path."""
    hashes = {}
    for ending, data in files.items():
        path = image_path(dataset.root, split, view).with_suffix(ending)
        commit(path, data)
        hashes[path.relative_to(dataset.root).as_posix()] = sha256(data)
    return hashes
