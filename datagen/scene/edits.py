"""Edits of a scene whose renderer is already trained: how they are written, and what they do.

Objects keep their ids, names and atlases, so that trained textures stay valid. A removed object leaves its id unused. A
copy is a new object after all others, with an id of its own, and renderers look up the textures of its original.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import Mesh, is_there, no_mesh
from datagen.disk.errors import HyalineError
from datagen.scene.description import Scene
from datagen.scene.materials import Dielectric, Diffuse, Vector, as_vector
from datagen.scene.soundness import check_scene
from datagen.terminal.command import choose

Verb = Literal["remove", "move", "duplicate", "glass", "swap", "no-glass", "opaque-glass"]

USAGE: dict[Verb, str] = {
    "remove": "remove:OBJECT",
    "move": "move:OBJECT:dx,dy,dz",
    "duplicate": "duplicate:OBJECT:dx,dy,dz",
    "glass": "glass:OBJECT",
    "swap": "swap:OBJECT:OBJECT",
    "no-glass": "no-glass",
    "opaque-glass": "opaque-glass",
}

CLEAR_GLASS = Dielectric(ior=1.5)
"""The material that `glass` gives to an opaque object."""

GREY = Diffuse(color=(0.5, 0.5, 0.5))
"""The material that `glass` and `opaque-glass` give to a transparent object."""


@dataclass(frozen=True, kw_only=True)
class Edit:
    """One change of a scene."""

    verb: Verb
    objects: tuple[str, ...]
    """Object names: two for `swap`, none for edits of all glass, else one."""
    offset: Vector | None = None
    """Offset in metres, for `move` and `duplicate`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EditedScene:
    """A scene after some edits."""

    scene: Scene
    copies: dict[str, str]
    """Name of the original for each copy, by the copy's name."""
    offsets: dict[str, Vector]
    """Offset in metres of each object from where it, or its original, was; 0 for objects not listed."""

    def changed(self, before: Scene) -> tuple[str, ...]:
        """Names of all changed objects, in the order of their ids."""
        old = {item.name: item for item in before.objects}
        return tuple(item.name for item in self.scene.objects if item is not old.get(item.name))


def parse_edit(text: str) -> Edit:
    """The edit that `verb:object[:object or offset]` describes."""
    start, *rest = text.split(":")
    if start not in USAGE:
        raise HyalineError(f"edit {text!r}: unknown verb {start!r}; expected {', '.join(USAGE.values())}")
    verb = cast(Verb, start)
    usage = USAGE[verb]
    if len(rest) != usage.count(":") or not all(rest):
        raise HyalineError(f"edit {text!r}: has {len(rest)} parts after the verb; expected {usage}")
    if "dx" not in usage:
        return Edit(verb=verb, objects=tuple(rest))
    try:
        offset = tuple(float(number) for number in rest[1].split(","))
    except ValueError:
        offset = ()
    if len(offset) != 3 or not all(map(math.isfinite, offset)):
        raise HyalineError(f"edit {text!r}: moves by {rest[1]!r}; expected {usage}, three numbers in metres")
    return Edit(verb=verb, objects=(rest[0],), offset=cast(Vector, offset))


def describe_edit(edit: Edit) -> str:
    """The edit as `parse_edit` reads it, in canonical form."""
    offset = [",".join(f"{value:g}" for value in edit.offset)] if edit.offset else []
    return ":".join([edit.verb, *edit.objects, *offset])


def edits_name(edits: tuple[Edit, ...]) -> str:
    """The folder name for the scene after these edits, such as `remove-ball+move-mug-0.1,0,0`."""
    return "+".join(describe_edit(edit).replace(":", "-") for edit in edits)


def edit_scene(scene: Scene, edits: tuple[Edit, ...]) -> EditedScene:
    """The checked scene after all edits, applied in order."""
    objects = {item.name: item for item in scene.objects}
    copies: dict[str, str] = {}
    offsets: dict[str, Vector] = {}

    def move(name: str, offset: Float[np.ndarray, "3"]) -> None:
        item = objects[name]
        material = item.material.moved(as_vector(offset))
        objects[name] = dataclasses.replace(item, mesh=moved_mesh(item.mesh, offset), material=material)
        offsets[name] = as_vector(offsets.get(name, (0.0, 0.0, 0.0)) + offset)

    for edit in edits:
        where, offset = f"edit {describe_edit(edit)!r}", np.array(edit.offset or (0.0, 0.0, 0.0))
        there = [name for name, item in objects.items() if is_there(item.mesh)]
        for name in edit.objects:
            choose(f"{where}: object", name, there)
        match edit.verb, edit.objects:
            case "remove", (name,):
                objects[name] = dataclasses.replace(objects[name], mesh=no_mesh())
            case "move", (name,):
                move(name, offset)
            case "duplicate", (name,):
                first = copies.get(name, name)
                copy = next(free for count in range(1, 256) if (free := f"{first}_copy{count}") not in objects)
                objects[copy], copies[copy] = dataclasses.replace(objects[name], name=copy), first
                offsets[copy] = offsets.get(name, (0.0, 0.0, 0.0))
                move(copy, offset)
            case "glass", (name,):
                material = GREY if objects[name].material.is_glass else CLEAR_GLASS
                objects[name] = dataclasses.replace(objects[name], material=material)
            case "swap", (one, other):  # Each moves so that the centre of its base is where the other's was.
                offset = _foot(objects[other].mesh) - _foot(objects[one].mesh)
                move(one, offset)
                move(other, -offset)
            case _:  # All glass: a depth sensor could measure glass that is painted matt grey.
                glass = [name for name in there if objects[name].material.is_glass]
                if not glass:
                    raise HyalineError(f"{where}: the scene has no glass; expected some, or another edit")
                for name in glass:
                    gone = dataclasses.replace(objects[name], mesh=no_mesh())
                    painted = dataclasses.replace(objects[name], material=GREY)
                    objects[name] = gone if edit.verb == "no-glass" else painted
        scene = dataclasses.replace(scene, objects=tuple(objects.values()))
        try:
            check_scene(scene)
        except HyalineError as error:
            raise HyalineError(f"{where}: {error}") from error
    return EditedScene(scene=scene, copies=copies, offsets=offsets)


def moved_mesh(mesh: Mesh, offset: Vector | Float[np.ndarray, "3"]) -> Mesh:
    """The mesh, moved by an offset in metres."""
    return dataclasses.replace(mesh, vertices=(mesh.vertices.astype(np.float64) + offset).astype(np.float32))


def _foot(mesh: Mesh) -> np.ndarray:
    """Centre of the bottom of the bounding box."""
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    return np.array([*(low + high)[:2] / 2, low[2]])
