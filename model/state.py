"""Checkpoints and weights on disk: written atomically, verified by their own hash, never run as code.

A file is one dictionary that `torch.load(path, weights_only=True)` reads. Its `sha256` covers everything else in it,
because torch itself does not notice a flipped bit.
"""

import hashlib
import io
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.storage import commit, read_regular

State = None | bool | int | float | str | Tensor | list | tuple | dict
"""What a checkpoint can hold: what `weights_only=True` reads back; the containers hold states again."""

CHECKPOINT_VERSION = 1


def save_state(path: Path, state: dict[str, State]) -> None:
    """Commits a state with its version and hash; the same state gives the same bytes."""
    content = {"version": CHECKPOINT_VERSION, **state}
    # Not to a path: torch writes the file's name into the archive then, and bytes would depend on it.
    buffer = io.BytesIO()
    torch.save({**content, "sha256": fingerprint(cast(State, content))}, buffer)
    commit(path, buffer.getvalue())


def load_state(path: Path) -> dict[str, State]:
    """A saved state, on the CPU, with its checksum verified.

    Raises:
        DamagedError: the file is missing, or its content is damaged.
        HyalineError: it cannot be read, which says nothing about its content, or has another format version.
    """
    data = read_regular(path)
    try:
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        is_intact = isinstance(content, dict) and content.pop("sha256", None) == fingerprint(content)
    except MemoryError:
        raise
    except Exception as error:
        # torch 2.13 parses before anything is verified, and raises almost anything on damaged bytes: seven types,
        # including OSError, were seen after truncation and flipped bits.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DamagedError(f"{path}: damaged, torch cannot read it ({reason})") from error
    if not is_intact:
        raise DamagedError(f"{path}: damaged (checksum differs)")
    if content.pop("version", None) != CHECKPOINT_VERSION:
        raise HyalineError(
            f"{path}: another format version; this program reads {CHECKPOINT_VERSION}; train again with --overwrite"
        )
    return content


def fingerprint(state: State) -> str:
    """SHA-256 over the keys, types, shapes and bytes of a nested state; the order of keys does not matter."""
    digest = hashlib.sha256()

    def add(value: State) -> None:
        if isinstance(value, Tensor):
            digest.update(f"{value.dtype} {tuple(value.shape)}".encode())
            digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().data)
        elif isinstance(value, dict):
            digest.update(f"dict {len(value)}".encode())
            for key in sorted(value, key=repr):
                digest.update(repr(key).encode())
                add(value[key])  # pyright: ignore[reportArgumentType]
        elif isinstance(value, (list, tuple)):
            digest.update(f"{type(value).__name__} {len(value)}".encode())
            for item in value:
                add(item)
        else:
            digest.update(f"{value!r};".encode())

    add(state)
    return digest.hexdigest()
