"""glTF and GLB files: every surface that a viewer would show, where the file's tree of nodes puts it.

Source: glTF 2.0 sections 3.5 to 3.10.
"""

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import MAX_SKEW
from datagen.data.cameras import Camera as Taken
from datagen.data.config import license_line
from datagen.disk.errors import HyalineError
from datagen.disk.records import shown
from hyaline_import.foreign import (
    MAX_SURFACES,
    MAX_TRIANGLES,
    ForeignMaterial,
    ForeignObject,
    ForeignScene,
    elementwise,
    lens_of,
    rotation_of,
)
from hyaline_import.gltf.file import READ_EXTENSIONS, Camera, Gltf, GltfFile, Node, Primitive
from hyaline_import.gltf.materials import TextureUse, read_material, wrapped
from hyaline_import.remarks import Remarks

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

    node: Node
    mesh: int
    weights: tuple[float, ...]
    """The weights of the mesh's morph targets."""
    world_from_mesh: Float[np.ndarray, "4 4"]
    """Not for a mesh with a skin, which its joints place."""


def instances(
    file: GltfFile, cameras: list[Taken], worlds: dict[int, np.ndarray], remarks: Remarks
) -> Iterator[Instance]:
    """Every mesh of the file's scene, once for each place where it is; parents come before children.

    Args:
        cameras: takes those of the scene.
        worlds: takes where each node of the scene is, world_from_node.
    """
    nodes = file.root.nodes
    if len(nodes) > MAX_NODES:
        raise HyalineError(f"{file.path}: has {len(nodes):,} nodes; expected at most {MAX_NODES:,}")
    waiting = [(index, np.eye(4)) for index in reversed(_roots(file))]
    seen: set[int] = set()
    while waiting:
        index, world_from_parent = waiting.pop()
        node = file.item(nodes, index, where=f"{file.path}: nodes")
        if index in seen:
            raise HyalineError(f"{node.where}: is part of a cycle or has two parents; export the file again")
        seen.add(index)
        world_from_node = world_from_parent @ _local(node)
        if not np.abs(world_from_node).max() < MAX_COORDINATE:
            raise HyalineError(f"{node.where}: is larger than can be; export the file again")
        worlds[index] = world_from_node
        if node.mesh is not None:
            mesh = file.item(file.root.meshes, node.mesh, where=node.where)
            weights = mesh.weights if node.weights is None else node.weights
            # A mesh with a skin is where its joints are. Source: glTF 2.0 section 3.7.3.3.
            world_from_mesh = world_from_node if node.skin is None else np.eye(4)
            # Scaled to 0 along two axes or more. Source: glTF 2.0 section 3.5.3.
            if np.linalg.svd(world_from_mesh[:3, :3], compute_uv=False)[1] < MIN_SCALE:
                remarks.note(_name(node), "is scaled to nothing, which hides it; left out")
            else:
                yield Instance(node=node, mesh=node.mesh, weights=weights, world_from_mesh=world_from_mesh)
        if node.camera is not None:
            cameras += _camera(file.item(file.root.cameras, node.camera, where=node.where), world_from_node, remarks)
        if LAMPS in node.extensions:
            remarks.approximate(_name(node), "is a lamp without a size, which is left out")
        waiting += [(child, world_from_node) for child in reversed(node.children)]


def _name(entry: Node | Camera) -> str:
    return entry.name or entry.where.rsplit(" ", 1)[-1]


def _camera(camera: Camera, world: Float[np.ndarray, "4 4"], remarks: Remarks) -> list[Taken]:
    """A camera in the world; none if it is orthographic. glTF's cameras are OpenGL's."""
    if (lens := camera.perspective) is None:
        remarks.approximate(_name(camera), "is an orthographic camera, which is left out")
        return []
    matrix = np.eye(4)
    matrix[:3, :3] = world[:3, :3] / np.maximum(np.linalg.norm(world[:3, :3], axis=0), MIN_SCALE)
    matrix[:3, 3] = world[:3, 3]
    axes = matrix[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > MAX_SKEW or np.linalg.det(axes) < 0:
        remarks.approximate(_name(camera), "is a camera that its node skews, mirrors or flattens, which is left out")
        return []
    focal = 0.5 * FILM / math.tan(lens.yfov / 2)
    return [lens_of(focal, lens.aspect_ratio * FILM, FILM, where=camera.where).camera(matrix)]


def _roots(file: GltfFile) -> list[int]:
    """The top nodes of the file's scene; in a file without scenes, those without a parent."""
    if file.root.scenes:
        return file.item(file.root.scenes, file.root.scene, where=f"{file.path}: scene").nodes
    below = {child for node in file.root.nodes for child in node.children}
    return [index for index in range(len(file.root.nodes)) if index not in below]


def _local(node: Node) -> Float[np.ndarray, "4 4"]:
    """Scale, then turn by a quaternion (x, y, z, w), then move."""
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    rotation = np.array(node.rotation)
    if (length := np.linalg.norm(rotation)) < 1e-9:
        raise HyalineError(f"{node.where}: has a rotation of length 0; export the file again")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of(rotation / length) * node.scale
    matrix[:3, 3] = node.translation
    return matrix


# Poses


def morph(
    file: GltfFile,
    attributes: dict[str, np.ndarray],
    targets: Sequence[Mapping[str, int]],
    weights: Sequence[float],
    *,
    where: str,
) -> None:
    """Moves positions and turns normals by the targets whose weights are not 0."""
    for weight, target in zip(weights, targets):
        for name in attributes.keys() & target.keys() & {"POSITION", "NORMAL"} if weight else ():
            moves = file.array(target[name], "VEC3", where=where)
            if len(moves) != len(attributes[name]):
                raise HyalineError(f"{where}: a morph target differs in length from its mesh; export the file again")
            attributes[name] = attributes[name] + weight * moves


def skin_matrices(file: GltfFile, skin: int, worlds: Mapping[int, np.ndarray]) -> Float[np.ndarray, "joint 4 4"]:
    """world_from_mesh for what is bound to each joint of a skin.

    Args:
        worlds: world_from_node of the scene's nodes.
    """
    described = file.item(file.root.skins, skin, where=f"{file.path}: nodes")
    if lost := [joint for joint in described.joints if joint not in worlds]:
        raise HyalineError(f"{described.where}: its joint {lost[0]} is no node of the scene; export the file again")
    joints = np.array([worlds[joint] for joint in described.joints])
    if described.inverse_bind_matrices is None:
        return joints
    columns = file.array(described.inverse_bind_matrices, "MAT4", where=described.where)
    if len(columns) < len(joints):
        raise HyalineError(f"{described.where}: binds {len(columns)} of {len(joints)} joints; export the file again")
    return joints @ columns[: len(joints)].reshape(-1, 4, 4).swapaxes(1, 2)


def bend(attributes: dict[str, np.ndarray], bones: Float[np.ndarray, "joint 4 4"], *, where: str) -> None:
    """Puts vertices into the world: each by the weighted mean of its joints' matrices."""
    sets = sorted(name[7:] for name in attributes if name.startswith("JOINTS_"))
    if not sets or any(f"WEIGHTS_{number}" not in attributes for number in sets):
        raise HyalineError(f"{where}: has a skin, but no joints and weights at its vertices; export the file again")
    joints = np.concatenate([attributes[f"JOINTS_{number}"] for number in sets], axis=1).astype(np.int64)
    weights = np.concatenate([attributes[f"WEIGHTS_{number}"] for number in sets], axis=1)
    if joints.max(initial=0) >= len(bones) or joints.min(initial=0) < 0:
        raise HyalineError(f"{where}: names joint {joints.max()} of {len(bones)}; export the file again")
    if (weights.sum(axis=1) <= 0).any():
        raise HyalineError(f"{where}: has vertices without weights, which no joint holds; export the file again")
    matrices = np.zeros((len(joints), 4, 4))
    for joint, weight in zip(joints.T, (weights / weights.sum(axis=1, keepdims=True)).T):
        matrices += weight[:, None, None] * bones[joint]
    linear = matrices[:, :3, :3]
    attributes["POSITION"] = np.einsum("vij,vj->vi", linear, attributes["POSITION"]) + matrices[:, :3, 3]
    if "NORMAL" in attributes:
        # By the cofactors: as the inverse's transpose, and where a matrix is flat, too.
        a, b, c = np.moveaxis(linear, 2, 0)
        cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
        attributes["NORMAL"] = np.einsum("vij,vj->vi", cofactors, attributes["NORMAL"])


TRIANGLES = 4
"""Mode of a primitive whose corners make triangles, three by three."""
Materials = dict[int | None, tuple[ForeignMaterial, TextureUse | None]]
Attributes = dict[str, np.ndarray]


def read_gltf(path: Path, remarks: Remarks) -> ForeignScene:
    """The surfaces of a glTF or GLB file."""
    file = GltfFile(path)
    cameras: list[Taken] = []
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
