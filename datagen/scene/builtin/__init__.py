"""The built-in scenes: made by code, one file each, with the same bytes every time."""

import contextlib
import dataclasses
import importlib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numpy as np

from datagen.data.dataset import open_dataset
from datagen.data.meshes import Mesh, is_there
from datagen.data.metadata import OWN_LICENSE
from datagen.data.paths import BUILT_IN_SCENES
from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit, private_cache, sha256
from datagen.machine.processes import ROOT
from datagen.scene.atlas import unwrap_all
from datagen.scene.description import Scene
from datagen.scene.folder import open_scene, scene_files
from datagen.scene.soundness import check_scene
from datagen.terminal.command import choose, say


def _maker(name: str) -> Callable[[], Scene]:
    def make() -> Scene:
        return importlib.import_module(f"datagen.scene.builtin.{name}").make()

    return make


SCENES = {name: _maker(name) for name in BUILT_IN_SCENES}
"""Makers of the scenes, whose objects have no uv yet; each file is imported when its scene is made."""


def make_scene(name: str) -> Scene:
    """A built-in scene, unwrapped and checked."""
    make = SCENES[choose("scene", name, SCENES)]
    say(f"scene {name}: modelling it and unwrapping its surfaces")
    scene = make()
    meshes = unwrap_all({item.name: item.mesh for item in scene.objects})
    objects = tuple(dataclasses.replace(item, mesh=meshes[item.name]) for item in scene.objects)
    scene = dataclasses.replace(scene, objects=objects, license=OWN_LICENSE)
    check_scene(scene)
    return scene


def find_builtin(name: str, *, built: Path | None = None) -> Scene:
    """A built-in scene: taken from a dataset that contains it, else made.

    Args:
        built: a dataset that may contain the same scene, unwrapped.
    """
    choose("scene", name, SCENES)
    return (None if built is None else _same_scene(name, built)) or make_scene(name)


def _same_scene(name: str, root: Path) -> Scene | None:
    """A built-in scene as a dataset contains it, which saves unwrapping it; None if that is another scene.

    The dataset's copy is used if all its checksums match, and if it equals the scene made today except for uv.
    """
    try:
        dataset = open_dataset(root)
        stored = open_scene(dataset)
    except HyalineError:
        return None
    files = {path: promised for path, promised in dataset.files.items() if path.startswith("scene/")}
    if not _was_compared(name, files):
        scene = SCENES[name]()
        objects = tuple(
            dataclasses.replace(item, mesh=there.mesh)
            for item, there in zip(scene.objects, stored.objects)
            if is_there(there.mesh) and _same_surface(item.mesh, there.mesh)
        )
        same = dataclasses.replace(scene, objects=objects, license=stored.license)
        if files != {f"scene/{path}": sha256(data) for path, data in scene_files(same).items()}:
            return None
        _keep_compared(name, files)
    return dataclasses.replace(stored, folder=None, license=OWN_LICENSE)


def _same_surface(mesh: Mesh, unwrapped: Mesh) -> bool:
    """True if unwrapping added only uv and seams: the faces have the same corners and normals."""
    return len(mesh.faces) == len(unwrapped.faces) and all(
        np.array_equal(values[mesh.faces], others[unwrapped.faces])
        for values, others in ((mesh.vertices, unwrapped.vertices), (mesh.normals, unwrapped.normals))
    )


# Modelling a scene only to compare it takes a second, so the user's cache keeps which comparisons succeeded.


def _was_compared(name: str, files: dict[str, str]) -> bool:
    """True if these files were found to be the scene that today's code and libraries make."""
    cache = private_cache("scenes")
    return cache is not None and (cache / _key(name, files)).is_file()


def _keep_compared(name: str, files: dict[str, str]) -> None:
    if (cache := private_cache("scenes")) is not None:
        with contextlib.suppress(OSError):  # A full disk: the next command compares again.
            commit(cache / _key(name, files), name.encode())


def _key(name: str, files: dict[str, str]) -> str:
    code = [path.read_bytes() for path in sorted(ROOT.glob("datagen/**/*.py"))]
    versions = [metadata.version(package) for package in ("numpy", "scipy", "trimesh")]
    return sha256(repr((name, sorted(files.items()), versions)).encode() + b"".join(code))
