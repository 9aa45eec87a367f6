"""The commands `datagen export`, `pack` and `unpack`."""

import shlex
from pathlib import Path

from datagen.data.paths import find_dataset
from datagen.terminal.command import next_command, tell


def export(
    dataset: str | None = None,
    /,
    *,
    format: str = "nerfstudio",  # noqa: A002
    out: Path | None = None,
    points: int = 20000,
) -> None:
    """Export a dataset in another tool's format, into a new folder.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        format: nerfstudio, blender, 3dgs, colmap, capture or huggingface.
        out: Folder to write, new or empty. Default: exports/NAME-FORMAT.
        points: Number of points, for formats with a point cloud: on the true surfaces, coloured from training images.
    """
    from datagen.data.dataset import open_dataset
    from hyaline_export.formats import export_dataset

    opened = open_dataset(find_dataset(dataset))
    where, hint = export_dataset(opened, format, out, num_points=points)
    tell(str(where))
    next_command(hint)


def pack(dataset: str | None = None, /, *, out: Path | None = None, overwrite: bool = False) -> None:
    """Pack a finished dataset into one tar file, every byte verified.

    Args:
        dataset: A dataset's folder, or its name under data/. Default: the only one there.
        out: File to write, which ends in .tar. Default: exports/NAME.tar.
        overwrite: Replace an existing file.
    """
    from hyaline_export.pack import pack_dataset

    path = pack_dataset(find_dataset(dataset), out, overwrite=overwrite)
    tell(str(path))
    next_command(shlex.join(["datagen", "unpack", str(path)]))


def unpack(file: Path, /, *, out: Path | None = None) -> None:
    """Unpack a packed dataset into a new folder, every byte verified.

    Args:
        file: A file from `datagen pack`.
        out: Folder to write, new or empty. Default: data/NAME, for NAME.tar.
    """
    from hyaline_export.pack import unpack_archive

    root = unpack_archive(file, out)
    tell(str(root))
    next_command(shlex.join(["datagen", "look", str(root)]))
