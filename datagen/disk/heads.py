"""The second copies of a dataset's heads, which tell what was there, and with which settings, when it is gone.

    heads/dataset.json                          a copy of dataset.json
    heads/layers/straight/layers.json           a copy of layers/straight/layers.json; and so on for every head of
                                                layers, proxies and variants: at the same path, the same bytes

A head is committed first and copied then. So a head that verifies counts, and the copy where it does not; where both do
and differ, the one under which the views were made.
"""

from collections.abc import Iterator
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.homes import HEADS, home_of
from datagen.disk.reading import load_json
from datagen.disk.storage import SEAL, commit, load_sealed, sha256_file

_PARTS = (
    "dataset.json",
    "proxies/*/proxies.json",
    *(f"{outer}layers/straight/layers.json" for outer in ("", "proxies/*/")),
)
PATTERNS = tuple(f"{outer}{inner}" for outer in ("", "variants/*/") for inner in _PARTS)
"""Where heads lie in a dataset."""


def keep_head(root: Path, path: Path) -> None:
    """Copies the head at `path`, of the dataset or variant at `root`, when the copy is not the same."""
    home = home_of(root)
    copy, data = home / HEADS / path.relative_to(home), path.read_bytes()
    if not copy.is_file() or copy.read_bytes() != data:
        commit(copy, data, beside=path)


def list_heads(home: Path) -> list[str]:
    """Every head that is there, or was by its copy, by path relative to the dataset; outer ones first."""
    found = {
        path.relative_to(folder).as_posix()
        for folder in (home, home / HEADS)
        for pattern in PATTERNS
        for path in folder.glob(pattern)
    }
    return sorted(found, key=lambda path: (path.count("/"), path))


def true_head(home: Path, relative: str) -> bytes | None:
    """The bytes of a head that count, its own or its copy's; None when neither verifies."""
    head, copy = _verified(home / relative), _verified(home / HEADS / relative)
    if head is None or copy is None or head == copy:
        return head if head is not None else copy
    is_older = _is_proven(home / HEADS / relative, home / relative) and not _is_proven(home / relative, home / relative)
    return copy if is_older else head


def _verified(path: Path) -> bytes | None:
    if path.is_symlink():
        return None
    try:
        load_sealed(path)
    except HyalineError:
        return None
    return path.read_bytes()


def _is_proven(head: Path, place: Path) -> bool:
    """True when what lies beside `place` was made under a head: a view's record says so, or a mesh's checksum."""
    content = load_json(head)
    if place.name == "proxies.json":
        listed = content.get("proxies")
        meshes = [item for item in listed if isinstance(item, dict)] if isinstance(listed, list) else []
        files = [(place.parent / str(item.get("file")), item.get("sha256")) for item in meshes]
        return any(path.is_file() and sha256_file(path) == promised for path, promised in files)
    key = "dataset" if place.name == "dataset.json" else "layers"
    return any(record.get(key) == content[SEAL] for record in _records(place.parent))


def _records(root: Path) -> Iterator[dict]:
    for path in sorted(root.glob("records/*/*.json")):
        try:
            yield load_sealed(path)
        except HyalineError:
            continue
