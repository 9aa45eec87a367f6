"""A watched disk: sees every change of a folder before it happens, keeps each state, or makes the n-th change fail.

Changes are seen by Python's audit events, which no code that runs in Python goes around: opening a file for writing,
making, renaming, linking and deleting. Writing and syncing raise no such event; there `open` and `os.fsync` are
replaced. What a native library or another process writes is not seen, so `observe` refuses a tree that holds such a
file: an enumeration of all writes would be none.
"""

import builtins
import contextlib
import dataclasses
import errno
import io
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True)
class Change:
    """One change of the disk that is about to happen."""

    what: str
    """`open`, `write`, `fsync`, `mkdir`, `rename`, `link`, `symlink`, `remove`, `rmdir` or `truncate`."""
    path: str
    """The file or folder that changes, relative to the watched folder; of a rename or link the new name."""


@dataclass(frozen=True, kw_only=True)
class State:
    """A folder as a killed process would leave it."""

    before: str
    """The change that did not happen any more, in words."""
    after: Change | None = None
    """The last change that happened, syncs aside."""
    files: dict[str, bytes]
    folders: frozenset[str]

    def restore(self, root: Path) -> None:
        """Makes an empty folder hold this state."""
        for folder in sorted(self.folders):
            (root / folder).mkdir()
        for path, data in self.files.items():
            (root / path).write_bytes(data)


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What a command did to a folder."""

    changes: tuple[Change, ...]
    states: tuple[State, ...]
    """Every state that was different from the one before, the last one included."""


def read_state(root: Path, before: str = "the end") -> State:
    """What a folder holds now."""
    files, folders = {}, set()
    for place, names, leaves in os.walk(root):
        inner = os.path.relpath(place, root)
        folders |= {os.path.normpath(os.path.join(inner, name)) for name in names}
        for leaf in leaves:
            path = os.path.normpath(os.path.join(inner, leaf))
            files[path] = Path(place, leaf).read_bytes()
    return State(before=before, files=files, folders=frozenset(folders))


def differing(found: State, expected: State) -> str:
    """Every file or folder that is not what it should be; empty when there is none."""
    wrong = [f"{path} is left over" for path in sorted(found.files.keys() - expected.files.keys())]
    wrong += [f"{path} is missing" for path in sorted(expected.files.keys() - found.files.keys())]
    for path in sorted(found.files.keys() & expected.files.keys()):
        one, other = found.files[path], expected.files[path]
        if one != other:
            count = sum(a != b for a, b in zip(one, other, strict=False))
            wrong.append(f"{path} differs (in {count} of {len(one)} bytes; should have {len(other)})")
    return ", ".join([*wrong, *sorted(found.folders ^ expected.folders)])


def empty(folder: Path) -> None:
    """Deletes what a folder holds, and not the folder: commands run in it."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def observe(root: Path, command: Callable[[], None]) -> Observation:
    """Runs a command and keeps every state in which a kill would have left the folder.

    A state is read before each change, and in the middle of each write.
    """
    start = set(read_state(root).files)
    changes: list[Change] = []
    states: list[State] = []

    def keep(change: Change) -> None:
        changes.append(change)
        if change.what != "fsync":
            before = f"change {len(changes)}: {change.what} {change.path}"
            last = next((earlier for earlier in reversed(changes[:-1]) if earlier.what != "fsync"), None)
            add(dataclasses.replace(read_state(root, before), after=last))

    def add(state: State) -> None:
        if not states or (states[-1].files, states[-1].folders) != (state.files, state.folders):
            states.append(state)

    with watch(root, keep):
        command()
    end = read_state(root)
    add(end)
    renamed = {change.path for change in changes if change.what == "rename"}
    unseen = set(end.files) - start - {change.path for change in changes}
    unseen = {path for path in unseen if renamed.isdisjoint(map(str, PurePosixPath(path).parents))}
    assert not unseen, f"written behind the watch's back: {sorted(unseen)}"
    return Observation(changes=tuple(changes), states=tuple(states))


Fault = Literal["ENOSPC", "EIO", "EROFS"]
GROWING = ("open", "write", "mkdir", "rename", "link", "symlink")
"""Changes that a full disk refuses."""


def failing_from(root: Path, number: int, fault: Fault) -> contextlib.AbstractContextManager[list[Change]]:
    """A disk that refuses its change of a number, counted from 0, and what a disk in that state refuses after it.

    A full disk refuses what grows, from then on; a defect is met once; a file system that was mounted read-only
    refuses everything from then on. Yields the list of the changes that were refused.
    """
    count = 0
    refused: list[Change] = []

    def refuse(change: Change) -> None:
        nonlocal count
        is_due = count == number if fault == "EIO" else count >= number
        count += 1
        if is_due and not (fault == "ENOSPC" and change.what not in GROWING):
            refused.append(change)
            code = getattr(errno, fault)
            # What the system refuses to write or to sync it knows by a number; only Python could tell the name.
            names = () if change.what in ("write", "fsync") else (str(root / change.path),)
            raise OSError(code, os.strerror(code), *names)

    return watch(root, refuse, refused)


# The watch


_lock = threading.RLock()
_active: "tuple[str, Callable[[Change], None]] | None" = None
_is_reading = threading.local()
_is_hooked = False
_true_open = io.open

_CHANGING: dict[str, tuple[int, int | None]] = {
    "os.mkdir": (0, 2),
    "os.remove": (0, 1),
    "os.rmdir": (0, 1),
    "os.rename": (1, 3),
    "os.link": (1, 3),
    "os.symlink": (1, 2),
    "os.truncate": (0, None),
}
"""Of an audit event, the argument that is the changed path, and the one that is the folder it is relative to."""


@contextlib.contextmanager
def watch(root: Path, before: Callable[[Change], None], result: Any = None) -> Iterator[Any]:
    """Calls `before` ahead of each change under `root` (in any thread, one at a time); it may raise to prevent it."""
    global _active, _is_hooked
    assert _active is None, "one watch at a time"
    if not _is_hooked:
        sys.addaudithook(_hear)
        _is_hooked = True
    _active = (os.path.realpath(root) + os.sep, before)
    io.open = builtins.open = _open  # pyright: ignore
    fsync, os.fsync = os.fsync, _fsync
    try:
        yield result
    finally:
        os.fsync = fsync
        io.open = builtins.open = _true_open
        _active = None


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    if _active is None or getattr(_is_reading, "now", False):
        return
    if event == "open":
        path, _, flags = arguments
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND):
            _announce("open", path)
    elif event in _CHANGING:
        place, folder = _CHANGING[event]
        _announce(event.removeprefix("os."), arguments[place], -1 if folder is None else arguments[folder])


def _announce(what: str, path: Any, folder: int = -1) -> None:
    """Tells the watcher of a change, when it is under the root and would change anything."""
    if _active is None or not isinstance(path, str | bytes | os.PathLike):
        return
    root, before = _active
    full = os.path.join(os.readlink(f"/proc/self/fd/{folder}") if folder >= 0 else os.getcwd(), os.fsdecode(path))
    full = os.path.normpath(full)
    if not full.startswith(root):
        return
    # What fails by itself changes nothing: a folder that is there already, a file that is not.
    if os.path.lexists(full) if what in ("mkdir", "link") else not os.path.lexists(full) and what in _DELETING:
        return
    with _lock:
        _is_reading.now = True
        try:
            before(Change(what=what, path=full[len(root) :]))
        finally:
            _is_reading.now = False


_DELETING = ("remove", "rmdir", "truncate")


def _fsync(handle: Any) -> None:
    """Tells of it, and does nothing: only a power cut could tell the difference."""
    number = handle if isinstance(handle, int) else handle.fileno()
    _announce("fsync", os.readlink(f"/proc/self/fd/{number}"))


def _open(file: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
    is_ours = _active is not None and isinstance(file, str | bytes | os.PathLike) and set(mode) & set("wax+")
    if not is_ours or not os.path.realpath(os.fsdecode(file)).startswith(_active[0]):  # pyright: ignore
        return _true_open(file, mode, *rest, **more)
    raw = _WatchedFile(file, mode.replace("b", "").replace("t", ""))
    buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
    if "b" in mode:
        return buffered
    given = dict(zip(("buffering", "encoding", "errors", "newline"), rest)) | more
    return io.TextIOWrapper(buffered, *(given.get(name) for name in ("encoding", "errors", "newline")))


class _WatchedFile(io.FileIO):
    """A file whose every write is two: a kill, or a full disk, may come in the middle."""

    def write(self, data: Any, /) -> int:
        view = memoryview(data).cast("B")
        _announce("write", self.name)
        written = super().write(view[: len(view) // 2])
        _announce("write", self.name)
        return written + super().write(view[written:])
