"""Cached results of earlier reports, by a hash of all their inputs.

REPORT/kept/KEY.json     with checksum: one result; KEY is the hash of its kind, of the files that it depends on, and of
                         the code that computed it, so that a result is never out of date
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
"""Packages whose code results depend on."""


class Kept:
    """Results of earlier reports in a folder, and new ones of this report."""

    def __init__(self, folder: Path | None = None) -> None:
        """Reads results from `folder` when they are needed; without it, everything is computed."""
        self._folder = folder
        self.used: set[str] = set()
        """Files that this report used."""
        self.new: dict[str, dict[str, Json]] = {}
        """Names and contents of new files."""

    def get(self, kind: str, about: Json, compute: Callable[[], Json]) -> Json:
        """A result, computed unless an earlier report did.

        Args:
            about: everything that the result depends on: hashes of files, and settings.
        """
        name = f"{sha256(dump_json([kind, about, code_digest()]))}.json"
        self.used.add(name)
        if name in self.new:
            return self.new[name]["result"]
        if self._folder is not None and (self._folder / name).is_file():
            try:
                return load_sealed(self._folder / name)["result"]
            except (HyalineError, KeyError):
                pass  # Damaged, so it is computed and written again.
        result = compute()
        self.new[name] = {"kind": kind, "result": result}
        return result


@functools.cache
def code_digest() -> str:
    """A hash of the code of `PACKAGES`, and of the versions of the libraries that decode and compute."""
    digest = hashlib.sha256(f"numpy {np.__version__}, Pillow {PIL.__version__}".encode())
    root = Path(__file__).parents[2]
    for package in PACKAGES:
        for path in sorted(path for path in (root / package).rglob("*") if path.suffix in (".py", ".css", ".js")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    for package in ("scikit_image", "colour_science", "matplotlib", "flip_evaluator", "lpips"):
        # The folder's name contains the version; `importlib.metadata` would parse all packages.
        found = sorted(path.name for path in Path(np.__file__).parents[1].glob(f"{package}-*.dist-info"))
        digest.update(repr(found).encode())
    return digest.hexdigest()


def picture_digests(dataset: Dataset, split: Split) -> list[str]:
    """SHA-256 of each true picture, every byte verified."""
    return [view.image_sha256 for view in dataset.views(split)]


def layers_digest(dataset: Dataset, geometry: str, splits: Sequence[Split]) -> str:
    """A hash of the records of straight layers in some splits."""
    store = dataset.layer_store(geometry)
    digest = hashlib.sha256(store.seal.encode())
    for split in splits:
        for view in range(dataset.config.split(split).views):
            path = store.root / "records" / split / f"{view_name(view)}.json"
            if not path.is_file():
                store.record(split, view)  # Raises with the command that makes it.
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
