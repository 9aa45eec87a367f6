"""glTF and GLB files: every surface that a viewer would show, in the file's world."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from datagen.data.metadata import license_line
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, shown
from datagen.scene.remarks import Remarks
from hyaline_import.fields import Fields
from hyaline_import.foreign import (
    MAX_SURFACES,
    MAX_TRIANGLES,
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    elementwise,
)
from hyaline_import.gltf.file import GltfArrays, GltfFile, read_draco, unread_extensions
from hyaline_import.gltf.materials import TextureUse, clamped, read_material
from hyaline_import.gltf.nodes import Instance, Standing, instances

TRIANGLES, FAN = 4, 6
"""Modes of a primitive; 5 is a strip."""
XMP_RIGHTS = ("dc:rights", "xmpRights:UsageTerms", "xmpRights:WebStatement")
XMP_PLACES = ((), ("@value",), ("@id",), ("rdf:_1",), ("rdf:_1", "@value"))
"""Where the text of an XMP property may be: plain, in a node, or in the first of several languages."""
Attributes = dict[str, np.ndarray]


def read_gltf(path: Path, remarks: Remarks) -> ForeignScene:
    """The surfaces of a glTF or GLB file."""
    file = GltfFile(path)
    arrays = GltfArrays(file)
    _check_lists(file)
    standing = Standing()
    placed = list(instances(arrays, standing, remarks))
    for extension in unread_extensions(file.root, "extensionsUsed"):
        remarks.approximate(path.name, f"uses the extension {shown(extension)}, which is not read")
    if "animations" in file.root:
        remarks.note(path.name, "has animations, which are not read; drawn as the nodes place it")
    uses: dict[int, int] = {}
    for instance in placed:
        _remark_on_morphs(file, instance, remarks)
        uses[instance.mesh] = uses.get(instance.mesh, 0) + 1
    _check_size(arrays, uses)
    materials: dict[int | None, tuple[ForeignMaterial, TextureUse | None]] = {}
    surfaces: dict[int, list[ForeignObject]] = {}
    for mesh in uses:
        surfaces[mesh] = list(_surfaces(arrays, mesh, materials, remarks))
    objects = []
    for instance in placed:
        parts = surfaces[instance.mesh]
        name = instance.node.text("name") or file.lists["meshes"][instance.mesh].text("name")
        for index, part in enumerate(parts):
            own = name or part.name or "object"
            own = f"{own}_{index}" if len(parts) > 1 else own
            objects.append(_placed(part, own, instance.world_from_mesh))
    if not objects:
        raise HyalineError(f"{path}: holds no triangles; expected a scene with a mesh")
    return ForeignScene(
        objects=tuple(objects),
        up="y",
        cameras=tuple(standing.cameras),
        lamps=tuple(standing.lamps),
        license=_license_of(file.root),
    )


def _license_of(root: Fields) -> str | None:
    """The rights in the metadata, as glTF, its XMP extensions and Sketchfab write them; bad metadata is ignored.

    Source: glTF 2.0 section 5.9, KHR_xmp_json_ld.
    """
    asset = root.fields("asset").data
    said = []
    for data in (asset, root.data):
        stated, author = (_within(data, "extras", key) for key in ("license", "author"))
        said += [stated, f"by {author}" if stated and isinstance(author, str) else None]
    said.append(asset.get("copyright"))
    for extension in ("KHR_xmp_json_ld", "KHR_xmp"):
        used = _within(asset, "extensions", extension, "packet")
        for key in XMP_RIGHTS:
            value = _within(root.data, "extensions", extension, "packets", used, key)
            said += [_within(value, *path) for path in XMP_PLACES]
    return license_line(*said)


def _within(data: Json, *path: Json) -> Json:
    """What lies at a path of keys and places; None where nothing does."""
    for step in path:
        if isinstance(data, dict) and isinstance(step, str):
            data = data.get(step)
        elif isinstance(data, list) and isinstance(step, int) and 0 <= step < len(data):
            data = data[step]
        else:
            return None
    return data


def _check_lists(file: GltfFile) -> None:
    for mesh in file.lists["meshes"]:
        if not mesh.listed("primitives"):
            raise HyalineError(f"{mesh.where}.primitives: is empty; expected at least one")


def _check_size(arrays: GltfArrays, uses: dict[int, int]) -> None:
    """Refuses a scene that is too large before any of it is decoded."""
    triangles = surfaces = 0
    for index, times in uses.items():
        for primitive in arrays.file.lists["meshes"][index].listed("primitives"):
            attributes = primitive.fields("attributes")
            source = primitive if "indices" in primitive else attributes
            count = source.integer("indices" if "indices" in primitive else "POSITION")
            is_list = primitive.integer("mode", TRIANGLES) == TRIANGLES
            triangles += times * arrays.count(count, where=source.where) // (3 if is_list else 1)
            surfaces += times
    if triangles > MAX_TRIANGLES or surfaces > MAX_SURFACES:
        raise HyalineError(
            f"{arrays.file.path}: has {triangles:,} triangles in {surfaces:,} surfaces; "
            f"expected at most {MAX_TRIANGLES:,} in {MAX_SURFACES:,}"
        )


def _remark_on_morphs(file: GltfFile, instance: Instance, remarks: Remarks) -> None:
    """A line for a mesh with morph targets: its own shape is what is read. Weights of its node count before its own."""
    mesh = file.lists["meshes"][instance.mesh]
    if not any("targets" in primitive for primitive in mesh.listed("primitives")):
        return
    where = instance.node.text("name") or mesh.text("name") or mesh.where
    weights = instance.node.data.get("weights", mesh.data.get("weights"))
    if isinstance(weights, list) and any(weights):
        remarks.approximate(
            where, "is in part one of its morph targets, which are not read; it keeps the shape without"
        )
    else:
        remarks.note(where, "has morph targets; it keeps the shape without them")


def _surfaces(
    arrays: GltfArrays,
    mesh: int,
    materials: dict[int | None, tuple[ForeignMaterial, TextureUse | None]],
    remarks: Remarks,
) -> Iterator[ForeignObject]:
    """The triangles of a mesh, one surface a primitive, where the mesh itself is."""
    described = arrays.file.lists["meshes"][mesh]
    name = described.text("name")
    for primitive in described.listed("primitives"):
        mode = primitive.integer("mode", TRIANGLES, high=6)
        if mode < TRIANGLES:
            remarks.approximate(name or described.where, "has points or lines, which are left out")
            continue
        chosen = primitive.integer("material") if "material" in primitive else None
        if chosen not in materials:
            materials[chosen] = read_material(arrays.file, chosen, remarks)
        material, use = materials[chosen]
        attributes, corners = _attributes(arrays, primitive)
        if "COLOR_0" in primitive.fields("attributes"):
            remarks.approximate(name or described.where, "has colours at its vertices, which are left out")
        faces = _triangles(corners, mode)
        if not len(faces):
            continue
        if "EXT_mesh_features" in primitive.extensions():
            remarks.note(name or described.where, "has feature ids, which are left out")
        uv = None
        if use is not None and (raw := attributes.get(f"TEXCOORD_{use.channel}")) is not None:
            uv = clamped(use.uv_from_file(raw), faces, use.clamps, remarks, where=name or material.name)
        yield ForeignObject(
            name=name or material.name,
            positions=attributes["POSITION"],
            faces=faces,
            normals=attributes.get("NORMAL"),
            uv=uv,
            material=material,
            crease_deg=0.0,  # Source: glTF 2.0 section 3.7.2.1, "MUST calculate flat normals".
        )


def _attributes(arrays: GltfArrays, primitive: Fields) -> tuple[Attributes, np.ndarray]:
    """Positions, normals and uv of a primitive's vertices, and the vertices of its corners in order."""
    listed = primitive.fields("attributes")
    wanted = {"POSITION": "VEC3", "NORMAL": "VEC3"}
    wanted |= {name: "VEC2" for name in listed if re.fullmatch(r"TEXCOORD_\d{1,2}", name)}
    draco = primitive.extension("KHR_draco_mesh_compression")
    if draco is not None:
        found, corners = read_draco(arrays, draco, {name: kind for name, kind in wanted.items() if name in listed})
    else:
        listed.integer("POSITION")
        found = {
            name: arrays.array(listed.integer(name), kind, where=listed.where)
            for name, kind in wanted.items()
            if name in listed
        }
        corners = np.arange(len(found["POSITION"]))
        if "indices" in primitive:
            corners = arrays.array(primitive.integer("indices"), "SCALAR", where=primitive.where)
    count = len(found["POSITION"])
    if any(len(values) != count for values in found.values()):
        raise HyalineError(f"{primitive.where}: its attributes differ in length; export the file again")
    if corners.ndim != 1 or corners.dtype.kind != "i":
        raise HyalineError(f"{primitive.where}.indices: are not whole numbers; export the file again")
    if len(corners) and (corners.min() < 0 or corners.max() >= count):
        raise HyalineError(f"{primitive.where}: names vertex {corners.max()} of {count}; export the file again")
    return found, corners


def _triangles(corners: np.ndarray, mode: int) -> np.ndarray:
    """Faces (n, 3) of corners in the order of a list, a strip or a fan."""
    if mode == TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == FAN:
        return np.stack([np.broadcast_to(corners[0], len(corners) - 2), corners[1:-1], corners[2:]], axis=-1)
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=-1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def _placed(part: ForeignObject, name: str, world: np.ndarray) -> ForeignObject:
    """A surface in the world: what a mirroring node turns inside out is wound the right way round again."""
    linear = world[:3, :3]
    determinant = float(np.linalg.det(linear))
    if abs(determinant) < 1e-30:
        raise HyalineError(f"{name}: its node flattens it to nothing; expected a scale other than 0")
    normals = None
    if part.normals is not None:
        normals = elementwise(part.normals, np.linalg.inv(linear).T, np.zeros(3))
    return dataclasses.replace(
        part,
        name=name,
        positions=elementwise(part.positions, linear, world[:3, 3]),
        faces=part.faces[:, ::-1] if determinant < 0 else part.faces,
        normals=normals,
    )
