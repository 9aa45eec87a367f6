"""The exceptions that a user can act upon, and errors of the operating system in words."""

import contextlib
import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path

MAX_MESSAGE = 900
"""Characters."""


class HyalineError(Exception):
    """What went wrong, in one line: `{where}: {what, with the value}; {the way out}`.

    Commands print it without a traceback and exit with `status`. Where a value that somebody wrote makes it longer than
    a few lines of a terminal, its middle is left out.
    """

    status = 1

    def __init__(self, message: str) -> None:
        super().__init__(message if len(message) <= MAX_MESSAGE else f"{message[:600]} ... {message[-250:]}")


class DamagedError(HyalineError):
    """A file is missing, or does not hold what was promised: what can make it may make it again."""


class WorkerKilledError(HyalineError):
    """A worker process ended in the middle of its work, by a signal; what others had finished is kept."""


class NumericsError(HyalineError):
    """A number that has to be finite is not: it came from damaged data or from training that diverged."""

    status = 3


class UsageError(HyalineError):
    """A command was typed that does not exist."""

    status = 2


# Errors of the operating system


REASONS: dict[int, tuple[str, str]] = {
    errno.ENOSPC: ("no space is left on its file system", "make room there, or choose another place"),
    errno.EDQUOT: ("the disk quota is used up", "make room there, or choose another place"),
    errno.EFBIG: ("the file would be larger than allowed", "raise the limit (`ulimit -f`), or choose another place"),
    errno.EROFS: ("its file system is read-only", "choose another place"),
    errno.EACCES: ("permission denied", "change the permissions there, or choose another place"),
    errno.EPERM: ("not permitted", "change the permissions there, or choose another place"),
    errno.ENOENT: ("no such file or folder", "check the path"),
    errno.EISDIR: ("is a folder, where a file belongs", "move it away, or choose another place"),
    errno.ENOTDIR: ("a part of this path is a file, where a folder belongs", "move it away, or choose another place"),
    errno.EEXIST: ("something else stands there", "move it away, or choose another place"),
    errno.ENOTEMPTY: ("the folder holds something else", "move that away, or choose another place"),
    errno.ENAMETOOLONG: ("the name is too long", "choose a shorter one"),
    errno.EINVAL: ("the file system does not take it", "choose another name or another place"),
    errno.ELOOP: ("its links go round in a circle", "remove one of them"),
    errno.EBADF: ("is closed", "redirect it to a file, or to /dev/null"),
    errno.ENXIO: ("is a device or a pipe", "give a file"),
    errno.EMFILE: ("too many files are open in this process", "raise the limit (`ulimit -n`)"),
    errno.ENFILE: ("too many files are open on this machine", "close some programs"),
    errno.ENOMEM: ("out of memory", "use fewer --workers, or a machine with more memory"),
    errno.EAGAIN: ("the system has no process or lock to spare", "raise the limit (`ulimit -u`), or try again"),
    errno.EIO: ("the disk reports an error in reading or writing", "check the disk, or choose another place"),
    errno.EBUSY: ("another program uses it", "wait for that program"),
    errno.ETXTBSY: ("another program runs it", "wait for that program"),
    errno.ESTALE: ("the network file system has lost it", "mount it again"),
    errno.ETIMEDOUT: ("the network file system does not answer", "wait for it, or choose another place"),
    errno.ENODEV: ("the device is not there", "attach it, or choose another place"),
    errno.EXDEV: ("lies on another file system", "choose another place"),
    errno.EMLINK: ("too many links lead to it", "choose another place"),
}
"""Why, and the way out, by number."""


OUT_OF_MEMORY = re.compile("not enough memory|can't allocate memory|out of memory", re.IGNORECASE)
"""In the RuntimeError of a torch that was refused memory, on a CPU or on a GPU."""


def as_hyaline_error(error: BaseException) -> HyalineError | None:
    """What to tell about an error that is no fault of ours: of the system, or for want of memory; None for others."""
    if isinstance(error, OSError):
        # A full disk, a read-only folder, a missing permission: what is committed stays valid.
        return HyalineError(describe_os_error(error, error.filename or "standard output, or a temporary file"))
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and OUT_OF_MEMORY.search(str(error))):
        return HyalineError(
            "out of memory; use fewer --workers, a smaller --batch or smaller sizes, or a machine with more memory"
        )
    return None


def describe_os_error(error: OSError, path: Path | str | None = None) -> str:
    """One line about an error of the system.

    Args:
        path: what was being read or written, where the error does not know it, or knows a temporary name.
    """
    place = path if path is not None else error.filename
    where = "" if isinstance(place, int) or place is None else f"{os.fsdecode(place)}: "
    if error.errno not in REASONS:
        reason = error.strerror or str(error) or type(error).__name__
        return f"{where}{reason}; mend that, then run the same command again"
    reason, way_out = REASONS[error.errno]
    return f"{where}{reason}; {way_out}, then run the same command again"


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Lets every error of the system that leaves the block name `path`: many know no file, or a temporary one."""
    try:
        yield
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
