"""What earlier reports computed, by a hash of everything that it was computed from.

REPORT/kept/KEY.json     sealed: one result; KEY is the hash of its kind, of the files that it tells about, and of the
                         code that computed it, so that a result is never out of date: another one has another name
"""

import functools
import hashlib
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import PIL

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, read_regular
from datagen.disk.storage import dump_json, load_sealed, sha256

FOLDER = "kept"
KEPT_FILE = re.compile(r"[0-9a-f]{64}\.json")
PACKAGES = ("eval", "datagen")
"""Whose code decides what a result is."""


class Kept:
    """Results of earlier reports in a folder, and those that this one adds."""

    def __init__(self, folder: Path | None = None) -> None:
        """Reads from `folder` as results are asked for; without one, everything is computed."""
        self._folder = folder
        self.used: set[str] = set()
        """Files that this report asked for."""
        self.new: dict[str, dict[str, Json]] = {}
        """What files to write, and their content."""

    def get(self, kind: str, about: Json, compute: Callable[[], Json]) -> Json:
        """A result, computed only where no earlier report did.

        Args:
            about: everything that the result depends on, as hashes of files and settings.
        """
        name = f"{sha256(dump_json([kind, about, code_digest()]))}.json"
        self.used.add(name)
        if name in self.new:
            return self.new[name]["result"]
        if self._folder is not None and (self._folder / name).is_file():
            try:
                return load_sealed(self._folder / name)["result"]
            except (HyalineError, KeyError):
                pass  # Damaged: it is computed and written again.
        result = compute()
        self.new[name] = {"kind": kind, "result": result}
        return result


@functools.cache
def code_digest() -> str:
    """A hash of the code of this package and of that below it, and of what decodes and computes."""
    digest = hashlib.sha256(f"numpy {np.__version__}, Pillow {PIL.__version__}".encode())
    root = Path(__file__).parents[2]
    for package in PACKAGES:
        for path in sorted(path for path in (root / package).rglob("*") if path.suffix in (".py", ".css", ".js")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    for package in ("scikit_image", "colour_science", "matplotlib"):
        # The folder that names an installed version; `importlib.metadata` would parse all of them.
        found = sorted(path.name for path in Path(np.__file__).parents[1].glob(f"{package}-*.dist-info"))
        digest.update(repr(found).encode())
    return digest.hexdigest()


def picture_digests(dataset: Dataset, split: Split) -> list[str]:
    """SHA-256 of each true picture, every byte verified.

    Raises:
        HyalineError: a view is not built, or its picture is damaged.
    """
    return [view.image_sha256 for view in dataset.views(split)]


def layers_digest(dataset: Dataset, geometry: str, splits: Sequence[Split]) -> str:
    """A hash of what the records promise of the straight layers in some splits.

    Raises:
        HyalineError: the geometry has none, or a view is not peeled.
    """
    store = dataset.layer_store(geometry)
    digest = hashlib.sha256(store.seal.encode())
    for split in splits:
        for view in range(dataset.config.split(split).views):
            path = store.root / "records" / split / f"{view_name(view)}.json"
            if not path.is_file():
                store.record(split, view)  # Says how to make it.
            digest.update(read_regular(path))
    return digest.hexdigest()


def number_json(value: float | None) -> Json:
    """A number of a result; infinite ones as text, since JSON has none."""
    return "inf" if value is not None and math.isinf(value) else value


def number_from_json(value: Json) -> float | None:
    """The inverse of `number_json`."""
    if value is None or (isinstance(value, (int, float)) and not isinstance(value, bool)):
        return value
    if value == "inf":
        return math.inf
    raise HyalineError(f"a kept number: is {value!r}; expected a number, or 'inf'")
