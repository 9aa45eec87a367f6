"""Owns annexes: more truth of a dataset, beside what every dataset has, without changing a byte of that.

    annexes/angles/   the splits extrapolating-10deg, -20deg, -40deg: cameras outside of what training covers
    annexes/x2/       views of the test splits, rendered twice as wide and high; x4 the same four times

Each is laid out like a dataset, with a sealed head of its own that names its parent's seal. Scene and meshes are the
parent's; layers of its geometries lie in the annex.
"""

from pathlib import Path

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.names import check_name, is_name

ANGLES = "angles"


def annex_root(root: Path, name: str) -> Path:
    return root / "annexes" / check_name(name, where="annex")


def scale_name(scale: int) -> str:
    """The annex that holds pictures so many times as wide and high; so are the folders of predictions called."""
    return f"x{scale}"


def evenly(count: int, total: int) -> list[int]:
    """`count` of `total` things, in order and as far apart as they can be."""
    return [(2 * place + 1) * total // (2 * count) for place in range(count)]


def parent_views(annex: Dataset, split: Split) -> list[int]:
    """Which views of the parent's split those of an annex with larger pictures are."""
    return evenly(annex.config.split(split).views, annex.home.config.split(split).views)


def list_annex_folders(root: Path) -> list[Path]:
    """The folders of a dataset's annexes, sorted."""
    return sorted(path.parent for path in root.glob("annexes/*/dataset.json") if is_name(path.parent.name))


def open_annex(dataset: Dataset, name: str) -> Dataset | None:
    """An annex; None when it was not built.

    Raises:
        HyalineError: damaged, or of another dataset.
    """
    root = annex_root(dataset.root, name)
    return open_dataset(root) if (root / "dataset.json").is_file() else None


def homes_of_test_splits(dataset: Dataset) -> dict[Split, Dataset]:
    """Every split that methods are tested on, with the dataset or annex that holds it."""
    annex = open_annex(dataset, ANGLES)
    further = {} if annex is None else dict.fromkeys(annex.splits, annex)
    return {**dict.fromkeys(TEST_SPLITS, dataset), **further}
