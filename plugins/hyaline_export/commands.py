"""The command `datagen export`."""

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
        format: nerfstudio, blender, 3dgs, colmap, bop, bop-sensor, capture or huggingface.
        out: Folder to write, new or empty. Default: exports/NAME-FORMAT.
        points: Number of points, for formats with a point cloud: on the true surfaces, coloured from training images.
    """
    from datagen.data.dataset import open_dataset
    from hyaline_export.formats import export_dataset

    opened = open_dataset(find_dataset(dataset))
    where, hint = export_dataset(opened, format, out, num_points=points)
    tell(str(where))
    next_command(hint)
