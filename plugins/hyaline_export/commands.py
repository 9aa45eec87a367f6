"""The command `datagen export`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from datagen.data.paths import find_dataset
from datagen.terminal.command import next_command, tell
from datagen.terminal.plugins import Group

if TYPE_CHECKING:
    from hyaline_export.formats import Format

FORMATS: "Group[Format]" = Group(
    name="hyaline.exports",
    what="format",
    built_in={
        "nerfstudio": "hyaline_export.transforms:NERFSTUDIO",
        "blender": "hyaline_export.transforms:BLENDER",
        "3dgs": "hyaline_export.transforms:GAUSSIAN_SPLATTING",
        "colmap": "hyaline_export.colmap:COLMAP",
        "bop": "hyaline_export.bop:BOP",
        "bop-sensor": "hyaline_export.bop:BOP_SENSOR",
        "capture": "hyaline_export.transforms:CAPTURE",
        "huggingface": "hyaline_export.huggingface:HUGGING_FACE",
    },
    guide="docs/extending.md",
    kind="hyaline_export.formats:Format",
)


def export(
    dataset: str | None = None,
    /,
    *,
    format: Annotated[str, FORMATS.names] = "nerfstudio",  # noqa: A002
    out: Path | None = None,
    points: int = 20000,
) -> None:
    """Export a dataset in another tool's format, into a new folder.

    Args:
        format: The tool whose loader reads it.
        out: Folder to write, new or empty. Default: exports/NAME-FORMAT.
        points: Number of points, for formats with a point cloud: on the true surfaces, coloured from training images.
    """
    from datagen.data.dataset import open_dataset
    from hyaline_export.formats import export_dataset

    opened = open_dataset(find_dataset(dataset))
    where, hint = export_dataset(opened, format, out, num_points=points)
    tell(str(where))
    next_command(hint)
