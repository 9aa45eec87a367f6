"""A hostile file: where it lies, what reads it, and how it comes to lie there."""

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Case:
    """One file or folder that is not what its reader hopes for."""

    name: str
    reader: str
    """A key of `readers.READERS`."""
    path: str
    """Relative to the world that the readers read."""
    content: bytes | Callable[[Path], None]
    """What lies there, or what puts it there."""
    key: str | None = None
    """The last name on the way to the value that is wrong in it, if it is one value."""

    def place(self, world: Path) -> None:
        """Replaces what the world has there."""
        path = world / self.path
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        if isinstance(self.content, bytes):
            path.write_bytes(self.content)
        else:
            self.content(path)


def not_files(reader: str, path: str, *, may_be_link: bool = False) -> list[Case]:
    """Things that lie where a file belongs.

    Args:
        may_be_link: to a file anywhere: what a person names, and runs, which are no scene from elsewhere.
    """

    def loop(place: Path) -> None:
        place.symlink_to(place.name)

    makers: dict[str, Callable[[Path], None]] = {
        "nothing": lambda place: None,
        "folder": Path.mkdir,
        "pipe": os.mkfifo,
        "link to itself": loop,
        "link to nothing": lambda place: place.symlink_to("nowhere"),
        "link to a secret": lambda place: place.symlink_to(Path(os.environ["HYALINE_SECRET"])),
        "endless": lambda place: place.symlink_to("/dev/zero"),
        "empty": lambda place: place.write_bytes(b"") and None,
    }
    if may_be_link:
        del makers["link to a secret"]
    return [Case(name=f"{path} {name}", reader=reader, path=path, content=make) for name, make in makers.items()]
