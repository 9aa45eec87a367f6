"""Atlases that were made before, kept in the user's cache by the surface that they are of: unwrapping takes minutes.

A kept atlas only says how a surface is cut and laid out, so that a lost or damaged one is made again without a word.
"""

import hashlib
import io
import zipfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

import numpy as np

from datagen.disk.storage import make_private, read_hashed, user_cache, write_hashed

MAX_KEPT = 2000
"""Atlases; when there are more, the oldest are forgotten."""

Arrays = Mapping[str, np.ndarray]


def atlas_key(surface: Arrays, maker: Path) -> str:
    """What an atlas depends on: the surface's arrays, the code in `maker`, and the version of xatlas."""
    digest = hashlib.sha256(metadata.version("xatlas").encode() + maker.read_bytes())
    for name, values in sorted(surface.items()):
        digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def find_atlas(key: str) -> Arrays | None:
    """The arrays that were kept under this key; None where there are none, or they are in doubt."""
    cache = _cache()
    data = None if cache is None else read_hashed(cache / f"{key}.npz")
    if data is None:
        return None
    try:
        with np.load(io.BytesIO(data)) as kept:
            return dict(kept)
    except (ValueError, OSError, zipfile.BadZipFile):
        return None


def keep_atlas(key: str, atlas: Arrays) -> None:
    """Keeps the arrays, where the cache can be written to; else nothing happens."""
    cache = _cache()
    if cache is None:
        return
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **atlas)
    try:
        write_hashed(cache / f"{key}.npz", buffer.getvalue())
        kept = sorted(cache.glob("*.npz"), key=lambda path: path.stat().st_mtime)
        for path in kept[:-MAX_KEPT]:
            path.unlink(missing_ok=True)
    except OSError:  # A full disk, or another process that forgets the same ones.
        return


def _cache() -> Path | None:
    try:
        cache = user_cache("atlases")
    except RuntimeError:  # Nobody knows where this user's home is.
        return None
    return cache if make_private(cache) is None else None
