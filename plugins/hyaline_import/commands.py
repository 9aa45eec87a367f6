"""The commands `datagen import` and `datagen import-dataset`."""

import shlex
from pathlib import Path

from datagen.data.paths import DATA_ROOT
from datagen.scene.finding import ImportChoices
from datagen.terminal.command import next_command, say, say_all, tell
from hyaline_import.datasets.choices import DatasetImportChoices

SCENES_ROOT = Path("scenes")
"""Default folder for imported scenes."""


def import_file(
    file: Path,
    /,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    resolution: str = "128",
    choices: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Import a file from another program as a scene: glTF, GLB, OBJ with MTL, PLY, STL or Mitsuba XML.

    Writes a scene folder for `datagen build`. Its import.json lists everything that is rendered differently from what
    the file asks for. The file is read in a separate process, limited to 8 s of CPU time and 2 GB of memory, and for
    large files to 30 s and 24 MB per MB.

    Args:
        file: A file that ends in .glb, .gltf, .obj, .ply, .stl or .xml.
        out: Folder to write. Default: scenes/NAME.
        overwrite: Replace an existing imported scene.
        resolution: Image size in pixels that the ground's pattern is made for: one number (square), or WIDTHxHEIGHT.
    """
    from datagen.data.config import parse_resolution
    from hyaline_import.confined_import import check_free, imported_scene, write_imported
    from hyaline_import.foreign_files import scene_name

    root = out or SCENES_ROOT / scene_name(file)
    check_free(root, overwrite=overwrite)
    scene, told, record = imported_scene(file, choices, resolution=parse_resolution(resolution))
    write_imported(scene, record, root, overwrite=overwrite)
    say_all(told)
    tell(str(root))
    next_command(shlex.join(["datagen", "build", str(root)]))


def import_dataset(
    folder: Path,
    /,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    choices: DatasetImportChoices = DatasetImportChoices(),  # noqa: B008
) -> None:
    """Import another project's dataset: RefRef, OpenMaterial, NeRF's Blender scenes, or nerfstudio's transforms.json.

    Takes pictures, cameras, masks and meshes. With meshes, the dataset can be peeled and trained on. Noise and
    other data of a renderer stay unknown. If interrupted, the same command resumes.

    Args:
        folder: A folder with transforms_train.json or transforms.json.
        out: Folder to write. Default: data/NAME.
        overwrite: Replace an existing dataset.
    """
    from hyaline_import.datasets.import_dataset import plan_import, write_import

    plan = plan_import(folder, choices)
    dataset = write_import(plan, out or DATA_ROOT / plan.config.scene, overwrite=overwrite)
    say_all(list(plan.imported.remarks))
    views = ", ".join(f"{count} {split}" for split, count in dataset.num_views.items())
    say(f"{dataset.root}: {views} views; {len(dataset.objects)} meshes; noise and radiance are unknown")
    tell(str(dataset.root))
    next_command(shlex.join(["datagen", "look", str(dataset.root)]))
