"""Mitsuba 3 scenes: parsed, not loaded, and no plugin of theirs is ever made.

Loading one would run native code from plugin folders beside the file, and read any file that it names.
"""

import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.scene.description import MAP_ENDINGS, RectangleLight
from datagen.scene.images import read_map
from datagen.scene.materials import Color, as_vector
from datagen.scene.modelling import ball, sheet
from datagen.scene.shading_normals import unit
from hyaline_import.foreign import (
    PLAIN,
    Axis,
    ForeignMap,
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    elementwise,
    read_foreign,
)
from hyaline_import.mitsuba.nodes import FoundMaterial, Node, NodeList, absorption_of, read_bsdf
from hyaline_import.plain import read_obj, read_ply_file
from hyaline_import.remarks import Remarks

QUIET = ("Integrator", "Sampler", "Film", "BSDF", "Texture", "Medium")
"""Top-level nodes that do not change the scene, or that shapes refer to."""
MAGIC = 0x041C
NORMALS, UV, COLORS, DOUBLE = 0x0001, 0x0002, 0x0008, 0x2000
MAX_NAME = 4096
MAX_MESHES = 20_000


def read_mitsuba(path: Path, remarks: Remarks) -> ForeignScene:
    """The shapes, materials and lights of a scene file."""
    nodes = NodeList(path)
    objects: list[ForeignObject] = []
    lights: list[RectangleLight] = []
    sensors: list[Node] = []
    sky: Color | ForeignMap | None = None
    for node in nodes.root.children():
        if node.kind == "Shape":
            _add_shape(node, objects, lights, remarks)
        elif node.kind == "Sensor":
            sensors.append(node)
        elif node.kind == "Emitter" and node.plugin == "constant":
            sky = node.color("radiance", 1.0)
        elif node.kind == "Emitter" and node.plugin == "envmap":
            sky = _map(node)
        elif node.kind == "Emitter":
            remarks.approximate(node.name, f"is a light of kind {node.plugin}, which is left out")
        elif node.kind not in QUIET:
            remarks.approximate(node.name, f"is a {node.kind.lower()} of kind {node.plugin}, which is left out")
    if sky is None and lights:
        sky = (0.0, 0.0, 0.0)
    return ForeignScene(
        objects=tuple(objects),
        up=_up(sensors),
        lights=tuple(lights),
        sky=sky,
        is_complete=True,
    )


def _add_shape(node: Node, objects: list[ForeignObject], lights: list[RectangleLight], remarks: Remarks) -> None:
    emitter = node.inner("Emitter")
    if emitter is not None and node.plugin == "rectangle" and emitter.plugin == "area":
        lights.append(_light(node, emitter))
        return
    grey = replace(PLAIN, name=node.name, base_color=(0.5, 0.5, 0.5), roughness=1.0)
    by_name = {name: read_bsdf(bsdf, remarks) for name, bsdf in node.named("BSDF").items()}
    first = next(iter(by_name.values()), FoundMaterial(material=grey))
    interior = absorption_of(node.child("interior"))
    emission = (0.0, 0.0, 0.0) if emitter is None else emitter.color("radiance", 1.0)
    if max(interior) > 0 and all(found.material.transmission == 0 for found in by_name.values()):
        raise HyalineError(f"{node.where}: has a medium inside and no glass around it; expected a dielectric")
    for item in read_shape(node, remarks):
        found = by_name.get(item.material.name, first) if isinstance(item.material, ForeignMaterial) else first
        absorption = interior if found.material.transmission > 0 else (0.0, 0.0, 0.0)
        material = replace(found.material, absorption=absorption, emission=emission)
        uv = item.uv
        if uv is not None:
            # The transform of a texture is one of Mitsuba's uv, whose v points down.
            zeros, ones = np.zeros(len(uv)), np.ones(len(uv))
            flat = np.stack([uv[:, 0], 1 - uv[:, 1], zeros, ones], axis=-1)
            flat = flat @ found.image_from_uv.T
            uv = np.stack([flat[:, 0], 1 - flat[:, 1]], axis=-1)
        objects.append(replace(item, uv=uv, material=material))


def _light(node: Node, emitter: Node) -> RectangleLight:
    """A rectangle that shines along its normal."""
    world = node.matrix("to_world")
    corner, edge_u, edge_v = world @ [-1, -1, 0, 1], world @ [2, 0, 0, 0], world @ [0, 2, 0, 0]
    is_mirrored = np.linalg.det(world[:3, :3]) < 0
    if node.flag("flip_normals") != is_mirrored:  # Mitsuba turns mirrored shapes round, too.
        edge_u, edge_v = edge_v, edge_u
    corner, edge_u, edge_v = (as_vector(vector[:3]) for vector in (corner, edge_u, edge_v))
    return RectangleLight(corner=corner, edge_u=edge_u, edge_v=edge_v, radiance=emitter.color("radiance", 1.0))


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


def _up(sensors: list[Node]) -> Axis:
    """The axis that is up in the pictures of the cameras; Mitsuba's own examples have y by default."""
    if not sensors:
        return "y"
    ups = np.abs(unit(np.array([node.matrix("to_world")[:3, 1] for node in sensors])).sum(axis=0))
    axes: tuple[Axis, Axis, Axis] = ("x", "y", "z")
    return axes[int(ups.argmax())]


# Shapes


def read_shape(node: Node, remarks: Remarks) -> list[ForeignObject]:
    """The triangles of a shape in the file's world, with uv whose v points up, and no material yet."""
    if node.plugin not in SHAPES:
        known = ", ".join(sorted(SHAPES))
        raise HyalineError(f"{node.where}: is of a kind that is not read; known are {known}, export it as PLY")
    world = node.matrix("to_world")
    is_flipped = node.flag("flip_normals")
    found = []
    for item in SHAPES[node.plugin](node, remarks):
        turned = (np.linalg.det(world[:3, :3]) < 0) != is_flipped
        positions = elementwise(item.positions, world[:3, :3], world[:3, 3])
        faces = item.faces[:, ::-1] if turned else item.faces
        normals, crease_deg = item.normals, item.crease_deg
        if node.flag("face_normals"):
            normals, crease_deg = None, 0.0
        elif normals is not None:
            normals = elementwise(normals, np.linalg.inv(world[:3, :3]).T, np.zeros(3)) * (-1 if is_flipped else 1)
        elif node.plugin in ("obj", "ply", "serialized"):
            import trimesh

            # As Mitsuba computes missing ones: over every edge, weighted by the angles of a vertex's faces.
            normals = np.array(trimesh.Trimesh(positions, faces, process=False).vertex_normals)
        found.append(replace(item, positions=positions, faces=faces, normals=normals, crease_deg=crease_deg))
    return found


def _file(node: Node, remarks: Remarks) -> list[ForeignObject]:
    """The meshes of a file; Mitsuba's v points down in images, and files are taken as they are; ours points up."""
    path = node.file("filename")
    if node.plugin == "ply":
        found = read_ply_file(path, remarks).objects
    elif node.plugin == "obj":
        # Of several BSDFs, each is that of the material of its name. Source: the plugin obj of Mitsuba 0.6.
        materials = {name: replace(PLAIN, name=name) for name in node.named("BSDF")}
        found = read_obj(path, remarks, materials=materials).objects
    else:
        found = (read_serialized(path, int(node.number("shape_index", 0))),)
    flips = node.plugin == "serialized" or not node.flag("flip_tex_coords", default=node.plugin == "obj")
    objects = []
    for item in found:
        uv = np.stack([item.uv[:, 0], 1 - item.uv[:, 1]], axis=-1) if item.uv is not None and flips else item.uv
        objects.append(replace(item, name=item.name if node.name == node.plugin else node.name, uv=uv))
    return objects


def _sphere(node: Node, remarks: Remarks) -> list[ForeignObject]:
    radius = node.number("radius", 1.0)
    if radius <= 0:
        raise HyalineError(f"{node.where}: radius is {radius:g}; expected a positive number")
    mesh = ball(1.0, subdivisions=5)
    remarks.note(node.name, f"is a sphere; made of {len(mesh.faces):,} triangles")
    positions = radius * mesh.vertices.astype(np.float64) + node.point("center", (0.0, 0.0, 0.0))
    return [ForeignObject(name=node.name, positions=positions, faces=mesh.faces, normals=mesh.normals)]


def _cube(node: Node, remarks: Remarks) -> list[ForeignObject]:  # noqa: ARG001
    import trimesh

    box = trimesh.creation.box((2.0, 2.0, 2.0))
    return [ForeignObject(name=node.name, positions=np.array(box.vertices), faces=np.array(box.faces))]


def _rectangle(node: Node, remarks: Remarks) -> list[ForeignObject]:  # noqa: ARG001
    mesh = sheet((-1.0, -1.0, 0.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0))
    positions = mesh.vertices.astype(np.float64)
    uv = (positions[:, :2] * [1, -1] + 1) / 2
    return [ForeignObject(name=node.name, positions=positions, faces=mesh.faces, normals=mesh.normals, uv=uv)]


SHAPES: dict[str, Callable[[Node, Remarks], list[ForeignObject]]] = {
    "ply": _file, "obj": _file, "serialized": _file, "sphere": _sphere, "cube": _cube, "rectangle": _rectangle,
}  # fmt: skip


# Serialized meshes: several in a file, each compressed by zlib


def read_serialized(path: Path, index: int) -> ForeignObject:
    """One mesh of a file; nothing is unpacked beyond what its counts promise.

    Read by hand: Mitsuba's reader (3.9) writes outside of its arrays for missing vertices, and wraps large counts.
    """
    data = read_foreign(path)
    try:
        stream, version = _stream(data, index, path)
        return _mesh(stream, version, path)
    except (struct.error, zlib.error, OverflowError, ValueError) as error:  # Also text that is not in UTF-8.
        raise HyalineError(f"{path}: not a serialized mesh that can be read ({error}); export it as PLY") from None


def _stream(data: bytes, index: int, path: Path) -> tuple[bytes, int]:
    """The compressed bytes of a mesh, and its format's version."""
    _, version = struct.unpack_from("<HH", data)
    (count,) = struct.unpack_from("<I", data, len(data) - 4)
    width = 8 if version == 4 else 4
    if not 1 <= count <= MAX_MESHES or not 0 <= index < count:
        raise HyalineError(f"{path}: has {count:,} meshes; expected 1 to {MAX_MESHES:,}, and shape_index {index} in it")
    offsets = np.frombuffer(data, f"<u{width}", count, len(data) - 4 - count * width).tolist()
    begin, end = [*offsets, len(data)][index : index + 2]
    if begin >= len(data) or struct.unpack_from("<HH", data, begin) not in ((MAGIC, 3), (MAGIC, 4)):
        raise ValueError(f"mesh {index} of version 3 or 4 is not where the file's index says")
    return data[begin + 4 : end], version


def _mesh(stream: bytes, version: int, path: Path) -> ForeignObject:
    unpacker = zlib.decompressobj()
    head = unpacker.decompress(stream, MAX_NAME + 64)
    (flags,) = struct.unpack_from("<I", head)
    at, name = 4, path.stem
    if version == 4:
        end = head.index(b"\0", at)
        name, at = head[at:end].decode() or name, end + 1
    vertices, faces = struct.unpack_from("<QQ", head, at)
    kind = np.dtype("<f8" if flags & DOUBLE else "<f4")
    widths = [3, 3 * bool(flags & NORMALS), 2 * bool(flags & UV), 3 * bool(flags & COLORS)]
    corners_at = at + 16 + vertices * sum(widths) * kind.itemsize
    size = corners_at + 12 * faces
    body = head + unpacker.decompress(unpacker.unconsumed_tail, max(size - len(head), 1))
    numbers = np.frombuffer(body, kind, vertices * sum(widths), at + 16).astype(np.float64)
    corners = np.frombuffer(body, "<u4", 3 * faces, corners_at).astype(np.int64).reshape(-1, 3)
    positions, normals, uv, _ = (
        part.reshape(vertices, -1) for part in np.split(numbers, vertices * np.cumsum(widths)[:3])
    )
    if corners.max() >= vertices or not np.isfinite(numbers).all():
        raise ValueError(f"a number is not finite, or a triangle names vertex {corners.max():,} of {vertices:,}")
    return ForeignObject(
        name=name,
        positions=positions,
        faces=corners,
        normals=normals if flags & NORMALS else None,
        uv=uv if flags & UV else None,
    )
