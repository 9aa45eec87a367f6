"""glTF and GLB files: every surface that a viewer would show, where the file's tree of nodes puts it.

Source: glTF 2.0 sections 3.5 to 3.10.
"""

import dataclasses
import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.data.cameras import MAX_SKEW, Camera
from datagen.data.config import license_line
from datagen.disk.errors import HyalineError, shown
from hyaline_import.foreign import (
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    elementwise,
    lens_of,
)
from hyaline_import.gltf import file as records
from hyaline_import.gltf.file import READ_EXTENSIONS, GltfFile, Node, Primitive
from hyaline_import.gltf.materials import TextureUse, read_material, wrapped
from hyaline_import.remarks import Remarks

LAMPS = "KHR_lights_punctual"
MAX_COORDINATE = 1e18
MIN_SCALE = 1e-10
"""Scale below which there is nothing to see."""
FILM = 1000.0
"""Height in pixels that describes a camera's pictures: glTF has none."""
TRIANGLES = 4
"""Mode of a primitive whose corners make triangles, three by three."""
Placed = tuple[Node, Float[np.ndarray, "4 4"]]
Materials = dict[int | None, tuple[ForeignMaterial, TextureUse | None]]


def read_gltf(path: Path, remarks: Remarks) -> ForeignScene:
    """The surfaces of a glTF or GLB file."""
    file = GltfFile(path)
    placed = dict(_placed_nodes(file))
    for extension in sorted({*file.root.extensions_used} - READ_EXTENSIONS):
        remarks.approximate(path.name, f"uses the extension {shown(extension)}, which is not read")
    if file.root.animations is not None:
        remarks.note(path.name, "has animations, which are not read; drawn as the nodes pose it")
    cameras: list[Camera] = []
    materials: Materials = {}
    surfaces: dict[object, list[ForeignObject]] = {}
    objects = []
    for node, world in placed.values():
        if node.camera is not None:
            cameras += _camera(file.item(file.root.cameras, node.camera, where=node.where), world, remarks)
        if LAMPS in node.extensions:
            remarks.approximate(_name(node), "is a lamp without a size, which is left out")
        if node.mesh is None:
            continue
        bones = None
        if node.skin is not None:
            # A mesh with a skin is where its joints are. Source: glTF 2.0 section 3.7.3.3.
            bones, world = _bones(file, node.skin, placed), np.eye(4)
        # Scaled to 0 along two axes or more. Source: glTF 2.0 section 3.5.3.
        if np.linalg.svd(world[:3, :3], compute_uv=False)[1] < MIN_SCALE:
            remarks.note(_name(node), "is scaled to nothing, which hides it; left out")
            continue
        mesh = file.item(file.root.meshes, node.mesh, where=node.where)
        weights = mesh.weights if node.weights is None else node.weights
        key = node.mesh, tuple(weights), node.skin
        if key not in surfaces:
            surfaces[key] = list(_surfaces(file, mesh, materials, remarks, weights, bones))
        parts = surfaces[key]
        for index, part in enumerate(parts):
            own = node.name or mesh.name or part.name or "object"
            objects.append(_placed(part, f"{own}_{index}" if len(parts) > 1 else own, world))
    return ForeignScene(objects=tuple(objects), up="y", cameras=tuple(cameras), license=_license_of(file.root))


def _placed_nodes(file: GltfFile) -> Iterator[tuple[int, Placed]]:
    """Every node of the file's scene by its index, with its world_from_node; parents come before children."""
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
        yield index, (node, world_from_node)
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


def _name(entry: Node | records.Camera) -> str:
    return entry.name or entry.where.rsplit(" ", 1)[-1]


def _camera(camera: records.Camera, world: Float[np.ndarray, "4 4"], remarks: Remarks) -> list[Camera]:
    """A camera in the world; none if it is orthographic. glTF's cameras are OpenGL's."""
    if (lens := camera.perspective) is None:
        remarks.approximate(_name(camera), "is an orthographic camera, which is left out")
        return []
    matrix = np.eye(4)
    axes = matrix[:3, :3] = world[:3, :3] / np.maximum(np.linalg.norm(world[:3, :3], axis=0), MIN_SCALE)
    matrix[:3, 3] = world[:3, 3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > MAX_SKEW or np.linalg.det(axes) < 0:
        remarks.approximate(_name(camera), "is a camera that its node skews, mirrors or flattens, which is left out")
        return []
    focal = 0.5 * FILM / math.tan(lens.yfov / 2)
    return [lens_of(focal, lens.aspect_ratio * FILM, FILM, where=camera.where).camera(matrix)]


def _license_of(root: records.Gltf) -> str | None:
    """The rights in the metadata, as glTF and Sketchfab write them; bad metadata is ignored."""
    said = []
    for extras in (root.asset.extras, root.extras):
        stated, author = (extras.get(key) if isinstance(extras, dict) else None for key in ("license", "author"))
        said += [stated, f"by {author}" if stated and isinstance(author, str) else None]
    return license_line(*said, root.asset.copyright)


def _surfaces(
    file: GltfFile,
    mesh: records.Mesh,
    materials: Materials,
    remarks: Remarks,
    weights: list[float],
    bones: Float[np.ndarray, "joint 4 4"] | None,
) -> Iterator[ForeignObject]:
    """The triangles of a mesh, one surface a primitive, where the mesh itself is, or where the joints of its skin are.

    Args:
        weights: of its morph targets.
    """
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
        _morph(file, primitive, weights, attributes, where=mesh.where)
        if bones is not None:
            _bend(attributes, bones, where=mesh.where)
        faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
        if not len(faces):
            continue
        uv = None
        if use is not None and (raw := attributes.get(f"TEXCOORD_{use.channel}")) is not None:
            uv = wrapped(use.uv_from_file(raw), faces, use.repeats, remarks, where=mesh.name or material.name)
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
    wanted |= {name: "VEC4" for name in primitive.attributes if re.fullmatch(r"(JOINTS|WEIGHTS)_\d{1,2}", name)}
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


def _morph(
    file: GltfFile, primitive: Primitive, weights: list[float], attributes: dict[str, np.ndarray], *, where: str
) -> None:
    """Moves positions and turns normals by the targets whose weights are not 0. Source: glTF 2.0 section 3.7.2.2."""
    for weight, target in zip(weights, primitive.targets):
        for name in ({"POSITION", "NORMAL"} & attributes.keys() & target.keys()) if weight else ():
            moves = file.array(target[name], "VEC3", where=where)
            if len(moves) != len(attributes[name]):
                raise HyalineError(f"{where}: a morph target moves {len(moves)} vertices; expected all of them")
            attributes[name] = attributes[name] + weight * moves


def _bones(file: GltfFile, skin: int, placed: dict[int, Placed]) -> Float[np.ndarray, "joint 4 4"]:
    """world_from_mesh for what is bound to each joint of a skin."""
    described = file.item(file.root.skins, skin, where=f"{file.path}: nodes")
    if lost := [joint for joint in described.joints if joint not in placed]:
        raise HyalineError(f"{described.where}: its joint {lost[0]} is not in the scene; export the file again")
    worlds = np.array([placed[joint][1] for joint in described.joints])
    if described.inverse_bind_matrices is None:
        return worlds
    columns = file.array(described.inverse_bind_matrices, "MAT4", where=described.where)
    if len(columns) < len(worlds):
        raise HyalineError(f"{described.where}: binds {len(columns)} of {len(worlds)} joints; export the file again")
    return worlds @ columns[: len(worlds)].reshape(-1, 4, 4).swapaxes(1, 2)


def _bend(attributes: dict[str, np.ndarray], bones: Float[np.ndarray, "joint 4 4"], *, where: str) -> None:
    """Puts vertices into the world, each by the weighted mean of its joints' matrices. Source: section 3.7.3.3."""
    sets = sorted(name.removeprefix("JOINTS_") for name in attributes if name.startswith("JOINTS_"))
    if not sets or any(f"WEIGHTS_{number}" not in attributes for number in sets):
        raise HyalineError(f"{where}: has a skin, but no joints and weights at its vertices; export the file again")
    joints, weights = (
        np.concatenate([attributes[f"{kind}_{number}"] for number in sets], axis=1) for kind in ("JOINTS", "WEIGHTS")
    )
    joints = joints.astype(np.int64)
    if joints.max(initial=0) >= len(bones) or joints.min(initial=0) < 0:
        raise HyalineError(f"{where}: names joint {joints.max()} of {len(bones)}; export the file again")
    total = weights.sum(axis=1)
    if not (total > 1e-6).all():
        raise HyalineError(f"{where}: has a vertex that no joint holds; export the file again")
    matrices = np.zeros((len(joints), 4, 4))
    for joint, weight in zip(joints.T, (weights / total[:, None]).T, strict=True):
        matrices += weight[:, None, None] * bones[joint]
    linear = matrices[:, :3, :3]
    positions, normals = attributes["POSITION"], attributes.get("NORMAL")
    attributes["POSITION"] = np.einsum("vab,vb->va", linear, positions) + matrices[:, :3, 3]
    if normals is not None:
        # A plane's normal turns by the cofactors, which are also there where a joint flattens.
        x, y, z = np.moveaxis(linear, 2, 0)
        cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=2)
        attributes["NORMAL"] = np.einsum("vab,vb->va", cofactors, normals)


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
