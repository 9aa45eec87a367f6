"""Arrays that take long to compute, in the user's cache under a digest of everything that they depend on.

Several processes may find and keep the same ones at once. A lost or damaged file is computed again.
"""

import hashlib
import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from datagen.disk.storage import commit, private_cache

Arrays = Mapping[str, np.ndarray]

MAX_KEPT_BYTES = 1 << 30
"""Size limit for each kind of file; the oldest are deleted first."""


def key_of(arrays: Arrays, makers: Sequence[Path], *facts: object) -> str:
    """A digest of the arrays that others are computed from, the code in `makers`, and anything else that matters."""
    digest = hashlib.sha256(repr(facts).encode())
    for path in makers:
        digest.update(path.read_bytes())
    for name, values in sorted(arrays.items()):
        digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def find_arrays(kind: str, key: str) -> Arrays | None:
    """The arrays kept under this key; None if there are none, or they are damaged."""
    cache = private_cache(kind)
    if cache is None:
        return None
    try:
        with (cache / f"{key}.npz").open("rb") as file, np.load(file) as kept:  # With a checksum of each array.
            return dict(kept)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile):
        return None


def keep_arrays(kind: str, key: str, arrays: Arrays) -> None:
    """Keeps arrays, if the cache is writable."""
    cache = private_cache(kind)
    if cache is None:
        return
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    try:
        commit(cache / f"{key}.npz", buffer.getvalue())
        kept = sorted((path.stat().st_mtime, path.stat().st_size, path) for path in cache.glob("*.npz"))
        excess = sum(size for _, size, _ in kept) - MAX_KEPT_BYTES
        for _, size, path in kept:
            if excess > 0:
                path.unlink(missing_ok=True)
                excess -= size
    except OSError:  # A full disk, or another process that deletes the same files.
        return
