"""Finding and opening datasets."""

from pathlib import Path

from datagen.data import dataset as contract
from datagen.data import paths as finding
from datagen.data.paths import DATA_ROOT


def list_datasets(root: Path | str = DATA_ROOT) -> list[str]:
    """The names of the datasets in a folder, sorted; `data` in the working folder unless given.

    >>> list_datasets()
    ['glass_table']
    """
    return [path.name for path in finding.list_datasets(Path(root))]


def open_dataset(name: Path | str | None = None, root: Path | str = DATA_ROOT) -> contract.Dataset:
    """A dataset, its head verified. Views are read, and verified, when they are asked for.

    >>> dataset = open_dataset("glass_table")
    >>> dataset.num_views["train"], dataset.config.resolution.width
    (8, 32)
    >>> [item.name for item in dataset.objects]         # object ids are 1, 2, ... in this order
    ['pane', 'floor']
    >>> origin, directions = dataset.view("train", 3).camera.rays()   # (3,) and (h, w, 3), metres and unit vectors

    Args:
        name: a name under `root`, or a folder; the only dataset under `root` unless given.

    Raises:
        HyalineError: there is none, the head is damaged, or its format is of another version.
    """
    return contract.open_dataset(finding.find_dataset(None if name is None else str(name), Path(root)))
