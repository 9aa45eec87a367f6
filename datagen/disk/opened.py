"""What a process has opened and verified, and need not open again while its file is the same."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

Value = TypeVar("Value")


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
            return open_it()  # It knows what to say.
        mark = (status.st_ino, status.st_size, status.st_mtime_ns)
        if path not in self._kept or self._kept[path][0] != mark:
            self._kept[path] = (mark, open_it())
        return cast(Value, self._kept[path][1])
