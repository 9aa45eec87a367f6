"""The commands `datagen import` and `datagen import-dataset`, and files as scenes (`datagen build vase.glb`)."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from datagen.data.paths import DATA_ROOT
from datagen.disk.errors import HyalineError
from datagen.scene.finding import DEFAULT_RESOLUTION, ImportChoices, SceneSource
from datagen.terminal.command import next_command, say, tell

if TYPE_CHECKING:
    import numpy as np

    from datagen.data.config import Resolution
    from datagen.scene.description import Scene


@dataclass(frozen=True, kw_only=True)
class DatasetImportChoices:
    """The flags of `datagen import-dataset`."""

    mesh: tuple[Path, ...] = ()
    """A mesh in the cameras' axes and units (PLY, OBJ, STL, GLB, ...). May be repeated; without one, no layers."""
    material: tuple[str, ...] = ()
    """A material by name for all meshes, or for those that match a pattern: 'foot*=gold', as `datagen import` takes
    them. Default: the material in the file, or else glass of the index --ior."""
    ior: float = 1.5
    """Index of refraction of glass."""
    scale: float = 1.0
    """Metres per unit of the cameras and the meshes."""
    up: Literal["x", "y", "z"] = "z"
    """The axis of the cameras' world that points up."""
    background: Literal["white", "black"] = "white"
    """Background for images with transparency."""

    def __post_init__(self) -> None:
        if not 1 < self.ior < 10:
            raise HyalineError(f"--ior: is {self.ior:g}; expected more than 1, and less than 10")
        if not 1e-9 < self.scale < 1e9:
            raise HyalineError(f"--scale: is {self.scale:g}; expected metres per unit, such as 0.001 for millimetres")


def import_file(
    file: Path,
    /,
    *,
    out: Path | None = None,
    choices: ImportChoices = ImportChoices(),  # noqa: B008
) -> None:
    """Import a file from another program as a scene: glTF, GLB, OBJ with MTL, PLY, STL or Mitsuba XML.

    Writes a scene folder for `datagen build`. Its import.json lists everything that is rendered differently from what
    the file asks for. It is read in a process of its own, within 8 s of CPU time and 2 GB (large: 30 s, 24 MB per MB).

    Args:
        file: A file that ends in .glb, .gltf, .obj, .ply, .stl or .xml.
        out: Folder to write, new or empty. Default: scenes/NAME.
    """
    from hyaline_import.confined_import import check_free, imported_scene, write_imported
    from hyaline_import.source import scene_name

    root = out or Path("scenes") / scene_name(file)
    check_free(root)
    scene, told, record = imported_scene(file, choices, resolution=DEFAULT_RESOLUTION)
    write_imported(scene, record, root)
    say(*told)
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
    say(*plan.imported.remarks)
    views = ", ".join(f"{count} {split}" for split, count in dataset.num_views.items())
    say(f"{dataset.root}: {views} views; {len(dataset.objects)} meshes; noise and radiance are unknown")
    tell(str(dataset.root))
    next_command(shlex.join(["datagen", "look", str(dataset.root)]))


def _find(given: str, resolution: "Resolution", imports: ImportChoices) -> "Scene":
    from hyaline_import.confined_import import imported_scene
    from hyaline_import.source import check_ending

    check_ending(Path(given))
    say(f"scene {given}: importing it")
    scene, told, _ = imported_scene(Path(given), imports, resolution=resolution)
    say(*told)
    return scene


def _read_mesh(path: Path) -> "tuple[np.ndarray, np.ndarray, np.ndarray | None]":
    from hyaline_import.source import read_mesh

    return read_mesh(path)


FILES = SceneSource(
    has=lambda given: Path(given).suffix.lower() not in ("", ".json") and not Path(given).is_dir(),
    find=_find,
    is_of_files=True,
    read_mesh=_read_mesh,
)
