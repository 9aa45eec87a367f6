"""Shapes of a Mitsuba scene as triangles in its world."""

import dataclasses
from collections.abc import Callable

import numpy as np

from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.scene.importers.foreign import ForeignObject, elementwise
from datagen.scene.importers.mitsuba_nodes import Node
from datagen.scene.importers.mitsuba_serialized import read_serialized
from datagen.scene.importers.obj import PLAIN, read_obj
from datagen.scene.importers.ply import read_ply_file
from datagen.scene.importers.remarks import Remarks
from datagen.scene.modelling import ball, sheet

SEGMENTS = 96
"""Sides of a disk or a cylinder."""


def read_shape(node: Node, remarks: Remarks) -> list[ForeignObject]:
    """The triangles of a shape in the file's world, with uv whose v points up, and no material yet.

    Raises:
        HyalineError: a kind that is not read, or a file that is not in the scene's folder.
    """
    if node.plugin not in SHAPES:
        known = ", ".join(sorted(SHAPES))
        raise HyalineError(f"{node.where}: is of a kind that is not read; known are {known}, export it as PLY")
    world = node.matrix("to_world")
    is_flipped = node.flag("flip_normals")
    found = []
    for item in SHAPES[node.plugin](node, remarks):
        turned = (np.linalg.det(world[:3, :3]) < 0) != is_flipped
        normals = None if item.normals is None or node.flag("face_normals") else item.normals
        if normals is not None:
            normals = elementwise(normals, np.linalg.inv(world[:3, :3]).T, np.zeros(3)) * (-1 if is_flipped else 1)
        found.append(
            dataclasses.replace(
                item,
                positions=elementwise(item.positions, world[:3, :3], world[:3, 3]),
                faces=item.faces[:, ::-1] if turned else item.faces,
                normals=normals,
            )
        )
    return found


def _from_mesh(node: Node, mesh: Mesh, uv: np.ndarray | None = None) -> ForeignObject:
    return ForeignObject(
        name=node.name, positions=mesh.vertices.astype(np.float64), faces=mesh.faces, normals=mesh.normals, uv=uv,
        material=PLAIN,
    )  # fmt: skip


def _ply(node: Node, remarks: Remarks) -> list[ForeignObject]:
    # Mitsuba's v points down in images, and files are taken as they are; ours points up.
    return [_named(node, item, flips=not node.flag("flip_tex_coords"))
            for item in read_ply_file(node.file("filename"), remarks).objects]  # fmt: skip


def _obj(node: Node, remarks: Remarks) -> list[ForeignObject]:
    objects = read_obj(node.file("filename"), remarks, has_materials=False).objects
    return [_named(node, item, flips=not node.flag("flip_tex_coords", default=True)) for item in objects]


def _serialized(node: Node, remarks: Remarks) -> list[ForeignObject]:  # noqa: ARG001
    index = node.number("shape_index", 0)
    return [_named(node, read_serialized(node.file("filename"), int(index)), flips=True)]


def _named(node: Node, item: ForeignObject, *, flips: bool) -> ForeignObject:
    uv = item.uv
    if uv is not None and flips:
        uv = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1)
    return dataclasses.replace(item, name=item.name if node.name == node.plugin else node.name, uv=uv, material=PLAIN)


def _sphere(node: Node, remarks: Remarks) -> list[ForeignObject]:
    radius = node.number("radius", 1.0)
    if radius <= 0:
        raise HyalineError(f"{node.where}: radius is {radius:g}; expected a positive number")
    item = _from_mesh(node, ball(1.0, subdivisions=5))
    remarks.note(node.name, f"is a sphere; made of {len(item.faces):,} triangles")
    center = node.point("center", (0.0, 0.0, 0.0))
    return [dataclasses.replace(item, positions=radius * item.positions + center)]


def _cube(node: Node, remarks: Remarks) -> list[ForeignObject]:  # noqa: ARG001
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    quads = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return [ForeignObject(name=node.name, positions=corners, faces=faces, normals=None, uv=None, material=PLAIN)]


def _rectangle(node: Node, remarks: Remarks) -> list[ForeignObject]:  # noqa: ARG001
    mesh = sheet((-1.0, -1.0, 0.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0))
    return [_from_mesh(node, mesh, np.stack([(mesh.vertices[:, 0] + 1) / 2, (1 - mesh.vertices[:, 1]) / 2], axis=-1))]


def _circle() -> np.ndarray:
    angles = np.arange(SEGMENTS) * (2 * np.pi / SEGMENTS)
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(SEGMENTS)], axis=-1)


def _disk(node: Node, remarks: Remarks) -> list[ForeignObject]:  # noqa: ARG001
    ring = np.arange(SEGMENTS)
    faces = np.stack([np.full(SEGMENTS, SEGMENTS), ring, np.roll(ring, -1)], axis=-1)
    positions = np.concatenate([_circle(), np.zeros((1, 3))])
    return [ForeignObject(name=node.name, positions=positions, faces=faces, normals=None, uv=None, material=PLAIN)]


def _cylinder(node: Node, remarks: Remarks) -> list[ForeignObject]:  # noqa: ARG001
    start, end = node.point("p0", (0.0, 0.0, 0.0)), node.point("p1", (0.0, 0.0, 1.0))
    axis = (end - start) / max(float(np.linalg.norm(end - start)), 1e-12)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    circle = _circle()
    around = node.number("radius", 1.0) * (circle[:, :1] * side + circle[:, 1:2] * np.cross(axis, side))
    ring = np.arange(SEGMENTS)
    following = np.roll(ring, -1)
    faces = np.concatenate([
        np.stack([ring, following, following + SEGMENTS], axis=-1),
        np.stack([ring, following + SEGMENTS, ring + SEGMENTS], axis=-1),
    ])  # fmt: skip
    positions = np.concatenate([start + around, end + around])
    return [ForeignObject(name=node.name, positions=positions, faces=faces, normals=None, uv=None, material=PLAIN)]


SHAPES: dict[str, Callable[[Node, Remarks], list[ForeignObject]]] = {
    "ply": _ply, "obj": _obj, "sphere": _sphere, "cube": _cube, "rectangle": _rectangle, "disk": _disk,
    "cylinder": _cylinder, "serialized": _serialized,
}  # fmt: skip
