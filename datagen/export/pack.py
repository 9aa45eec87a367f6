"""A dataset as one file: a tar archive with an index of its files, whose bytes depend on the dataset alone.

    SCENE/hyaline-pack.json    sealed: version, scene, seal of the dataset, licence, size and SHA-256 of every file
    SCENE/...                  the dataset's files, sorted by path
    SCENE/dataset.json         last: a folder without it is not a dataset

Any tar program unpacks it. `unpack_archive` accepts only the bytes that `pack_dataset` writes: it compares headers with
those that follow from the index, and acts on none of them. Pictures and layers are compressed already; another
compression of the archive would save 2 %.
"""

import fcntl
import hashlib
import io
import os
import shutil
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, cast

from datagen.build.verify import Findings, verify_dataset
from datagen.data.dataset import open_dataset
from datagen.data.metadata import unknown_license
from datagen.data.paths import DATA_ROOT
from datagen.disk.errors import DamagedError, HyalineError, UsageError, naming
from datagen.disk.names import check_name, check_relative, real_path
from datagen.disk.ownership import DATASET, refuse_file
from datagen.disk.records import MAX_JSON_BYTES, Json, from_json, open_regular, parse_json, shown, to_json
from datagen.disk.storage import SEAL, one_writer, seal_bytes, sha256, sha256_file, sync_folder
from datagen.export.formats import EXPORTS
from datagen.terminal.command import say, say_all, track

INDEX = "hyaline-pack.json"
VERSION = 1
BLOCK = tarfile.BLOCKSIZE
END = bytes(2 * BLOCK)
"""Two empty blocks end a tar archive."""
MAX_FOLDER = 64
"""Characters of the folder's name, with which the header of the index is a single block."""
CHUNK = 1 << 20


@dataclass(frozen=True, kw_only=True)
class _PackedFile:
    """A file in an archive."""

    size: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class _Index:
    """What an archive holds."""

    version: int
    scene: str
    """Name of the scene, and of the archive's one folder."""
    dataset: str
    """Seal of the dataset."""
    license: str
    files: dict[str, _PackedFile]
    """By path relative to the dataset."""

    def __post_init__(self) -> None:
        check_name(self.scene, where="scene")
        for path, file in self.files.items():
            check_relative(path, where="files")
            if file.size < 0 or any(str(folder) in self.files for folder in PurePosixPath(path).parents):
                raise HyalineError(f"files: {path} has {file.size} bytes, or lies in another file; expected a file")


@dataclass(frozen=True, kw_only=True)
class _Member:
    """A file in the archive's bytes: its header, its content, and zeros up to a full block."""

    path: str
    """Relative to the dataset."""
    header: bytes
    size: int
    sha256: str

    @property
    def padding(self) -> bytes:
        return bytes(-self.size % BLOCK)

    @property
    def length(self) -> int:
        return len(self.header) + self.size + len(self.padding)


def _members(index: _Index) -> tuple[bytes, list[_Member]]:
    """The bytes of the index, and everything in the archive in its order, the index first."""
    data = seal_bytes(cast(dict[str, Json], to_json(index)))
    files = {INDEX: _PackedFile(size=len(data), sha256=sha256(data))}
    files |= sorted(index.files.items(), key=lambda item: (item[0] == DATASET.head, item[0]))
    folder = index.scene[:MAX_FOLDER]
    return data, [
        _Member(path=path, header=_header(f"{folder}/{path}", file.size), size=file.size, sha256=file.sha256)
        for path, file in files.items()
    ]


def _header(name: str, size: int) -> bytes:
    """The header of a regular file with mode 644, without owner or time."""
    entry = tarfile.TarInfo(name)
    entry.size = size
    return entry.tobuf(tarfile.PAX_FORMAT)


# Packing


def pack_dataset(root: Path, out: Path | None, *, overwrite: bool) -> Path:
    """Packs a finished dataset, after verifying every byte, into an archive; files that are not its own are left out.

    A killed call leaves its work beside `out` under a temporary name, and the next call continues it.

    Returns:
        The archive: `out`, or by default one in `exports`.

    Raises:
        HyalineError: the dataset is unfinished or damaged, or `out` is another file.
    """
    out = out or EXPORTS / f"{real_path(root).name}.tar"
    if out.suffix != ".tar":
        raise UsageError(f"--out {out}: ends in {out.suffix!r}; expected .tar")
    dataset = open_dataset(root)
    if dataset.parent is not None:
        raise HyalineError(f"{root}: is a variant; pack the dataset around it, {dataset.parent.root}")
    if real_path(out).is_relative_to(real_path(root)):
        raise HyalineError(f"--out: {out} lies in the dataset, which keeps to its own files; choose a place outside")
    say(f"{root}: checks every byte")
    found = verify_dataset(root)
    if found.problems:
        more = f" (and {len(found.problems) - 1} more problems: `datagen verify`)" if len(found.problems) > 1 else ""
        raise HyalineError(f"{found.problems[0]}{more}")
    say_all(found.remarks)
    files = {path: _PackedFile(size=(root / path).stat().st_size, sha256=found.files[path]) for path in found.files}
    scene = dataset.config.scene
    terms = dataset.stated_license or unknown_license(f"dataset {scene}")  # The folder's name may change.
    data, members = _members(_Index(version=VERSION, scene=scene, dataset=dataset.seal, license=terms, files=files))
    if len(data) > MAX_JSON_BYTES:
        raise HyalineError(f"{root}: has {len(files):,} files, which are too many for an archive's index")
    if out.is_file() and not overwrite and _holds(out, members):
        say(f"{out}: is finished")
        return out
    if not overwrite:
        refuse_file(out)
    with _held_file(out) as (archive, temporary):
        _write(archive, root, data, members)
        archive.flush()
        os.fsync(archive.fileno())
        temporary.replace(out)
        sync_folder(out.parent)
    say(f"{out}: {len(files):,} files, {sum(member.length for member in members) / 1e6:,.1f} MB; licence: {terms}")
    return out


@contextmanager
def _held_file(out: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """The temporary file that becomes `out`, locked by this process, with an earlier process's work; and its path."""
    # The same name in each call, so that an interrupted one is continued.
    path = out.with_name(f"{out.name}.{sha256(INDEX.encode())[:16]}.hyaline-tmp")
    with naming(out):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():
            path.unlink()
        with path.open("a+b") as archive:
            try:
                fcntl.flock(archive, fcntl.LOCK_EX | fcntl.LOCK_NB)
                is_held = os.path.samestat(path.stat(), os.fstat(archive.fileno()))
            except (BlockingIOError, FileNotFoundError):
                is_held = False
            if not is_held:
                raise HyalineError(f"{out}: another process is writing it; wait for that, or stop it")
            yield archive, path


def _write(archive: BinaryIO, root: Path, index: bytes, members: list[_Member]) -> None:
    """Writes the missing rest of an archive, after cutting off whatever does not belong there."""
    archive.seek(0)
    done = place = 0
    while done < len(members) and _read_member(archive, members[done]):
        place += members[done].length
        done += 1
    archive.truncate(place)
    archive.seek(place)
    for member in track(members[done:], label="pack", total=len(members), done=done):
        archive.write(member.header)
        with io.BytesIO(index) if member.path == INDEX else open_regular(root / member.path) as source:
            if not _copy(source, member, archive):
                raise DamagedError(f"{root / member.path}: changed while it was packed; run the same command again")
        archive.write(member.padding)
    archive.write(END)


def _read_member(archive: BinaryIO, member: _Member, target: BinaryIO | None = None) -> bool:
    """Reads the next member of an archive, into `target` if there is one; True if it is the expected one."""
    return (
        archive.read(len(member.header)) == member.header
        and _copy(archive, member, target)
        and archive.read(len(member.padding)) == member.padding
    )


def _copy(source: BinaryIO, member: _Member, target: BinaryIO | None) -> bool:
    """Copies the content of a member; True if it is the promised one."""
    digest, left = hashlib.sha256(), member.size
    while left and (chunk := source.read(min(left, CHUNK))):
        digest.update(chunk)
        left -= len(chunk)
        if target is not None:
            target.write(chunk)
    return digest.hexdigest() == member.sha256


def _holds(path: Path, members: list[_Member]) -> bool:
    """True if an archive is made of these members, every byte of it."""
    with open_regular(path) as archive:
        return all(_read_member(archive, member) for member in members) and archive.read(len(END) + 1) == END


# Unpacking


def unpack_archive(path: Path, into: Path | None) -> Path:
    """Unpacks a dataset, and returns its folder, which appears when all of it is there and verifies.

    A killed call leaves its work beside the folder under a temporary name, and the next call continues it.

    Args:
        into: the dataset's folder; None: its scene's name in `data`.

    Raises:
        HyalineError: the archive is damaged or was not made by `pack_dataset`, or the folder holds something else.
    """
    with open_regular(path) as archive:
        index, members = _read_index(archive, path)
        into = into or DATA_ROOT / index.scene
        if os.path.lexists(into) and not (into.is_dir() and not any(into.iterdir())):
            other = next((member.path for member in members[1:] if not _is_there(into, member)), None)
            if other is not None:
                raise HyalineError(f"{into}: is taken, and {other} is not that of {path}; choose another --out")
            say(f"{into}: holds this dataset already")
            return into
        into = real_path(into)
        temporary = into.with_name(f"{into.name}.{members[0].sha256[:16]}.hyaline-tmp")
        with one_writer(temporary), naming(into):
            try:
                _unpack_members(archive, path, members, temporary)
                _check_unpacked(path, verify_dataset(temporary))
            except HyalineError:
                shutil.rmtree(temporary)
                raise
            temporary.rename(into)
            sync_folder(into.parent)
    say(f"{into}: {len(index.files):,} files; licence: {index.license}")
    return into


def _read_index(archive: BinaryIO, path: Path) -> tuple[_Index, list[_Member]]:
    """Reads the index at the start of an archive, and checks the length of the whole file against it."""
    start = archive.read(BLOCK)
    try:
        size = tarfile.TarInfo.frombuf(start, "utf-8", "strict").size
    except (tarfile.TarError, UnicodeDecodeError):
        size = -1
    if not 0 < size <= MAX_JSON_BYTES:
        raise HyalineError(f"{path}: is no archive of `datagen pack`; expected one that begins with {INDEX}")
    data = archive.read(size)
    content = parse_json(data, where=f"{path}: {INDEX}")
    content.pop(SEAL, None)
    if content.get("version") != VERSION:
        raise HyalineError(f"{path}: version is {shown(content.get('version'))}; expected {VERSION}; update hyaline")
    try:
        index = from_json(_Index, content, where=INDEX)
    except HyalineError as error:
        raise HyalineError(f"{path}: {error}") from None
    expected, members = _members(index)
    if (start, data) != (members[0].header, expected):
        raise DamagedError(f"{path}: {INDEX} does not match its own checksum; get the archive again")
    found, length = os.fstat(archive.fileno()).st_size, sum(member.length for member in members) + len(END)
    if found != length:
        raise DamagedError(f"{path}: has {found:,} bytes; expected {length:,}; get the archive again")
    return index, members


def _is_there(root: Path, member: _Member) -> bool:
    """True if a file of a dataset is the expected one."""
    try:
        return not (root / member.path).is_symlink() and sha256_file(root / member.path) == member.sha256
    except HyalineError:
        return False


def _unpack_members(archive: BinaryIO, path: Path, members: list[_Member], root: Path) -> None:
    """Writes the files that are not there yet."""
    archive.seek(members[0].length)
    for member in track(members[1:], label="unpack", total=len(members) - 1):
        target = root / member.path
        if _is_there(root, member):
            archive.seek(member.length, os.SEEK_CUR)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        with target.open("xb") as file:
            if not _read_member(archive, member, file):
                raise DamagedError(f"{path}: {member.path} is damaged; get the archive again")
            file.flush()
            os.fsync(file.fileno())
    if archive.read() != END:
        raise DamagedError(f"{path}: its end is damaged; get the archive again")


def _check_unpacked(path: Path, found: Findings) -> None:
    """Refuses files that are whole, but no dataset."""
    for line in (*found.problems, *found.remarks):
        raise HyalineError(f"{path}: holds no finished dataset ({line.split('; ')[0]})")
