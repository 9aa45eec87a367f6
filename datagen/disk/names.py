"""Strings from files and people: which may become a path, a file's name, or a line on a terminal.

Whatever a file says is checked here before it is joined to a path or printed: a name is one component of a path, a
relative path stays below its root, and what is printed holds no control characters.
"""

import os
import re
from pathlib import Path

from datagen.disk.errors import DamagedError, HyalineError

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
    """`text`, when it `is_name`.

    Raises:
        HyalineError: it is anything else, such as a path, or begins with a dot or a dash.
    """
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

    Raises:
        HyalineError: it is absolute or too long, has a part that is `..` or empty, or holds control characters or a
            backslash.
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

    A path at which nothing stands is returned as it is.

    Raises:
        HyalineError: not a path below `root`, or what stands there is a folder, a pipe, a device, or a link out.
    """
    path = root / check_relative(relative, where=where)
    if os.path.lexists(path):
        check_regular(path, root, where=where)
    return path


def check_regular(path: Path, root: Path, *, where: str) -> None:
    """Refuses links that lead out of `root`, and anything but regular files.

    Raises:
        DamagedError: it is one of these, or a link that leads nowhere.
    """
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


def printable(text: str) -> str:
    """`text` in one line that a terminal only shows: control characters, line breaks and the like are spelled out."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_NAME else f"{text[:MAX_NAME]}..."
