"""Where the meshes of a glTF file are: its tree of nodes, and the instances that they make.

Source: glTF 2.0 sections 3.5 and 3.10, EXT_mesh_gpu_instancing, KHR_lights_punctual.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import MAX_SKEW, Camera
from datagen.disk.errors import HyalineError
from datagen.scene.remarks import Remarks
from hyaline_import.fields import Fields
from hyaline_import.foreign import MAX_SURFACES, ForeignLamp, lens_of, rotation_of
from hyaline_import.gltf.file import GltfArrays, GltfFile

LAMPS = "KHR_lights_punctual"
MAX_NODES = 20_000
MAX_COORDINATE = 1e18
MIN_SCALE = 1e-10
"""Scale below which there is nothing to see."""
FILM = 1000.0
"""Height in pixels that describes a camera's pictures: glTF has none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Instance:
    """A mesh at one place."""

    node: Fields
    mesh: int
    world_from_mesh: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """The cameras and lamps in a scene."""

    cameras: list[Camera] = field(default_factory=list)
    lamps: list[ForeignLamp] = field(default_factory=list)


def instances(arrays: GltfArrays, standing: Standing, remarks: Remarks) -> Iterator[Instance]:
    """Every mesh of the file's scene, once for each place where it is; parents come before children.

    Args:
        standing: takes cameras and lamps.
    """
    file = arrays.file
    nodes = file.lists["nodes"]
    if len(nodes) > MAX_NODES:
        raise HyalineError(f"{file.path}: has {len(nodes):,} nodes; expected at most {MAX_NODES:,}")
    waiting = [(index, np.eye(4)) for index in reversed(_roots(arrays))]
    seen: set[int] = set()
    count = 0
    while waiting:
        index, world_from_parent = waiting.pop()
        node = nodes[index]
        if index in seen:
            raise HyalineError(f"{node.where}: is part of a cycle or has two parents; export the file again")
        seen.add(index)
        world_from_node = world_from_parent @ _local(node)
        if not np.abs(world_from_node).max() < MAX_COORDINATE:
            raise HyalineError(f"{node.where}: is larger than can be; export the file again")
        if "mesh" in node:
            if "skin" in node:
                remarks.approximate(_name(node), "is moved by bones, which are not read; drawn in its rest pose")
            for world_from_mesh in _copies(arrays, node, world_from_node):
                if _is_hidden(world_from_mesh):
                    remarks.note(_name(node), "is scaled to nothing, which hides it; left out")
                    continue
                count += 1
                if count > MAX_SURFACES:
                    raise HyalineError(f"{file.path}: places more than {MAX_SURFACES:,} meshes; expected fewer")
                mesh = node.integer("mesh", high=len(file.lists["meshes"]) - 1)
                yield Instance(node=node, mesh=mesh, world_from_mesh=world_from_mesh)
        if "camera" in node:
            camera = file.item("cameras", node.integer("camera"), where=node.where)
            standing.cameras.extend(_camera(camera, world_from_node, remarks))
        if (lamp := node.extension(LAMPS)) is not None:
            standing.lamps.append(_lamp(file, lamp, _name(node), world_from_node))
        children = node.indices("children", count=len(nodes))
        waiting += [(child, world_from_node) for child in reversed(children)]


def _is_hidden(world: Float[np.ndarray, "4 4"]) -> bool:
    """True if a mesh is scaled to 0 along two axes or more. Source: glTF 2.0 section 3.5.3."""
    return bool(np.linalg.svd(world[:3, :3], compute_uv=False)[1] < MIN_SCALE)


def _name(node: Fields) -> str:
    return node.text("name") or node.where.rsplit(".", 1)[-1]


def _lamp(file: GltfFile, lamp: Fields, name: str, world: Float[np.ndarray, "4 4"]) -> ForeignLamp:
    """A lamp in the world; it shines along its -z."""
    listed = file.root.extension(LAMPS)
    lights = [] if listed is None else listed.listed("lights")
    index = lamp.integer("light")
    if index >= len(lights):
        raise HyalineError(f"{lamp.where}: names lights[{index}]; the file has {len(lights)}")
    light = lights[index]
    kinds: dict[str, Literal["directional", "point", "spot"]] = {
        "directional": "directional", "point": "point", "spot": "spot"
    }  # fmt: skip
    if (kind := light.text("type")) not in kinds:
        raise HyalineError(f"{light.where}.type: is {kind[:40]!r}; expected one of {', '.join(kinds)}")
    strength, cone = light.number("intensity", 1.0), 2 * math.pi
    if kind == "spot":
        cone = light.fields("spot").number("outerConeAngle", math.pi / 4)
    if not 0 <= strength < 1e12 or cone <= 0:
        raise HyalineError(f"{light.where}: has an intensity of {strength:g} and a cone of {cone:g}; expected above 0")
    red, green, blue = (strength * c for c in light.color("color", (1.0, 1.0, 1.0)))
    ahead = -world[:3, 2]
    return ForeignLamp(
        name=name,
        kind=kinds[kind],
        position=world[:3, 3],
        direction=ahead / max(float(np.linalg.norm(ahead)), 1e-30),
        intensity=(red, green, blue),
        cone=cone,
    )


def _camera(camera: Fields, world: Float[np.ndarray, "4 4"], remarks: Remarks) -> list[Camera]:
    """A camera in the world; none if it is orthographic. glTF's cameras are OpenGL's."""
    if camera.text("type", "perspective") != "perspective":
        remarks.approximate(_name(camera), "is an orthographic camera, which is left out")
        return []
    lens = camera.fields("perspective")
    high, aspect = lens.number("yfov", 0.0), lens.number("aspectRatio", 1.0)
    if not (0 < high < math.pi and 0 < aspect < 1e3):
        raise HyalineError(f"{lens.where}: sees {high:g} radians at an aspect of {aspect:g}; expected 0 to pi, above 0")
    lengths = np.maximum(np.linalg.norm(world[:3, :3], axis=0), MIN_SCALE)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = world[:3, :3] / lengths, world[:3, 3]
    axes = matrix[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > MAX_SKEW or np.linalg.det(axes) < 0:
        remarks.approximate(_name(camera), "is a camera that its node skews, mirrors or flattens, which is left out")
        return []
    width, height = aspect * FILM, FILM
    found = lens_of(0.5 * height / math.tan(high / 2), width, height, where=camera.where)
    return [found.camera(matrix)]


def _roots(arrays: GltfArrays) -> list[int]:
    """The top nodes of the file's scene; in a file without scenes, those without a parent."""
    file = arrays.file
    nodes = file.lists["nodes"]
    if file.lists["scenes"]:
        scene = file.item("scenes", file.root.integer("scene", 0), where=file.root.where)
        return scene.indices("nodes", count=len(nodes))
    below = {child for node in nodes for child in node.indices("children", count=len(nodes))}
    return [index for index in range(len(nodes)) if index not in below]


def _local(node: Fields) -> Float[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node.numbers("matrix", (0.0,) * 16)).reshape(4, 4).T
    if not any(key in node for key in ("rotation", "translation", "scale")):
        return np.eye(4)
    rotation = np.array([node.numbers("rotation", (0.0, 0.0, 0.0, 1.0))])
    translation = np.array([node.numbers("translation", (0.0, 0.0, 0.0))])
    scale = np.array([node.numbers("scale", (1.0, 1.0, 1.0))])
    return _matrices(translation, rotation, scale, where=node.where)[0]


def _matrices(
    translation: Float[np.ndarray, "n 3"],
    rotation: Float[np.ndarray, "n 4"],
    scale: Float[np.ndarray, "n 3"],
    *,
    where: str,
) -> Float[np.ndarray, "n 4 4"]:
    """Scale, then turn by a quaternion (x, y, z, w), then move."""
    length = np.linalg.norm(rotation, axis=-1, keepdims=True)
    if (length < 1e-9).any():
        raise HyalineError(f"{where}: has a rotation of length 0; export the file again")
    matrices = np.tile(np.eye(4), (len(translation), 1, 1))
    matrices[:, :3, :3] = rotation_of(rotation / length) * scale[:, None, :]
    matrices[:, :3, 3] = translation
    return matrices


def _copies(arrays: GltfArrays, node: Fields, world_from_node: Float[np.ndarray, "4 4"]) -> list[np.ndarray]:
    """One place, or those of EXT_mesh_gpu_instancing."""
    instancing = node.extension("EXT_mesh_gpu_instancing")
    if instancing is None:
        return [world_from_node]
    attributes = instancing.fields("attributes")
    given = {name: attributes.integer(name) for name in ("TRANSLATION", "ROTATION", "SCALE") if name in attributes}
    counts = {arrays.count(index, where=attributes.where) for index in given.values()}
    if len(counts) != 1 or max(counts) > MAX_SURFACES:
        raise HyalineError(
            f"{attributes.where}: places {sorted(counts)} instances; expected one number up to {MAX_SURFACES}"
        )
    count = counts.pop()
    values = {
        name: arrays.array(index, "VEC4" if name == "ROTATION" else "VEC3", where=attributes.where)
        for name, index in given.items()
    }
    placed = _matrices(
        values.get("TRANSLATION", np.zeros((count, 3))),
        values.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))),
        values.get("SCALE", np.ones((count, 3))),
        where=attributes.where,
    )
    return [world_from_node @ local for local in placed]
