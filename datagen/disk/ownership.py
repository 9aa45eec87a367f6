"""Which folders commands write to: new ones, empty ones, and those with an intact head of ours.

A head is a sealed JSON file that is written first, so that whatever a killed command leaves is ours, too. Only files
that a head lists or the folder's format names are ever removed or replaced, and temporary files of writers, whose names
no other program uses. Links below a head are not followed, since they lead to files that are not ours.
"""

import contextlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from datagen.disk.errors import HyalineError, printable
from datagen.disk.records import Json, commit_sealed, load_sealed, seal_bytes
from datagen.disk.storage import TEMPORARY, check_relative, commit_first, one_writer, try_place


@dataclass(frozen=True, kw_only=True)
class FolderKind:
    """A kind of folder that this program makes."""

    what: str
    """In words."""
    head: str
    """The sealed file in it that makes it ours."""
    folders: tuple[str, ...] = ()
    """Patterns of the folders below in which its files lie, but for those of folders with a head of their own."""
    way_out: str = "choose another --out"
    """What to do when something else stands there."""


_WITHIN_A_DATASET = "move that elsewhere, or delete the folder"
DATASET = FolderKind(what="dataset", head="dataset.json", folders=("scene", "images", "records"))
LAYERS = FolderKind(what="layers", head="layers.json", folders=("arrays", "records"), way_out=_WITHIN_A_DATASET)
PROXIES = FolderKind(what="proxies", head="proxies.json", folders=("meshes",), way_out=_WITHIN_A_DATASET)
EDIT_MASKS = FolderKind(what="edit masks", head="edit-masks.json", folders=("*",), way_out=_WITHIN_A_DATASET)


def is_ours(root: Path, kind: FolderKind) -> bool:
    """True when the folder's head stands there and verifies."""
    try:
        load_sealed(root / kind.head)
    except HyalineError:
        return False
    return True


@contextlib.contextmanager
def holding(root: Path, kind: FolderKind, *, within: Path | None = None, shared: bool = False) -> Iterator[None]:
    """Holds a folder alone, and clears what killed writers left if it is ours; or `shared`, where nothing is removed.

    Args:
        within: a folder of ours above it, from which no link may lead here.

    Raises:
        HyalineError: another process writes there, or a link leads from there to somewhere else.
    """
    if within is not None:
        refuse_links(within, root.relative_to(within))
    with one_writer(root, shared=shared):
        ours = is_ours(root, kind)
        for folder in _own_folders(root, kind) if ours else ():
            refuse_links(root, folder.relative_to(root))
        if not shared and (ours or _first_foreign(root) is None):
            _remove_temporaries(root, kind)
        yield


def begin(root: Path, kind: FolderKind, head: dict[str, Json], *, replace: bool = False) -> None:
    """Seals the head of a new or empty folder; the caller holds it. Of several processes at once, one head stays.

    Args:
        replace: replaces a head of ours that is there.

    Raises:
        HyalineError: something else is there.
    """
    refuse_others(root, kind)
    if not is_ours(root, kind):
        commit_first(root / kind.head, seal_bytes(head))
    elif replace:
        commit_sealed(root / kind.head, head)


def refuse_others(root: Path, kind: FolderKind) -> None:
    """Refuses a folder that is neither ours nor empty, before work is done for it; the error names a file in it."""
    foreign = root.name if root.is_file() else _first_foreign(root)
    if foreign is None or is_ours(root, kind):
        return
    if os.path.lexists(root / kind.head):
        raise HyalineError(f"{root / kind.head}: is damaged, or of another program; restore it, or move the folder")
    raise HyalineError(f"{root}: is not empty ({printable(foreign)}) and no {kind.what}; {kind.way_out}")


def refuse_taken(root: Path, kind: FolderKind, wanted: Iterable[str], own: Iterable[str]) -> None:
    """Refuses to write files where others stand that are not ours.

    Args:
        wanted: paths relative to `root` that will be written.
        own: those that are ours already.
    """
    known = set(own)
    for path in wanted:
        if path not in known and os.path.lexists(root / path):
            raise HyalineError(
                f"{root / path}: is in the way, and no file of this {kind.what}; move it elsewhere, or {kind.way_out}"
            )


def refuse_file(path: Path, *, overwrite: bool = False) -> None:
    """Refuses to write an output file where one stands; with `overwrite`, where something else than a file stands.

    Raises:
        OSError: nothing can be written there.
    """
    if path.exists() and not path.is_file():
        raise HyalineError(f"{path}: is a folder, a device or a pipe; choose another --out")
    if os.path.lexists(path) and not overwrite:
        raise HyalineError(f"{path}: already exists; use --overwrite to replace it, or choose another --out")
    try_place(path)


def refuse_links(root: Path, relative: Path) -> None:
    """Refuses a path below a folder of ours on which a link stands: what it leads to is not ours."""
    path = root
    for part in relative.parts:
        path = path / part
        if path.is_symlink():
            raise HyalineError(
                f"{path}: is a symbolic link, and hyaline does not write through links; replace it with its target, or "
                "remove it"
            )


def remove_files(root: Path, files: Iterable[str]) -> None:
    """Deletes files of ours below `root`, then the folders that are empty without them; the caller holds the folder.

    Anything but regular files is kept.

    Args:
        files: paths relative to `root`; those at which nothing stands are passed over.
    """
    emptied: set[Path] = set()
    for file in files:
        relative = Path(check_relative(file, where=str(root)))
        refuse_links(root, relative.parent)
        if _is_regular(root / relative):
            (root / relative).unlink(missing_ok=True)
        emptied.update(relative.parents)
    for folder in sorted(emptied - {Path()}, key=lambda path: len(path.parts), reverse=True):
        if (root / folder).is_dir() and not any((root / folder).iterdir()):
            (root / folder).rmdir()


def _is_regular(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _own_folders(root: Path, kind: FolderKind) -> list[Path]:
    return sorted(path for pattern in kind.folders for path in root.glob(pattern))


def _remove_temporaries(root: Path, kind: FolderKind) -> None:
    """Deletes what killed writers left, in the folder and in those that are its own; no link is followed."""
    below = (
        Path(place) / name for top in _own_folders(root, kind) for place, _, names in os.walk(top) for name in names
    )
    for path in (*root.iterdir(), *below):
        if TEMPORARY.fullmatch(path.name) and _is_regular(path):
            path.unlink(missing_ok=True)


def _first_foreign(root: Path) -> str | None:
    """The relative path of a file or link below a folder, except temporaries of ours; None without any."""
    for place, folders, names in os.walk(root):
        folders.sort()
        links = [name for name in folders if (Path(place) / name).is_symlink()]
        for name in sorted([*names, *links]):
            if not TEMPORARY.fullmatch(name):
                return (Path(place) / name).relative_to(root).as_posix()
    return None
