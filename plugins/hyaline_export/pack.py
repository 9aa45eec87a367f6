"""A dataset as one file: a tar archive whose bytes depend on the dataset alone.

    SCENE/dataset.json     first: it names the files of scene and cameras, and counts the views
    SCENE/...              all other files of the dataset, sorted by path

Pictures and layers are compressed already; another compression of the archive would save 2 %.
"""

import io
import shutil
import tarfile
from pathlib import Path
from typing import BinaryIO, cast

from datagen.builder.verify import verify_dataset
from datagen.data.dataset import open_dataset
from datagen.data.paths import DATA_ROOT
from datagen.disk.errors import HyalineError, UsageError
from datagen.disk.ownership import DATASET, refuse_file
from datagen.disk.storage import MAKE_AGAIN, check_relative, open_regular, read_promised, real_path
from datagen.terminal.command import say, say_all, track
from hyaline_export.formats import EXPORTS, beside, new_folder, refuse_inside

HEAD = DATASET.head
"""The file that an archive begins with."""


def pack_dataset(root: Path, out: Path | None, *, overwrite: bool) -> Path:
    """Packs a finished dataset, after verifying every byte, into an archive; files that are not its own are left out.

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
    refuse_inside(out, root)
    refuse_file(out, overwrite=overwrite)
    say(f"{root}: verifying every byte")
    found = verify_dataset(root)
    if found.problems:
        raise HyalineError(f"{found.problems[0]}; {MAKE_AGAIN}")
    say_all(found.remarks)
    paths = sorted(found.files, key=lambda path: (path != HEAD, path))
    with (
        beside(out) as temporary,
        temporary.open("xb") as file,
        tarfile.open(fileobj=file, mode="w:", format=tarfile.PAX_FORMAT) as archive,
    ):
        for path in track(paths, label="pack", total=len(paths)):
            data = read_promised(root, path, found.files[path])
            entry = tarfile.TarInfo(f"{dataset.config.scene}/{path}")  # Without owner and time.
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    say(f"{out}: {len(paths):,} files, {out.stat().st_size / 1e6:,.1f} MB; licence: {dataset.license}")
    return out


def unpack_archive(path: Path, into: Path | None) -> Path:
    """Unpacks a dataset, and returns its folder, which appears when all of it is there and verifies.

    Args:
        into: the dataset's folder; None: the archive's name without its ending, in `data`.

    Raises:
        HyalineError: the archive is damaged or was not made by `pack_dataset`, or the folder holds something else.
    """
    into = into or DATA_ROOT / path.stem
    with open_regular(path) as file, new_folder(into) as folder:
        count = _extract(path, file, folder)
        try:
            found = verify_dataset(folder)
            problems = found.problems or (found.remarks if len(found.files) < count else [])
        except HyalineError as error:
            problems = [str(error)]
        if problems:
            reason = problems[0].replace(f"{folder}/", "").removeprefix(f"{folder}: ").split("; ")[0]
            raise HyalineError(f"{path}: holds no finished dataset ({reason}); get the archive again")
    say(f"{into}: {count:,} files; licence: {open_dataset(into).license}")
    return into


def _extract(path: Path, file: BinaryIO, folder: Path) -> int:
    """Writes the plain files of an archive into an empty folder; returns their number."""
    count = 0
    try:
        with tarfile.open(fileobj=file, mode="r:") as archive:
            for count, entry in enumerate(archive, start=1):
                relative = entry.name.partition("/")[2]
                is_plain = entry.type in (tarfile.REGTYPE, tarfile.AREGTYPE) and not entry.issparse() and entry.size > 0
                if not is_plain or (count == 1 and relative != HEAD):
                    raise HyalineError(
                        f"{path}: holds {entry.name!r}; expected plain files, {HEAD} first, as `datagen pack` writes it"
                    )
                check_relative(relative, where=str(path))
                (folder / relative).parent.mkdir(parents=True, exist_ok=True)
                content = cast(BinaryIO, archive.extractfile(entry))  # tarfile's own filters came with Python 3.11.4.
                with content, (folder / relative).open("xb") as target:
                    shutil.copyfileobj(content, target)
    except (tarfile.TarError, ValueError, OverflowError, MemoryError, FileExistsError, NotADirectoryError) as error:
        raise HyalineError(f"{path}: is damaged, or no tar archive ({error}); get the archive again") from None
    return count
