"""Everything in a folder: files, folders, links and pipes, classified without opening any.

No link is followed: what it leads to is not in the folder.
"""

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

Kind = Literal["file", "folder", "link", "pipe", "device"]


class Survey:
    """A folder at one moment."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.kinds: dict[str, Kind] = dict(_walk(root, ""))
        """By path relative to the folder."""

    def obstacle(self, relative: str) -> tuple[str, str] | None:
        """What keeps a path from being a regular file: the place, and what is wrong there; None when it is one."""
        parts = relative.split("/")
        for count in range(1, len(parts)):
            folder = "/".join(parts[:count])
            kind = self.kinds.get(folder)
            if kind is None:
                return folder, "the whole folder is missing"
            if kind != "folder":
                return folder, f"is a {kind}; expected a folder"
        kind = self.kinds.get(relative)
        if kind is None:
            return relative, "the file is missing"
        return None if kind == "file" else (relative, f"is a {kind}; expected a file")

    def has(self, relative: str) -> bool:
        """True when a regular file stands there, on a way of folders."""
        return self.obstacle(relative) is None


def _walk(root: Path, prefix: str) -> Iterator[tuple[str, Kind]]:
    with os.scandir(root) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            kind = _kind(entry)
            yield prefix + entry.name, kind
            if kind == "folder":
                yield from _walk(Path(entry.path), f"{prefix}{entry.name}/")


def _kind(entry: os.DirEntry[str]) -> Kind:
    mode = entry.stat(follow_symlinks=False).st_mode
    kinds: dict[int, Kind] = {stat.S_IFREG: "file", stat.S_IFDIR: "folder", stat.S_IFLNK: "link", stat.S_IFIFO: "pipe"}
    return kinds.get(stat.S_IFMT(mode), "device")
