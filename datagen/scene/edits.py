"""Edits of a scene whose renderer is already trained: how they are written, and what they do.

Objects keep their ids, names and atlases, so that trained textures stay valid. A removed object leaves its id unused. A
copy is a new object after all others, with an id of its own: it moves, hides and refracts independently, and renderers
look up the textures of its original (`EditedScene.copies`). A second instance with the same id would not do: a texel
would have two positions, and layers could not distinguish them.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import Mesh, is_there, no_mesh
from datagen.disk.errors import HyalineError
from datagen.scene.description import Scene, SceneObject
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
    edited = EditedScene(scene=scene, copies={}, offsets={})
    for edit in edits:
        there = [item.name for item in edited.scene.objects if is_there(item.mesh)]
        for name in edit.objects:
            choose(f"edit {describe_edit(edit)!r}: object", name, there)
        edited = _edited(edited, edit)
        try:
            check_scene(edited.scene)
        except HyalineError as error:
            raise HyalineError(f"edit {describe_edit(edit)!r}: {error}") from error
    return edited


def _edited(edited: EditedScene, edit: Edit) -> EditedScene:
    """The scene after one edit, unchecked."""
    items, offset = [_find(edited, name) for name in edit.objects], np.array(edit.offset or (0.0, 0.0, 0.0))
    match edit.verb:
        case "remove":
            return _with_object(edited, dataclasses.replace(items[0], mesh=no_mesh()))
        case "move":
            return _moved(edited, items[0].name, offset)
        case "duplicate":
            return _duplicated(edited, items[0], offset)
        case "glass":
            material = GREY if items[0].material.is_glass else CLEAR_GLASS
            return _with_object(edited, dataclasses.replace(items[0], material=material))
        case "swap":  # Each moves so that the centre of its base is where the other's was.
            offset = _foot(items[1].mesh) - _foot(items[0].mesh)
            return _moved(_moved(edited, items[0].name, offset), items[1].name, -offset)
        case "no-glass" | "opaque-glass":  # A depth sensor could measure glass that is painted matt grey.
            glass = [item for item in edited.scene.objects if is_there(item.mesh) and item.material.is_glass]
            if not glass:
                raise HyalineError(
                    f"edit {describe_edit(edit)!r}: the scene has no glass; expected some, or another edit"
                )
            for item in glass:
                gone = dataclasses.replace(item, mesh=no_mesh())
                painted = dataclasses.replace(item, material=GREY)
                edited = _with_object(edited, gone if edit.verb == "no-glass" else painted)
            return edited


def _duplicated(edited: EditedScene, original: SceneObject, offset: Float[np.ndarray, "3"]) -> EditedScene:
    first = edited.copies.get(original.name, original.name)
    names = {item.name for item in edited.scene.objects}
    name = next(name for count in range(1, 256) if (name := f"{first}_copy{count}") not in names)
    with_copy = EditedScene(
        scene=dataclasses.replace(
            edited.scene, objects=(*edited.scene.objects, dataclasses.replace(original, name=name))
        ),
        copies={**edited.copies, name: first},
        offsets={**edited.offsets, name: edited.offsets.get(original.name, (0.0, 0.0, 0.0))},
    )
    return _moved(with_copy, name, offset)


def _find(edited: EditedScene, name: str) -> SceneObject:
    return next(item for item in edited.scene.objects if item.name == name)


def _with_object(edited: EditedScene, changed: SceneObject) -> EditedScene:
    objects = tuple(changed if item.name == changed.name else item for item in edited.scene.objects)
    return dataclasses.replace(edited, scene=dataclasses.replace(edited.scene, objects=objects))


def _moved(edited: EditedScene, name: str, offset: Float[np.ndarray, "3"]) -> EditedScene:
    item = _find(edited, name)
    material = item.material.moved(as_vector(offset))
    moved = _with_object(edited, dataclasses.replace(item, mesh=moved_mesh(item.mesh, offset), material=material))
    before = edited.offsets.get(name, (0.0, 0.0, 0.0))
    return dataclasses.replace(moved, offsets={**edited.offsets, name: as_vector(before + offset)})


def moved_mesh(mesh: Mesh, offset: Vector | Float[np.ndarray, "3"]) -> Mesh:
    """The mesh, moved by an offset in metres."""
    return dataclasses.replace(mesh, vertices=(mesh.vertices.astype(np.float64) + offset).astype(np.float32))


def _foot(mesh: Mesh) -> np.ndarray:
    """Centre of the bottom of the bounding box."""
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    return np.array([*(low + high)[:2] / 2, low[2]])
