"""Writing a dataset: its head, the scene and cameras that the head lists, then view by view; and clearing it.

Clearing removes from each folder only the files that its own head lists; a folder whose head does not verify keeps all
of its files. Heads go last, so an interrupted clearing can be repeated.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from datagen.data.cameras import Cameras
from datagen.data.config import DATASET_VERSION, SPLITS, DatasetConfig, Split, config_of
from datagen.data.dataset import Dataset, DatasetObject, open_dataset, promised_files
from datagen.data.geometries import proxy_files
from datagen.data.layer_writing import layers_files
from datagen.data.metadata import RENDERED, Imported, Variant, ViewRecord, imported_of, variant_of
from datagen.data.paths import image_path, record_path
from datagen.data.transforms import TRANSFORMS_FILES, transforms_bytes
from datagen.data.variants import list_edit_masks
from datagen.disk.ownership import (
    DATASET,
    EDIT_MASKS,
    LAYERS,
    PROXIES,
    FolderKind,
    begin,
    holding,
    is_ours,
    remove_files,
)
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
        begin(root, DATASET, seal_bytes(head))
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
    path = root / DATASET.head
    head = load_sealed(path)
    config = config_of(head, path)
    variant, imported = variant_of(head, path), imported_of(head, path)
    endings = RENDERED if imported is None else imported.endings
    return [*view_files(config, SPLITS if variant is None else variant.splits, endings), *promised_files(head, path)]


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
    """Commits one imported view.

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


def clear_dataset(root: Path) -> None:
    """Removes all files that the head of a dataset and those below it list, but not this head; the caller holds it."""
    for folder in _folders(root, ("variants/*",), DATASET):
        with holding(folder, DATASET, within=root):
            clear_dataset(folder)
            remove_files(folder, [DATASET.head])
        _prune(root, folder)
    for folder in _folders(root, ("layers/*", "proxies/*/layers/*"), LAYERS):
        clear_layers(root, folder)
    for folder in _folders(root, ("proxies/*",), PROXIES):
        with holding(folder, PROXIES, within=root):
            remove_files(folder, [*proxy_files(folder), PROXIES.head])
        _prune(root, folder)
    for folder in _folders(root, ("edit-masks",), EDIT_MASKS):
        with holding(folder, EDIT_MASKS, within=root):
            files = [Path(file).relative_to(folder.name).as_posix() for file in list_edit_masks(folder)]
            remove_files(folder, [*files, EDIT_MASKS.head])
        _prune(root, folder)
    remove_files(root, dataset_files(root))


def clear_layers(root: Path, folder: Path) -> None:
    """Removes the layers in a folder below a dataset `root`, with their head."""
    with holding(folder, LAYERS, within=root):
        remove_files(folder, [*layers_files(folder), LAYERS.head])
    _prune(root, folder)


def _folders(root: Path, patterns: tuple[str, ...], kind: FolderKind) -> list[Path]:
    found = [path for pattern in patterns for path in sorted(root.glob(pattern))]
    return [path for path in found if is_ours(path, kind)]


def _prune(root: Path, folder: Path) -> None:
    """Removes a folder and its parents up to `root` while they are empty."""
    while folder != root:
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent
