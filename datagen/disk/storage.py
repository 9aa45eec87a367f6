"""Files on disk: which names and paths may be used, reading regular files alone, whole commits, one writer a folder.

Names in files are checked before they are joined to a path: each is one component, and a path stays below its root.
"""

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import secrets
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from datagen.disk.errors import DamagedError, HyalineError, describe_os_error, naming, shown

# Names and paths


NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+,-]*")
MAX_NAME = 220
"""Characters; a file system takes 255 bytes, and endings follow."""
MAX_PATH = 1024
"""Bytes of a whole path, on common file systems."""

_UNFIT_FOR_FILES = re.compile(r"[^\w.+,-]")


def is_name(text: str) -> bool:
    """Whether `text` can be one component of a path everywhere: ASCII letters, digits and `_ . + , -`."""
    return len(text) <= MAX_NAME and NAME.fullmatch(text) is not None


def check_name(text: str, *, where: str) -> str:
    """`text`, when it `is_name`; an error for anything else, such as a path or what begins with a dot or a dash."""
    if not is_name(text):
        raise HyalineError(
            f"{where}: is {_shortened(text)!r}; expected a name of letters, digits, _ - . + and commas, "
            f"at most {MAX_NAME} characters"
        )
    return text


def file_name(text: str) -> str:
    """The part of a file's name that stands for `text`, whatever it is: what is unfit becomes `_`."""
    return _UNFIT_FOR_FILES.sub("_", text).lstrip(".-")[:MAX_NAME] or "_"


def check_relative(text: str, *, where: str) -> str:
    """`text`, when it is a path below whatever it is joined to.

    An error if it is absolute or too long, has a part `..` or an empty one, or holds control characters or a backslash.
    """
    parts = text.split("/")
    is_long = len(text.encode(errors="replace")) > MAX_PATH or max(map(len, parts)) > MAX_NAME
    if is_long or "\\" in text or not text.isprintable() or any(part in ("", ".", "..") for part in parts):
        raise HyalineError(
            f"{where}: names {_shortened(text)!r}; expected a file inside the folder, by its path from there"
        )
    return text


def find_file(root: Path, relative: str, *, where: str) -> Path:
    """The path of a regular file that `relative` names below `root`; links may lead to it, but not out of `root`.

    A path at which nothing stands is returned as it is; a folder, a pipe or a device there is an error.
    """
    path = root / check_relative(relative, where=where)
    if os.path.lexists(path):
        check_regular(path, root, where=where)
    return path


def check_regular(path: Path, root: Path, *, where: str) -> None:
    """Raises a DamagedError for links that lead nowhere or out of `root`, and for anything but regular files."""
    try:
        target = path.resolve(strict=True)
        is_file = target.is_file()
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or "a circle of links"
        raise DamagedError(f"{where}: {path.name} cannot be read ({reason}); expected a file in {root}") from None
    if not is_file or not target.is_relative_to(root.resolve()):
        what = "no regular file" if not is_file else "a link out of its folder"
        raise DamagedError(f"{where}: {path.name} is {what}; expected a file inside {root}")


def real_path(path: Path) -> Path:
    """The absolute path behind all links; where links go round in a circle it ends, and opening the path says so."""
    return Path(os.path.realpath(path))  # Path.resolve raises a RuntimeError at a circle before Python 3.13.


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_NAME else f"{text[:MAX_NAME]}..."


# Reading


TEMPORARY = re.compile(r".+\.[0-9a-f]{16}\.hyaline-tmp")
"""Name of a file while it is written. A killed writer may leave one; no other program uses such names."""

MAKE_AGAIN = "run the command that made it again, which keeps what is whole"
"""What to do about a damaged or lost file of ours."""

_OUT_OF_RESOURCES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EINTR)
"""Errors of the machine, not of the file: they are no reason to call it damaged and to make it again."""


def open_regular(path: Path) -> BinaryIO:
    """A regular file, opened for reading; links are followed.

    Raises:
        HyalineError: it is missing, or a folder, a pipe or a device, or it cannot be read.
        OSError: this process is out of memory or file handles.
    """
    try:
        with _refusing(path):
            # A pipe would wait for its writer, and a device may do anything: they are never opened.
            if not stat.S_ISREG(path.stat().st_mode):
                raise HyalineError(f"{path}: is a folder, a pipe or a device; expected a file")
            return path.open("rb")
    except ValueError as error:  # A NUL, or half of a surrogate pair.
        raise HyalineError(f"{shown(str(path))}: cannot be the path of a file ({error})") from error


def read_regular(path: Path, *, at_most: int | None = None) -> bytes:
    """The bytes of a regular file; an error if it holds more than `at_most`."""
    with open_regular(path) as file, _refusing(path):
        size = os.fstat(file.fileno()).st_size
        if at_most is not None and size > at_most:
            raise HyalineError(f"{path}: holds {size:,} bytes; expected at most {at_most:,}")
        return file.read()


@contextlib.contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turns errors of the system into a HyalineError, except those that say nothing about the file."""
    try:
        yield
    except OSError as error:
        if error.errno in _OUT_OF_RESOURCES:
            raise
        if error.errno == errno.ENOENT:
            raise DamagedError(f"{path}: the file is missing") from error
        raise HyalineError(describe_os_error(error, path)) from error


def sha256(data: bytes) -> str:
    """Hex SHA-256."""
    return hashlib.sha256(data).hexdigest()


def check_files(root: Path, files: Mapping[str, str]) -> None:
    """Raises a DamagedError that names the first file whose bytes are not the promised ones."""
    for relative, promised in files.items():
        read_promised(root, relative, promised)


def read_all(root: Path, files: Mapping[str, str]) -> list[bytes]:
    """The bytes of files below `root`, each of which are those that were promised; see `read_promised`."""
    return [read_promised(root, relative, promised) for relative, promised in files.items()]


def read_promised(root: Path, relative: str, promised: str) -> bytes:
    """The bytes of a file below `root`; a DamagedError if it is missing, or not the one whose SHA-256 was promised."""
    path = find_file(root, relative, where=str(root))
    try:
        data = read_regular(path)
    except DamagedError as error:
        raise DamagedError(f"{error}; {MAKE_AGAIN}") from None
    if sha256(data) != promised:
        raise DamagedError(f"{path}: damaged or edited (checksum differs); {MAKE_AGAIN}")
    return data


# Writing


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


@contextlib.contextmanager
def one_writer(root: Path, *, shared: bool = False) -> Iterator[None]:
    """Holds `root` for this process; the lock ends with the process, however that ends, and leaves no file.

    Args:
        shared: hold it beside others that share it, too, and know how not to step on each other.

    Raises:
        HyalineError: another process is writing there.
    """
    with naming(root):
        root.mkdir(parents=True, exist_ok=True)
        handle = os.open(root, os.O_RDONLY)
    try:
        try:
            with naming(root):
                fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            raise HyalineError(f"{root}: another process is writing there; wait for it, or stop it") from None
        yield
    finally:
        os.close(handle)


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
