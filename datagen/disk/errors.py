"""The exceptions that a user can act upon, values and texts as they show them, and errors of the system in words."""

import contextlib
import errno
import os
import re
import reprlib
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


_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 80
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = 4
_REPR.maxlevel = 3


def shown(value: object) -> str:
    """A value as an error shows it: like `repr`, but in one short line whatever it is."""
    return _REPR.repr(value)


def printable(text: str) -> str:
    """`text` in one line that a terminal only shows: control characters, line breaks and the like are spelled out."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)


# Errors of the operating system


WAYS_OUT: dict[int, str] = {
    errno.ENOENT: "check the path",
    errno.EFBIG: "raise the limit (`ulimit -f`)",
    errno.EMFILE: "raise the limit (`ulimit -n`)",
    errno.EAGAIN: "raise the limit (`ulimit -u`), or try again",
    errno.ENOMEM: "use fewer --workers, or a machine with more memory",
    errno.EBADF: "redirect it to a file, or to /dev/null",
    errno.EXDEV: "choose another place",
}
"""What helps, by number; for others, to make room or to choose another place."""

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
    reason = (error.strerror or str(error) or type(error).__name__).lower()
    way_out = WAYS_OUT.get(error.errno or 0, "mend that, or choose another place")
    return f"{where}{reason}; {way_out}, then run the same command again"


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Lets every error of the system that leaves the block name `path`: many know no file, or a temporary one."""
    try:
        yield
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
