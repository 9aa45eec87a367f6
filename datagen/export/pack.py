"""A dataset as one file: a tar archive with an index of its files, whose bytes depend on the dataset alone.

    SCENE/hyaline-pack.json    sealed: version, scene, seal of the dataset, licence, size and SHA-256 of every file
    SCENE/...                  the dataset's files, sorted by path
    SCENE/dataset.json         last: a folder without it is not a dataset

`unpack_archive` accepts only the bytes that `pack_dataset` writes (datagen/export/archive.py). Pictures and layers are
compressed already; another compression of the archive would save 2 %.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from datagen.build.verify import Findings, verify_dataset
from datagen.data.dataset import open_dataset
from datagen.data.metadata import unknown_license
from datagen.data.paths import DATA_ROOT
from datagen.disk.errors import HyalineError, UsageError, naming
from datagen.disk.names import check_name, real_path
from datagen.disk.ownership import DATASET, refuse_file
from datagen.disk.records import MAX_JSON_BYTES, Json, open_regular, to_json
from datagen.disk.storage import one_writer, seal_bytes, sync_folder
from datagen.export.archive import (
    Member,
    PackedFile,
    check_packed,
    holds,
    is_there,
    list_members,
    packed_json,
    read_index,
    unpack_members,
    write_archive,
)
from datagen.export.formats import EXPORTS
from datagen.terminal.command import say, say_all
from datagen.terminal.signals import replacing_at_the_end

INDEX = "hyaline-pack.json"
VERSION = 1


@dataclass(frozen=True, kw_only=True)
class _Index:
    """What an archive holds."""

    version: int
    scene: str
    """Name of the scene, and of the archive's one folder."""
    dataset: str
    """Seal of the dataset."""
    license: str
    files: dict[str, PackedFile]
    """By path relative to the dataset."""

    def __post_init__(self) -> None:
        check_name(self.scene, where="scene")
        check_packed(self.files)


def _members(index: _Index) -> tuple[bytes, list[Member]]:
    """The bytes of the index, and everything in the archive in its order."""
    data = seal_bytes(cast(dict[str, Json], to_json(index)) | {"files": packed_json(index.files)})
    return data, list_members(data, INDEX, index.scene, index.files, last=DATASET.head)


# Packing


@replacing_at_the_end()
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
    say(f"{root}: verifying every byte")
    found = verify_dataset(root)
    if found.problems:
        more = f" (and {len(found.problems) - 1} more problems: `datagen verify`)" if len(found.problems) > 1 else ""
        raise HyalineError(f"{found.problems[0]}{more}")
    say_all(found.remarks)
    files = {path: PackedFile(size=(root / path).stat().st_size, sha256=found.files[path]) for path in found.files}
    scene = dataset.config.scene
    terms = dataset.stated_license or unknown_license(f"dataset {scene}")  # The folder's name may change.
    data, members = _members(_Index(version=VERSION, scene=scene, dataset=dataset.seal, license=terms, files=files))
    if len(data) > MAX_JSON_BYTES:
        raise HyalineError(f"{root}: has {len(files):,} files, which are too many for an archive's index")
    if out.is_file() and not overwrite and holds(out, members):
        say(f"{out}: is finished")
        return out
    refuse_file(out, overwrite=overwrite)
    write_archive(out, data, members, {path: root / path for path in files})
    say(f"{out}: {len(files):,} files, {sum(member.length for member in members) / 1e6:,.1f} MB; licence: {terms}")
    return out


# Unpacking


def unpack_archive(path: Path, into: Path | None) -> Path:
    """Unpacks a dataset, and returns its folder, which appears when all of it is there and verifies.

    A killed call leaves its work beside the folder under a temporary name, and the next call continues it.

    Args:
        into: the dataset's folder; None: the archive's name without its ending, in `data`.

    Raises:
        HyalineError: the archive is damaged or was not made by `pack_dataset`, or the folder holds something else.
    """
    with open_regular(path) as archive:
        index, members = read_index(archive, path, _Index, _members, name=INDEX, version=VERSION, maker="datagen pack")
        into = into or DATA_ROOT / path.stem
        if os.path.lexists(into) and not (into.is_dir() and not any(into.iterdir())):
            other = next((member.path for member in members[1:] if not is_there(into, member)), None)
            if other is not None:
                raise HyalineError(f"{into}: is taken, and {other} is not that of {path}; choose another --out")
            say(f"{into}: holds this dataset already")
            return into
        place = real_path(into)
        temporary = place.with_name(f"{into.name}.{members[0].sha256[:16]}.hyaline-tmp")
        with one_writer(temporary), naming(place):
            try:
                unpack_members(archive, path, members, temporary)
                _check_unpacked(path, verify_dataset(temporary), len(index.files))
            except HyalineError:
                shutil.rmtree(temporary)
                raise
            temporary.rename(place)
            sync_folder(place.parent)
    say(f"{into}: {len(index.files):,} files; licence: {index.license}")
    return into


def _check_unpacked(path: Path, found: Findings, count: int) -> None:
    """Refuses files that are whole, but no dataset, or not all of them its own."""
    foreign = found.remarks[:1] if found.verified < count else []
    for line in (*found.problems, *foreign):
        raise HyalineError(f"{path}: holds no finished dataset ({line.split('; ')[0]})")
