"""Files of other programs as a source of scenes: readers, and the choices for an import (`--material 'leg*=gold'`)."""

import fnmatch
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import file_name
from datagen.machine.processes import confined
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Material, Plastic, ThinDielectric
from datagen.terminal.command import choose
from datagen.terminal.plugins import Group
from hyaline_import.foreign import ForeignScene, check_surfaces, joined
from hyaline_import.remarks import Remarks

READERS: Group[Callable] = Group(
    name="hyaline.scene_readers",
    what="ending",
    built_in={
        "glb": "hyaline_import.gltf.scene:read_gltf",
        "gltf": "hyaline_import.gltf.scene:read_gltf",
        "obj": "hyaline_import.plain:read_obj",
        "ply": "hyaline_import.plain:read_ply_file",
        "stl": "hyaline_import.plain:read_stl",
        "xml": "hyaline_import.mitsuba.scene:read_mitsuba",
    },
    guide="docs/extending.md",
)
"""Functions (Path, Remarks) -> ForeignScene by the ending of a file (plugins/hyaline_import/foreign.py)."""

MAX_NAMED = 20
"""Objects that an error lists."""

NAMED: dict[str, Material] = {
    "glass": Dielectric(ior=1.5),
    "green-glass": Dielectric(ior=1.52, absorption=(40.0, 8.0, 25.0)),
    "blue-glass": Dielectric(ior=1.52, absorption=(45.0, 20.0, 5.0)),
    "amber": Dielectric(ior=1.54, absorption=(3.0, 25.0, 90.0)),
    "water": Dielectric(ior=1.333),
    "diamond": Dielectric(ior=2.417),
    "thin-glass": ThinDielectric(ior=1.5),
    "plaster": Diffuse(color=(0.75, 0.74, 0.72)),
    "plastic": Plastic(color=(0.55, 0.09, 0.07), roughness=0.1),
    "mirror": Conductor(color=(0.95, 0.95, 0.95), roughness=0.0),
    # Reflectance at normal incidence, as most renderers list it.
    "gold": Conductor(color=(1.0, 0.78, 0.34), roughness=0.15),
    "copper": Conductor(color=(0.96, 0.64, 0.54), roughness=0.15),
}


def ending_of(path: Path) -> str:
    """The ending of a file in small letters, without its dot."""
    return path.suffix.lower().removeprefix(".")


def check_ending(path: Path) -> None:
    """Refuses a file that no reader reads."""
    if ending_of(path) not in READERS.names():
        known = ", ".join(f".{name}" for name in READERS.names())
        raise HyalineError(
            f"{path}: ends in {shown(path.suffix)}, and {known} can be imported; open it in Blender, or in what it was "
            "made with, and export it as glTF 2.0 (.glb)"
        )


def scene_name(path: Path) -> str:
    """The name of the scene that is made of a file."""
    name = re.sub(r"[^A-Za-z0-9_+,-]", "_", file_name(path.stem))[:60]
    return name if re.match(r"[A-Za-z0-9_]", name) else f"_{name}"


def chosen_materials(given: tuple[str, ...], names: list[str]) -> dict[str, Material]:
    """Materials by the names of objects, from NAME or PATTERN=NAME; later ones win.

    Raises:
        HyalineError: a pattern matches no object, or no material has this name.
    """
    found: dict[str, Material] = {}
    for text in given:
        pattern, is_for_some, name = text.rpartition("=")
        if is_for_some and not pattern:
            raise HyalineError(f"--material: is {shown(text)}; expected NAME, or OBJECT=NAME")
        material = NAMED[choose("material", name, NAMED)]
        matching = fnmatch.filter(names, pattern) if is_for_some else names
        if not matching:
            choose("--material: object", pattern, names[:MAX_NAMED])
        found |= dict.fromkeys(matching, material)
    return found


def read_scene(path: Path, remarks: Remarks) -> ForeignScene:
    """The content of a file by the reader of its ending, not empty and not too large."""
    check_ending(path)
    scene: ForeignScene = READERS.find(ending_of(path))(path, remarks)
    check_surfaces(scene.objects, where=path.name)
    return scene


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices, faces and uv, if any, of all objects of a file as one mesh."""
    with confined(write_arrays, path.absolute(), where=str(path)) as folder, np.load(folder / "mesh.npz") as found:
        return found["vertices"], found["faces"], found.get("uv")


def write_arrays(folder: Path, path: Path) -> None:
    """Reads all objects of a file as one mesh, in the process that `confined` starts."""
    whole = joined(read_scene(path, Remarks()).objects)
    arrays = {"vertices": whole.positions, "faces": whole.faces}
    np.savez(folder / "mesh.npz", allow_pickle=False, **arrays, **({} if whole.uv is None else {"uv": whole.uv}))
