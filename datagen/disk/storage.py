"""How files reach the disk and are read back verified: atomic commits, checksummed JSON, one writer a folder."""

import contextlib
import fcntl
import hashlib
import json
import os
import re
import secrets
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TypeVar, cast

from datagen.disk.errors import DamagedError, HyalineError, naming
from datagen.disk.names import find_file
from datagen.disk.records import MAX_JSON_BYTES, Json, parse_json, read_regular

Value = TypeVar("Value")

SEAL = "sha256"
"""Key under which a sealed JSON file holds the SHA-256 of everything else in it."""

TEMPORARY = re.compile(r".+\.[0-9a-f]{16}\.hyaline-tmp")
"""Name of a file while it is written. A killed writer may leave one; no other program uses such names."""

MAKE_AGAIN = "run the command that made it again, which keeps what is whole"
"""What to do about a damaged or lost file of ours."""


def sha256(data: bytes) -> str:
    """Hex SHA-256."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """Hex SHA-256 of a file's bytes.

    Raises:
        DamagedError: the file is missing.
        HyalineError: it is not a regular file, or cannot be read.
    """
    try:
        return sha256(read_regular(path))
    except DamagedError as error:
        raise DamagedError(f"{error}; {MAKE_AGAIN}") from None


def commit(path: Path, data: bytes) -> None:
    """Writes `data` so that `path` holds either its old bytes or all the new ones, whenever the process dies.

    Of several processes that commit to one path at once, on whichever machines, the last one wins, whole.
    """
    with _temporary(path, data) as temporary:
        temporary.replace(path)


def commit_all(root: Path, files: Mapping[str, bytes]) -> dict[str, str]:
    """Commits files, given by path relative to `root`; their SHA-256 by the same paths."""
    for path, data in files.items():
        commit(root / path, data)
    return {path: sha256(data) for path, data in files.items()}


def try_place(path: Path) -> None:
    """Raises an OSError if no file can be committed at `path`, before work is done for one."""
    with _temporary(path, b"") as temporary:
        temporary.unlink()


def commit_same(path: Path, data: bytes) -> None:
    """Commits `data` unless `path` holds just these bytes: a file that others may be reading is left alone."""
    if path.is_symlink() or not path.is_file() or path.read_bytes() != data:
        commit(path, data)


def commit_first(path: Path, data: bytes) -> None:
    """Commits `data` unless a file stands there, which stays; of several at once, on whichever machines, one wins."""
    if path.is_file():
        return
    with _temporary(path, data) as temporary:
        try:
            path.hardlink_to(temporary)
        except FileExistsError:
            pass
        except OSError:  # A file system without hard links: there the last one wins.
            temporary.replace(path)
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def _temporary(path: Path, data: bytes) -> Iterator[Path]:
    """A file beside `path` that holds `data`; an error or a signal deletes it. Errors of the system name `path`."""
    # A name of its own: another process may be committing to the same path.
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(8)}.hyaline-tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        yield temporary
        sync_folder(path.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):  # The first error says what is wrong.
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):  # Many know no file, or the temporary one.
            error.filename, error.filename2 = str(path), None
        raise


def sync_folder(path: Path) -> None:
    """Sees to it that the names in a folder survive a power cut."""
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
        raise DamagedError(f"{path}: is a link; expected the file itself; {MAKE_AGAIN}")
    text = read_regular(path, at_most=MAX_JSON_BYTES)
    data = parse_json(text, where=str(path))
    data.pop(SEAL, None)
    if text != seal_bytes(data):
        raise DamagedError(f"{path}: does not match its own checksum, was damaged or edited; {MAKE_AGAIN}")
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


# Promised files


def home_of(root: Path) -> Path:
    """The dataset in a folder; of a variant, the dataset around it."""
    outer = root.parent.parent
    return outer if root.parent.name == "variants" and (outer / "dataset.json").is_file() else root


def check_files(root: Path, files: Mapping[str, str]) -> None:
    """Raises a DamagedError that names the first file whose bytes are not the promised ones."""
    for relative, promised in files.items():
        read_promised(root, relative, promised)


def read_promised(root: Path, relative: str, promised: str) -> bytes:
    """The bytes of a file below `root`, which are those that were promised.

    Raises:
        DamagedError: missing, or its SHA-256 is another.
    """
    path = find_file(root, relative, where=str(root))
    try:
        data = read_regular(path)
    except DamagedError as error:
        raise DamagedError(f"{error}; {MAKE_AGAIN}") from None
    if sha256(data) != promised:
        raise DamagedError(f"{path}: damaged or edited (checksum differs); {MAKE_AGAIN}")
    return data


class Opened:
    """What was made of files, kept for as long as each is the same one, unchanged. Another process opens its own."""

    def __init__(self) -> None:
        self._kept: dict[Path, tuple[tuple[int, int, int], object]] = {}

    def __reduce__(self) -> "tuple[type[Opened], tuple[()]]":
        return Opened, ()

    def get(self, path: Path, open_it: Callable[[], Value]) -> Value:
        """What `open_it` returned when the file at `path` was last new or changed."""
        try:
            status = path.stat()
        except OSError:
            return open_it()  # Which says what is wrong.
        mark = (status.st_ino, status.st_size, status.st_mtime_ns)
        if path not in self._kept or self._kept[path][0] != mark:
            self._kept[path] = (mark, open_it())
        return cast(Value, self._kept[path][1])


# The user's cache


def private_cache(name: str) -> Path | None:
    """A folder for what this package can make again, by kind, that only this user can read.

    None if there is none, as in a container without a home directory.
    """
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hyaline" / name
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (RuntimeError, OSError):
        return None
    return cache
