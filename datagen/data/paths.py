"""Where the parts of a dataset lie, relative to its folder."""

from pathlib import Path

from datagen.data.config import Split
from datagen.disk.names import check_name

TRUTH = "truth"
"""The geometry that is not a proxy: the scene's own meshes."""


def view_name(view: int) -> str:
    return f"{view:04d}"


def image_path(root: Path, split: Split, view: int) -> Path:
    """The 8-bit sRGB picture; its neighbour `.exr` holds the linear one."""
    return root / "images" / split / f"{view_name(view)}.png"


def record_path(root: Path, split: Split, view: int) -> Path:
    return root / "records" / split / f"{view_name(view)}.json"


def geometry_root(root: Path, geometry: str) -> Path:
    """Where a geometry's meshes and layers lie: the dataset itself for the truth, else its proxy folder."""
    return root if geometry == TRUTH else root / "proxies" / check_name(geometry, where="geometry")


def layers_root(root: Path, geometry: str) -> Path:
    """Where a geometry's layers lie."""
    return geometry_root(root, geometry) / "layers" / "straight"
