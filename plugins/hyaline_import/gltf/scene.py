"""glTF and GLB files: every surface that a viewer would show, in the file's world."""

import dataclasses
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from datagen.data.cameras import Camera
from datagen.data.config import license_line
from datagen.disk.errors import HyalineError, shown
from hyaline_import.foreign import (
    MAX_SURFACES,
    MAX_TRIANGLES,
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    elementwise,
)
from hyaline_import.gltf.file import READ_EXTENSIONS, GltfFile
from hyaline_import.gltf.materials import TextureUse, read_material, wrapped
from hyaline_import.gltf.nodes import Instance, bend, instances, morph, skin_matrices
from hyaline_import.gltf.records import Gltf, Primitive
from hyaline_import.remarks import Remarks

TRIANGLES = 4
"""Mode of a primitive whose corners make triangles, three by three."""
Materials = dict[int | None, tuple[ForeignMaterial, TextureUse | None]]
Attributes = dict[str, np.ndarray]


def read_gltf(path: Path, remarks: Remarks) -> ForeignScene:
    """The surfaces of a glTF or GLB file."""
    file = GltfFile(path)
    cameras: list[Camera] = []
    worlds: dict[int, np.ndarray] = {}
    placed = list(instances(file, cameras, worlds, remarks))
    for extension in sorted({*file.root.extensions_used} - READ_EXTENSIONS):
        remarks.approximate(path.name, f"uses the extension {shown(extension)}, which is not read")
    if file.root.animations is not None:
        remarks.note(path.name, "has animations, which are not read; drawn as the nodes pose it")
    uses = Counter(instance.mesh for instance in placed)
    _check_size(file, uses)
    materials: Materials = {}
    surfaces: dict[tuple, list[ForeignObject]] = {}
    objects = []
    for instance in placed:
        shape = instance.mesh, instance.weights, instance.node.skin
        if shape not in surfaces:
            bones = None if instance.node.skin is None else skin_matrices(file, instance.node.skin, worlds)
            surfaces[shape] = list(_surfaces(file, instance, bones, materials, remarks))
        parts = surfaces[shape]
        name = instance.node.name or file.root.meshes[instance.mesh].name
        for index, part in enumerate(parts):
            own = name or part.name or "object"
            own = f"{own}_{index}" if len(parts) > 1 else own
            objects.append(_placed(part, own, instance.world_from_mesh))
    if not objects:
        raise HyalineError(f"{path}: holds no triangles; expected a scene with a mesh")
    return ForeignScene(objects=tuple(objects), up="y", cameras=tuple(cameras), license=_license_of(file.root))


def _license_of(root: Gltf) -> str | None:
    """The rights in the metadata, as glTF and Sketchfab write them; bad metadata is ignored."""
    said = []
    for extras in (root.asset.extras, root.extras):
        stated, author = (extras.get(key) if isinstance(extras, dict) else None for key in ("license", "author"))
        said += [stated, f"by {author}" if stated and isinstance(author, str) else None]
    return license_line(*said, root.asset.copyright)


def _check_size(file: GltfFile, uses: Counter[int]) -> None:
    """Refuses a scene that is too large before any of it is decoded."""
    triangles = surfaces = 0
    for index, times in uses.items():
        mesh = file.item(file.root.meshes, index, where=f"{file.path}: nodes")
        for primitive in mesh.primitives:
            if "POSITION" not in primitive.attributes:
                raise HyalineError(f"{mesh.where}: has a primitive without POSITION; export the file again")
            corners = primitive.attributes["POSITION"] if primitive.indices is None else primitive.indices
            triangles += times * file.count(corners, where=mesh.where) // 3
            surfaces += times
    if triangles > MAX_TRIANGLES or surfaces > MAX_SURFACES:
        raise HyalineError(
            f"{file.path}: has {triangles:,} triangles in {surfaces:,} surfaces; "
            f"expected at most {MAX_TRIANGLES:,} in {MAX_SURFACES:,}"
        )


def _surfaces(
    file: GltfFile, instance: Instance, bones: np.ndarray | None, materials: Materials, remarks: Remarks
) -> Iterator[ForeignObject]:
    """The triangles of a mesh, one surface a primitive, where the mesh itself is; with a skin, where its bones are."""
    described = file.root.meshes[instance.mesh]
    for primitive in described.primitives:
        where = described.name or described.where
        if primitive.mode != TRIANGLES:
            remarks.approximate(where, "has points, lines, strips or fans, which are left out")
            continue
        if "COLOR_0" in primitive.attributes:
            remarks.approximate(where, "has colours at its vertices, which are left out")
        if primitive.material not in materials:
            materials[primitive.material] = read_material(file, primitive.material, remarks)
        material, use = materials[primitive.material]
        attributes, corners = _attributes(file, primitive, where=described.where)
        morph(file, attributes, primitive.targets, instance.weights, where=described.where)
        if bones is not None:
            bend(attributes, bones, where=described.where)
        faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
        if not len(faces):
            continue
        uv = None
        if use is not None and (raw := attributes.get(f"TEXCOORD_{use.channel}")) is not None:
            uv = wrapped(use.uv_from_file(raw), faces, use.repeats, remarks, where=described.name or material.name)
        yield ForeignObject(
            name=described.name or material.name,
            positions=attributes["POSITION"],
            faces=faces,
            normals=attributes.get("NORMAL"),
            uv=uv,
            material=material,
            crease_deg=0.0,  # Source: glTF 2.0 section 3.7.2.1, "MUST calculate flat normals".
        )


def _attributes(file: GltfFile, primitive: Primitive, *, where: str) -> tuple[Attributes, np.ndarray]:
    """Positions, normals and uv of a primitive's vertices, and the vertices of its corners in order."""
    wanted = {name: "VEC3" for name in ("POSITION", "NORMAL") if name in primitive.attributes}
    wanted |= {name: "VEC2" for name in primitive.attributes if re.fullmatch(r"TEXCOORD_\d{1,2}", name)}
    wanted |= {name: "VEC4" for name in primitive.attributes if re.fullmatch(r"(JOINTS|WEIGHTS)_\d", name)}
    found = {name: file.array(primitive.attributes[name], kind, where=where) for name, kind in wanted.items()}
    corners = np.arange(len(found["POSITION"]))
    if primitive.indices is not None:
        corners = file.array(primitive.indices, "SCALAR", where=where)
    count = len(found["POSITION"])
    if any(len(values) != count for values in found.values()):
        raise HyalineError(f"{where}: its attributes differ in length; export the file again")
    if corners.ndim != 1 or corners.dtype.kind != "i":
        raise HyalineError(f"{where}: its indices are not whole numbers; export the file again")
    if len(corners) and (corners.min() < 0 or corners.max() >= count):
        raise HyalineError(f"{where}: names vertex {corners.max()} of {count}; export the file again")
    return found, corners


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
