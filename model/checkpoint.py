"""Owns the bytes of checkpoints and weights: written atomically, verified by their own hash, never run as code.

A file is one dictionary that `torch.load(path, weights_only=True)` reads. Its `sha256` covers everything else in it,
because torch itself does not notice a flipped bit.
"""

import hashlib
import io
import pickle
import zipfile
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from datagen.command import say
from datagen.errors import HyalineError
from datagen.storage import commit
from model.run_folder import CHECKPOINT, PREVIOUS_CHECKPOINT

CHECKPOINT_VERSION = 1

State = None | bool | int | float | str | Tensor | list | tuple | dict
"""What `weights_only=True` reads back; the containers hold states again."""


def save_state(path: Path, state: dict[str, State]) -> None:
    """Commits a state with its version and hash; the same state gives the same bytes."""
    content = {"version": CHECKPOINT_VERSION, **state}
    # Not to a path: torch writes the file's name into the archive then, and bytes would depend on it.
    buffer = io.BytesIO()
    torch.save({**content, "sha256": fingerprint(cast(State, content))}, buffer)
    commit(path, buffer.getvalue())


def load_state(path: Path) -> dict[str, State]:
    """A saved state, on the CPU, every number of it verified.

    Raises:
        HyalineError: missing, damaged, or of another format version.
    """
    if not path.is_file():
        raise HyalineError(f"{path}: the file is missing")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, ValueError, KeyError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise HyalineError(f"{path}: damaged, torch cannot read it ({reason})") from error
    if not isinstance(content, dict) or content.pop("sha256", None) != fingerprint(content):
        raise HyalineError(f"{path}: damaged (checksum differs)")
    if content.pop("version", None) != CHECKPOINT_VERSION:
        raise HyalineError(f"{path}: another format version; this program reads {CHECKPOINT_VERSION}")
    return content


def save_checkpoint(out: Path, state: dict[str, State]) -> None:
    """Commits the newest checkpoint and keeps the one before."""
    if (out / CHECKPOINT).is_file():
        (out / CHECKPOINT).replace(out / PREVIOUS_CHECKPOINT)
    save_state(out / CHECKPOINT, state)


def load_checkpoint(out: Path) -> dict[str, State] | None:
    """The newest checkpoint that verifies; None when there never was one. Says so when it is not the newest.

    Raises:
        HyalineError: there are checkpoints, but none is intact.
    """
    present = [out / name for name in (CHECKPOINT, PREVIOUS_CHECKPOINT) if (out / name).is_file()]
    for path in present:
        try:
            return load_state(path)
        except HyalineError as error:
            say(f"{error}; trying the checkpoint before it")
    if present:
        raise HyalineError(f"{out}: no checkpoint there is intact; start anew with --overwrite")
    return None


def delete_checkpoints(out: Path) -> None:
    for name in (CHECKPOINT, PREVIOUS_CHECKPOINT):
        (out / name).unlink(missing_ok=True)


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
