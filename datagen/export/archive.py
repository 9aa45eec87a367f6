"""A tar archive that begins with a sealed index of its files, and whose bytes depend on their content alone.

    FOLDER/INDEX.json    sealed: whatever describes the archive, and size and SHA-256 of every file
    FOLDER/...           the files, sorted by path

Any tar program unpacks it. Only the bytes that `write_archive` writes are accepted: headers are compared with those
that follow from the index, and none of them is acted on. So links, absolute paths and unlisted files are refused.
"""

import fcntl
import hashlib
import io
import os
import tarfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, TypeVar

from datagen.disk.errors import DamagedError, HyalineError, naming
from datagen.disk.names import check_relative
from datagen.disk.records import MAX_JSON_BYTES, Json, from_json, open_regular, parse_json, shown
from datagen.disk.storage import SEAL, sha256, sha256_file, sync_folder
from datagen.terminal.command import track

BLOCK = tarfile.BLOCKSIZE
END = bytes(2 * BLOCK)
"""Two empty blocks end a tar archive."""
MAX_FOLDER = 64
"""Characters of the folder's name, with which the header of the index is a single block."""
CHUNK = 1 << 20

Index = TypeVar("Index")


@dataclass(frozen=True, kw_only=True)
class PackedFile:
    """A file in an archive."""

    size: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Member:
    """A file in the archive's bytes: its header, its content, and zeros up to a full block."""

    path: str
    """Relative to the folder."""
    header: bytes
    size: int
    sha256: str

    @property
    def padding(self) -> bytes:
        return bytes(-self.size % BLOCK)

    @property
    def length(self) -> int:
        return len(self.header) + self.size + len(self.padding)


def check_packed(files: Mapping[str, PackedFile]) -> None:
    """Raises a HyalineError unless these can be files of one folder."""
    for path, file in files.items():
        check_relative(path, where="files")
        if file.size < 0 or any(str(folder) in files for folder in PurePosixPath(path).parents):
            raise HyalineError(f"files: {path} has {file.size} bytes, or lies in another file; expected a file")


def packed_json(files: Mapping[str, PackedFile]) -> Json:
    """Files as an index lists them."""
    return {path: {"size": file.size, "sha256": file.sha256} for path, file in files.items()}


def list_members(
    index: bytes, name: str, folder: str, files: Mapping[str, PackedFile], *, last: str = ""
) -> list[Member]:
    """Everything in the archive in its order: the index, then the files, with `last` at the end."""
    listed = {name: PackedFile(size=len(index), sha256=sha256(index))}
    listed |= sorted(files.items(), key=lambda item: (item[0] == last, item[0]))
    top = folder[:MAX_FOLDER]
    return [
        Member(path=path, header=_header(f"{top}/{path}", file.size), size=file.size, sha256=file.sha256)
        for path, file in listed.items()
    ]


def _header(name: str, size: int) -> bytes:
    """The header of a regular file with mode 644, without owner or time."""
    entry = tarfile.TarInfo(name)
    entry.size = size
    return entry.tobuf(tarfile.PAX_FORMAT)


# Packing


def write_archive(out: Path, index: bytes, members: Sequence[Member], sources: Mapping[str, Path]) -> None:
    """Writes an archive to `out`.

    A killed call leaves its work beside `out` under a temporary name, and the next call continues it.

    Args:
        sources: where the files lie, by path in the archive.
    """
    with _held_file(out, members[0].path) as (archive, temporary):
        _write(archive, index, members, sources)
        archive.flush()
        os.fsync(archive.fileno())
        temporary.replace(out)
        sync_folder(out.parent)


@contextmanager
def _held_file(out: Path, index_name: str) -> Iterator[tuple[BinaryIO, Path]]:
    """The temporary file that becomes `out`, locked by this process, with an earlier process's work; and its path."""
    # The same name in each call, so that an interrupted one is continued.
    path = out.with_name(f"{out.name}.{sha256(index_name.encode())[:16]}.hyaline-tmp")
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


def _write(archive: BinaryIO, index: bytes, members: Sequence[Member], sources: Mapping[str, Path]) -> None:
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
        with io.BytesIO(index) if member is members[0] else open_regular(sources[member.path]) as source:
            if not _copy(source, member, archive):
                raise DamagedError(f"{sources[member.path]}: changed while it was packed; run the same command again")
        archive.write(member.padding)
    archive.write(END)


def _read_member(archive: BinaryIO, member: Member, target: BinaryIO | None = None) -> bool:
    """Reads the next member of an archive, into `target` if there is one; True if it is the expected one."""
    return (
        archive.read(len(member.header)) == member.header
        and _copy(archive, member, target)
        and archive.read(len(member.padding)) == member.padding
    )


def _copy(source: BinaryIO, member: Member, target: BinaryIO | None) -> bool:
    """Copies the content of a member; True if it is the promised one."""
    digest, left = hashlib.sha256(), member.size
    while left and (chunk := source.read(min(left, CHUNK))):
        digest.update(chunk)
        left -= len(chunk)
        if target is not None:
            target.write(chunk)
    return digest.hexdigest() == member.sha256


def holds(path: Path, members: Sequence[Member]) -> bool:
    """True if an archive is made of these members, every byte of it."""
    with open_regular(path) as archive:
        return all(_read_member(archive, member) for member in members) and archive.read(len(END) + 1) == END


# Unpacking


def read_index(
    archive: BinaryIO,
    path: Path,
    kind: type[Index],
    lay_out: Callable[[Index], tuple[bytes, list[Member]]],
    *,
    name: str,
    version: int,
    maker: str,
) -> tuple[Index, list[Member]]:
    """The index at the start of an archive, verified, and what the archive holds.

    Args:
        kind: the index's record.
        lay_out: the bytes that an index should have, and the archive's members.
        name: the index's file name.
        maker: the command that writes such archives.

    Raises:
        HyalineError: another kind of archive, or another version.
        DamagedError: the index is damaged, or the archive is not as long as its members.
    """
    start = archive.read(BLOCK)
    try:
        size = tarfile.TarInfo.frombuf(start, "utf-8", "strict").size
    except (tarfile.TarError, UnicodeDecodeError):
        size = -1
    if not 0 < size <= MAX_JSON_BYTES:
        raise HyalineError(f"{path}: is no archive of `{maker}`; expected one that begins with {name}")
    data = archive.read(size)
    content = parse_json(data, where=f"{path}: {name}")
    content.pop(SEAL, None)
    if content.get("version") != version:
        raise HyalineError(f"{path}: version is {shown(content.get('version'))}; expected {version}; update hyaline")
    try:
        index = from_json(kind, content, where=name)
    except HyalineError as error:
        raise HyalineError(f"{path}: {error}") from None
    expected, members = lay_out(index)
    if start + data != members[0].header + expected:
        raise DamagedError(f"{path}: {members[0].path} does not match its own checksum; get the archive again")
    found, length = os.fstat(archive.fileno()).st_size, sum(member.length for member in members) + len(END)
    if found != length:
        raise DamagedError(f"{path}: has {found:,} bytes; expected {length:,}; get the archive again")
    return index, members


def is_there(root: Path, member: Member) -> bool:
    """True if a file below `root` is the expected one."""
    try:
        return not (root / member.path).is_symlink() and sha256_file(root / member.path) == member.sha256
    except HyalineError:
        return False


def unpack_members(archive: BinaryIO, path: Path, members: Sequence[Member], root: Path) -> None:
    """Writes the files that are not there yet; all but the index."""
    archive.seek(members[0].length)
    for member in track(members[1:], label="unpack", total=len(members) - 1):
        target = root / member.path
        if is_there(root, member):
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
