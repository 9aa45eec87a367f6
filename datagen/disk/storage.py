"""How files reach the disk: atomic commits, checksummed JSON, one writer a folder."""

import contextlib
import fcntl
import hashlib
import json
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path

from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.homes import way_out
from datagen.disk.os_errors import naming
from datagen.disk.reading import MAX_JSON_BYTES, parse_json, read_regular
from datagen.disk.records import Json

SEAL = "sha256"
"""Key under which a sealed JSON file holds the SHA-256 of everything else in it."""

TEMPORARY = re.compile(r".+\.[0-9a-f]{16}\.hyaline-tmp")
"""What a file that is being written is called, which a killed writer may leave; nobody else gives such names."""


def user_cache(name: str) -> Path:
    """Where this package keeps what it can make again, by kind; it may not be there."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hyaline" / name


def sha256(data: bytes) -> str:
    """Hex SHA-256."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes.

    Raises:
        DamagedError: the file is missing.
        HyalineError: it is no regular file, or cannot be read.
    """
    try:
        return sha256(read_regular(path))
    except DamagedError as error:
        raise DamagedError(f"{error}; {way_out(path)}") from None


def commit(path: Path, data: bytes, *, beside: Path | None = None) -> None:
    """Writes `data` so that `path` holds either its old bytes or all the new ones, whenever the process dies.

    Of several processes that commit to one path at once, on whichever machines, the last one wins, whole.

    Args:
        beside: a file in the folder where the temporary one lies, and is cleared away when the process dies; `path`
            itself unless given.
    """
    with naming(path):
        temporary = _write_temporary(beside or path, data)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.replace(path)
        _sync_folder(path.parent)


def commit_same(path: Path, data: bytes) -> None:
    """Commits `data` unless `path` holds just these bytes: a file that others may be reading is left alone."""
    if not path.is_file() or path.read_bytes() != data:
        commit(path, data)


def commit_first(path: Path, data: bytes) -> None:
    """Commits `data` unless a file stands there, which stays; of several at once, on whichever machines, one wins."""
    if path.is_file():
        return
    with naming(path):
        temporary = _write_temporary(path, data)
        try:
            path.hardlink_to(temporary)
        except FileExistsError:
            pass
        except OSError:  # A file system without hard links: there the last one wins.
            temporary.replace(path)
        temporary.unlink(missing_ok=True)
        _sync_folder(path.parent)


def _write_temporary(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    # A name of its own: another process may be committing to the same path.
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(8)}.hyaline-tmp")
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return temporary


def _sync_folder(path: Path) -> None:
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def dump_json(data: Json) -> bytes:
    """Canonical bytes: sorted keys, two spaces, a final newline; NaN and infinity are refused."""
    return (json.dumps(data, indent=2, sort_keys=True, allow_nan=False) + "\n").encode()


def seal_of(data: dict[str, Json]) -> str:
    """The hash under which `seal_bytes` seals `data`."""
    return sha256(dump_json(data))


def seal_bytes(data: dict[str, Json]) -> bytes:
    """The bytes of a sealed JSON file: canonical, with the hash of the rest under `SEAL`."""
    if SEAL in data:
        raise ValueError(f"the key {SEAL!r} is reserved")
    return dump_json({**data, SEAL: seal_of(data)})


def commit_sealed(path: Path, data: dict[str, Json]) -> None:
    """Commits `data` as a sealed JSON file."""
    commit(path, seal_bytes(data))


def load_sealed(path: Path) -> dict[str, Json]:
    """The content of a sealed JSON file, without its seal.

    Raises:
        DamagedError: any byte differs from what was sealed.
    """
    if path.is_symlink():
        raise HyalineError(f"{path}: is a link; expected the file itself, which is written in its place")
    text = read_regular(path, at_most=MAX_JSON_BYTES)
    data = parse_json(text, where=str(path))
    data.pop(SEAL, None)
    if text != seal_bytes(data):
        raise DamagedError(f"{path}: does not match its own checksum, was damaged or edited; {way_out(path)}")
    return data


def one_writer(root: Path) -> contextlib.AbstractContextManager[None]:
    """Holds `root` for this process; the lock ends with the process, however that ends, and leaves no file.

    Raises:
        HyalineError: another process is writing there.
    """
    return _locked(root, fcntl.LOCK_EX)


def shared_writers(root: Path) -> contextlib.AbstractContextManager[None]:
    """Holds `root` beside others that do the same, who know how not to step on each other.

    Raises:
        HyalineError: another process of this machine holds it for itself.
    """
    return _locked(root, fcntl.LOCK_SH)


@contextlib.contextmanager
def _locked(root: Path, how: int) -> Iterator[None]:
    with naming(root):
        root.mkdir(parents=True, exist_ok=True)
        handle = os.open(root, os.O_RDONLY)
    try:
        try:
            with naming(root):
                fcntl.flock(handle, how | fcntl.LOCK_NB)
        except BlockingIOError:
            raise HyalineError(f"{root}: another process is writing there; wait for it, or stop it") from None
        yield
    finally:
        os.close(handle)
