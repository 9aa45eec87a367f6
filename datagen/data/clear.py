"""Clearing a dataset: which files of it, its layers, proxies and variants are removed to make room for another.

Every folder is cleared of what its own head promises, and of nothing else: where no head verifies, all stays. Heads go
last, so that a clearing that is killed can be done again.
"""

from pathlib import Path

from datagen.data.dataset_head import dataset_files
from datagen.data.edit_masks import list_edit_masks
from datagen.data.geometries import proxy_files
from datagen.data.layer_writing import layers_files
from datagen.disk.ownership import DATASET, EDIT_MASKS, LAYERS, PROXIES, FolderKind, holding, is_ours, remove_files


def clear_dataset(root: Path) -> None:
    """Removes all that the head of a dataset and those below it promise, but for the head itself; the caller holds it.

    Raises:
        HyalineError: another process writes to one of its folders.
    """
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
    """Removes a folder and those above it, up to `root`, as long as they are empty."""
    while folder != root:
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent
