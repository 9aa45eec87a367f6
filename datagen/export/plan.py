"""What an export writes: parts of a few files each, whose names are known before any of them is made."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Part:
    """Files that are made together; they exist when all of them are there."""

    name: str
    """Unique in the export, and the name of a file without its ending."""
    files: tuple[str, ...]
    """Paths relative to the export."""
    make: Callable[[], Mapping[str, bytes]]
    """The bytes of each of `files`; the same at each call."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All parts of an export, in the order in which they are made."""

    parts: tuple[Part, ...]
    hint: str
    """How the tool opens it, with OUT for the folder."""

    @property
    def files(self) -> list[str]:
        """All files, sorted."""
        return sorted(file for part in self.parts for file in part.files)
