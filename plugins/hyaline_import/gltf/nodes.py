"""Where the meshes of a glTF file are, by its tree of nodes, and their shapes, by morph targets and skins.

Source: glTF 2.0 sections 3.5, 3.7 and 3.10.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import MAX_SKEW
from datagen.data.cameras import Camera as Taken
from datagen.disk.errors import HyalineError
from hyaline_import.foreign import lens_of, rotation_of
from hyaline_import.gltf.file import GltfFile
from hyaline_import.gltf.records import Camera, Node
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
