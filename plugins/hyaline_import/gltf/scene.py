"""glTF and GLB files: every surface that a viewer would show, where the file's tree of nodes puts it.

Source: glTF 2.0 sections 3.5 to 3.10.
"""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.data.config import license_line
from datagen.disk.errors import HyalineError, shown
from hyaline_import.foreign import (
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    elementwise,
)
from hyaline_import.gltf import file as records
from hyaline_import.gltf.file import GltfFile, Node, Primitive, unread
from hyaline_import.gltf.materials import TextureUse, read_material
from hyaline_import.remarks import Remarks

MAX_COORDINATE = 1e18
MIN_SCALE = 1e-10
"""Scale below which there is nothing to see."""
TRIANGLES = 4
"""Mode of a primitive whose corners make triangles, three by three."""
Materials = dict[int | None, tuple[ForeignMaterial, TextureUse | None]]


def read_gltf(path: Path, remarks: Remarks) -> ForeignScene:
    """The surfaces of a glTF or GLB file."""
    file = GltfFile(path)
    for extension in unread(file.root.extensions_used):
        remarks.approximate(path.name, f"uses the extension {shown(extension)}, which is not read")
    if file.root.animations is not None:
        remarks.note(path.name, "has animations, which are not read; drawn as the nodes pose it")
    materials: Materials = {}
    surfaces: dict[int, list[ForeignObject]] = {}
    objects = []
    for node, world in list(_placed_nodes(file)):  # A fifth faster than one by one, for very many.
        if "KHR_lights_punctual" in node.extensions:
            remarks.approximate(_name(node), "is a lamp without a size, which is left out")
        if node.mesh is None:
            continue
        if node.skin is not None:
            remarks.approximate(_name(node), "hangs on a skeleton, and is left out; apply it before you export")
            continue
        # Scaled to 0 along two axes or more. Source: glTF 2.0 section 3.5.3.
        if np.linalg.svd(world[:3, :3], compute_uv=False)[1] < MIN_SCALE:
            remarks.note(_name(node), "is scaled to nothing, which hides it; left out")
            continue
        mesh = file.item(file.root.meshes, node.mesh, where=node.where)
        if any(mesh.weights if node.weights is None else node.weights):
            remarks.approximate(_name(node), "has shape keys, which are not read; apply them before you export")
        if node.mesh not in surfaces:
            surfaces[node.mesh] = list(_surfaces(file, mesh, materials, remarks))
        parts = surfaces[node.mesh]
        for index, part in enumerate(parts):
            own = node.name or mesh.name or part.name or "object"
            objects.append(_placed(part, f"{own}_{index}" if len(parts) > 1 else own, world))
    return ForeignScene(objects=tuple(objects), up="y", license=_license_of(file.root))


def _placed_nodes(file: GltfFile) -> Iterator[tuple[Node, Float[np.ndarray, "4 4"]]]:
    """Every node of the file's scene, with its world_from_node; parents come before children."""
    root = file.root
    if root.scenes:
        roots = file.item(root.scenes, root.scene, where=f"{file.path}: scene").nodes
    else:
        below = {child for node in root.nodes for child in node.children}
        roots = [index for index in range(len(root.nodes)) if index not in below]
    waiting = [(index, np.eye(4)) for index in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        index, world_from_parent = waiting.pop()
        node = file.item(root.nodes, index, where=f"{file.path}: nodes")
        if index in seen:
            raise HyalineError(f"{node.where}: is part of a cycle or has two parents; export the file again")
        seen.add(index)
        world_from_node = world_from_parent @ _local(node)
        if not np.abs(world_from_node).max() < MAX_COORDINATE:
            raise HyalineError(f"{node.where}: is larger than can be; export the file again")
        yield node, world_from_node
        waiting += [(child, world_from_node) for child in reversed(node.children)]


def _local(node: Node) -> Float[np.ndarray, "4 4"]:
    """Scale, then turn by a quaternion (x, y, z, w), then move."""
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    if np.linalg.norm(node.rotation) < 1e-9:
        raise HyalineError(f"{node.where}: has a rotation of length 0; export the file again")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(node.rotation).as_matrix() * node.scale
    matrix[:3, 3] = node.translation
    return matrix


def _name(entry: Node) -> str:
    return entry.name or entry.where.rsplit(" ", 1)[-1]


def _license_of(root: records.Gltf) -> str | None:
    """The rights in the metadata, as glTF and Sketchfab write them; bad metadata is ignored."""
    said = []
    for extras in (root.asset.extras, root.extras):
        stated, author = (extras.get(key) if isinstance(extras, dict) else None for key in ("license", "author"))
        said += [stated, f"by {author}" if stated and isinstance(author, str) else None]
    return license_line(*said, root.asset.copyright)


def _surfaces(file: GltfFile, mesh: records.Mesh, materials: Materials, remarks: Remarks) -> Iterator[ForeignObject]:
    """The triangles of a mesh, one surface a primitive, where the mesh itself is."""
    for primitive in mesh.primitives:
        where = mesh.name or mesh.where
        left_out = {
            "points, lines, strips or fans": primitive.mode != TRIANGLES,
            "colours at its vertices": "COLOR_0" in primitive.attributes,
        }
        for what in (what for what, is_there in left_out.items() if is_there):
            remarks.approximate(where, f"has {what}, which are left out")
        if primitive.mode != TRIANGLES:
            continue
        if primitive.material not in materials:
            materials[primitive.material] = read_material(file, primitive.material, remarks)
        material, use = materials[primitive.material]
        attributes, corners = _attributes(file, primitive, where=mesh.where)
        faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
        if not len(faces):
            continue
        uv = None
        if use is not None and (raw := attributes.get(f"TEXCOORD_{use.channel}")) is not None:
            uv = use.uv_from_file(raw)
        yield ForeignObject(
            name=mesh.name or material.name,
            positions=attributes["POSITION"],
            faces=faces,
            normals=attributes.get("NORMAL"),
            uv=uv,
            material=material,
            crease_deg=0.0,  # Source: glTF 2.0 section 3.7.2.1, "MUST calculate flat normals".
        )


def _attributes(file: GltfFile, primitive: Primitive, *, where: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Positions, normals and uv of a primitive's vertices, and the vertices of its corners in order."""
    if "POSITION" not in primitive.attributes:
        raise HyalineError(f"{where}: has a primitive without POSITION; export the file again")
    wanted = {name: "VEC3" for name in ("POSITION", "NORMAL") if name in primitive.attributes}
    wanted |= {name: "VEC2" for name in primitive.attributes if re.fullmatch(r"TEXCOORD_\d{1,2}", name)}
    found = {name: file.array(primitive.attributes[name], kind, where=where) for name, kind in wanted.items()}
    count = len(found["POSITION"])
    corners = np.arange(count)
    if primitive.indices is not None:
        corners = file.array(primitive.indices, "SCALAR", where=where)
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
    normals = part.normals
    if normals is not None:
        normals = elementwise(normals, np.linalg.inv(linear).T, np.zeros(3))
    positions = elementwise(part.positions, linear, world[:3, 3])
    faces = part.faces[:, ::-1] if determinant < 0 else part.faces
    return dataclasses.replace(part, name=name, positions=positions, faces=faces, normals=normals)
