"""Mitsuba 3 scenes: parsed, not loaded, and no plugin of theirs is ever made.

Loading one would run native code from plugin folders beside the file, and read any file that it names.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.scene.environment_maps import read_map
from datagen.scene.importers.foreign import (
    MAX_SURFACES,
    MAX_TRIANGLES,
    Axis,
    ForeignCamera,
    ForeignLight,
    ForeignMap,
    ForeignObject,
    ForeignScene,
    lens_of,
    read_foreign,
)
from datagen.scene.importers.mitsuba_materials import FoundMaterial, absorption_of, read_bsdf
from datagen.scene.importers.mitsuba_nodes import Node, NodeList
from datagen.scene.importers.mitsuba_shapes import read_shape
from datagen.scene.importers.obj import PLAIN
from datagen.scene.importers.remarks import Remarks
from datagen.scene.lights import MAP_ENDINGS
from datagen.scene.values import Color

QUIET = ("Integrator", "Sampler", "Film", "BSDF", "Texture", "Medium")
"""Top-level nodes that say nothing about the scene, or that shapes refer to."""


def read_mitsuba(path: Path, remarks: Remarks) -> ForeignScene:
    """The shapes, materials, lights and cameras of a scene file.

    Raises:
        HyalineError: it is no such file, names something outside of its folder, or holds what is not read.
    """
    nodes = NodeList(path)
    objects: list[ForeignObject] = []
    lights: list[ForeignLight] = []
    cameras: list[ForeignCamera] = []
    sky: Color | ForeignMap | None = None
    for node in nodes.root.children():
        if node.kind == "Shape":
            _add_shape(node, objects, lights, remarks)
        elif node.kind == "Sensor":
            cameras.append(_camera(node, remarks))
        elif node.kind == "Emitter" and node.plugin == "constant":
            sky = node.color("radiance", 1.0)
        elif node.kind == "Emitter" and node.plugin == "envmap":
            sky = _map(node)
        elif node.kind == "Emitter":
            remarks.approximate(node.name, f"is a light of kind {node.plugin}, which is left out")
        elif node.kind not in QUIET:
            remarks.approximate(node.name, f"is a {node.kind.lower()} of kind {node.plugin}, which is left out")
    if not objects:
        raise HyalineError(f"{path}: holds no shape that is seen; expected one")
    if sky is None and lights:
        sky = (0.0, 0.0, 0.0)
    return ForeignScene(
        objects=tuple(objects),
        up=_up(cameras),
        lights=tuple(lights),
        sky=sky,
        cameras=tuple(cameras),
        is_complete=True,
    )


def _add_shape(node: Node, objects: list[ForeignObject], lights: list[ForeignLight], remarks: Remarks) -> None:
    emitter = node.inner("Emitter")
    if emitter is not None and node.plugin == "rectangle" and emitter.plugin == "area":
        lights.append(_light(node, emitter))
        return
    if emitter is not None:
        remarks.approximate(node.name, "glows, which is left out: only rectangles shine")
    bsdf = node.inner("BSDF")
    found = FoundMaterial(material=PLAIN, image_from_uv=np.eye(4)) if bsdf is None else read_bsdf(bsdf, remarks)
    if bsdf is None:
        found = replace(found, material=replace(PLAIN, name=node.name, base_color=(0.5, 0.5, 0.5), roughness=1.0))
    interior = absorption_of(node.child("interior"))
    material = replace(found.material, absorption=interior)
    if max(interior) > 0 and material.transmission == 0:
        raise HyalineError(f"{node.where}: has a medium inside and no glass around it; expected a dielectric")
    for item in read_shape(node, remarks):
        uv = item.uv
        if uv is not None:
            # The transform of a texture is one of Mitsuba's uv, whose v points down.
            flat = np.stack([uv[:, 0], 1 - uv[:, 1], np.zeros(len(uv)), np.ones(len(uv))], axis=-1)
            flat = flat @ found.image_from_uv.T
            uv = np.stack([flat[:, 0], 1 - flat[:, 1]], axis=-1)
        objects.append(replace(item, uv=uv, material=material))
        if sum(len(other.faces) for other in objects) > MAX_TRIANGLES or len(objects) > MAX_SURFACES:
            raise HyalineError(f"{node.scene.path}: has more than {MAX_TRIANGLES:,} triangles; expected fewer")


def _light(node: Node, emitter: Node) -> ForeignLight:
    """A rectangle that shines along its normal."""
    world = node.matrix("to_world")
    corner, edge_u, edge_v = world @ [-1, -1, 0, 1], world @ [2, 0, 0, 0], world @ [0, 2, 0, 0]
    if node.flag("flip_normals"):
        edge_u, edge_v = edge_v, edge_u
    return ForeignLight(
        corner=corner[:3], edge_u=edge_u[:3], edge_v=edge_v[:3], radiance=emitter.color("radiance", 1.0)
    )  # fmt: skip


def _map(node: Node) -> ForeignMap:
    """A map of the environment: its middle column lies towards +z, and +y is up, before it is turned."""
    path = node.file("filename")
    if path.suffix.lower() not in MAP_ENDINGS:
        raise HyalineError(f"{node.where}: names {path.name}; expected linear radiance, in .exr or .hdr")
    world = node.matrix("to_world")[:3, :3]
    if np.linalg.det(world) < 0:
        raise HyalineError(f"{node.where}: is mirrored by its to_world; expected a turn, mirror the picture instead")
    data, scale = read_foreign(path), node.number("scale", 1.0)
    read_map(data, where=str(path))
    if scale <= 0:
        raise HyalineError(f"{node.where}: scale is {scale:g}; expected more than 0")
    middle, up = (column / np.linalg.norm(column) for column in (world[:, 2], world[:, 1]))
    return ForeignMap(data=data, ending=path.suffix.lower(), scale=scale, middle=middle, up=up)


def _camera(node: Node, remarks: Remarks) -> ForeignCamera:
    if node.plugin not in ("perspective", "thinlens"):
        raise HyalineError(f"{node.where}: is of a kind that is not read; known are perspective, thinlens")
    if node.plugin == "thinlens":
        remarks.approximate(node.name, "is out of focus in places; drawn sharp everywhere")
    film = node.inner("Film")
    width, height = (768.0, 576.0) if film is None else (film.number("width", 768), film.number("height", 576))
    if not (width >= 1 and height >= 1):
        raise HyalineError(f"{node.where}: makes pictures of {width:g} x {height:g} pixels; expected at least 1 x 1")
    if "focal_length" in node:
        raise HyalineError(f"{node.where}: gives a focal length; expected fov, in degrees")
    tangent = math.tan(math.radians(min(max(node.number("fov", 39.6), 1e-3), 179.0)) / 2)
    axis = node.text("fov_axis", "x")
    sizes = {"x": width, "y": height, "smaller": min(width, height), "larger": max(width, height),
             "diagonal": math.hypot(width, height)}  # fmt: skip
    if axis not in sizes:
        raise HyalineError(f"{node.where}: fov_axis is {axis[:40]!r}; expected one of {', '.join(sizes)}")
    world = node.matrix("to_world")
    # Mitsuba's cameras look along +z and have +x on their left; OpenGL's look along -z, +x on their right.
    rotation = world[:3, :3] / np.linalg.norm(world[:3, :3], axis=0) * [-1, 1, -1]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, world[:3, 3]
    focal = 0.5 * sizes[axis] / tangent
    fov_deg, lens = lens_of(focal, width, height, where=node.where)
    return ForeignCamera(world_from_camera=matrix, fov_deg=fov_deg, intrinsics=lens)


def _up(cameras: list[ForeignCamera]) -> Axis:
    """The axis that is up in the pictures of the cameras; Mitsuba's own examples have y where nobody says."""
    if not cameras:
        return "y"
    ups = np.abs(np.sum([camera.world_from_camera[:3, 1] for camera in cameras], axis=0))
    axes: tuple[Axis, Axis, Axis] = ("x", "y", "z")
    return axes[int(ups.argmax())]
