"""Where the meshes of a glTF file are: its tree of nodes, and the instances that they make.

Source: glTF 2.0 sections 3.5 and 3.10, EXT_mesh_gpu_instancing.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import MAX_SKEW
from datagen.data.cameras import Camera as Taken
from datagen.disk.errors import HyalineError
from hyaline_import.foreign import MAX_SURFACES, lens_of, rotation_of
from hyaline_import.gltf.file import GltfFile
from hyaline_import.gltf.records import Camera, Instancing, Node
from hyaline_import.remarks import Remarks

INSTANCING, LAMPS = "EXT_mesh_gpu_instancing", "KHR_lights_punctual"
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
    count = 0
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
            copies = _copies(file, node, world_from_node) if node.skin is None else [np.eye(4)]
            for world_from_mesh in copies:
                # Scaled to 0 along two axes or more. Source: glTF 2.0 section 3.5.3.
                if np.linalg.svd(world_from_mesh[:3, :3], compute_uv=False)[1] < MIN_SCALE:
                    remarks.note(_name(node), "is scaled to nothing, which hides it; left out")
                    continue
                count += 1
                if count > MAX_SURFACES:
                    raise HyalineError(f"{file.path}: places more than {MAX_SURFACES:,} meshes; expected fewer")
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
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    parts = (np.array([part], np.float64) for part in (node.translation, node.rotation, node.scale))
    return _matrices(*parts, where=node.where)[0]


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


def _copies(file: GltfFile, node: Node, world_from_node: Float[np.ndarray, "4 4"]) -> list[np.ndarray]:
    """One place, or those of EXT_mesh_gpu_instancing."""
    if INSTANCING not in node.extensions:
        return [world_from_node]
    instancing = node.extension(INSTANCING, Instancing)
    kinds = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
    given = {name: index for name, index in instancing.attributes.items() if name in kinds}
    counts = {file.count(index, where=node.where) for index in given.values()}
    if len(counts) != 1 or max(counts) > MAX_SURFACES:
        raise HyalineError(f"{node.where}: places {sorted(counts)} instances; expected one number up to {MAX_SURFACES}")
    count = counts.pop()
    values = {name: file.array(index, kinds[name], where=node.where) for name, index in given.items()}
    placed = _matrices(
        values.get("TRANSLATION", np.zeros((count, 3))),
        values.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))),
        values.get("SCALE", np.ones((count, 3))),
        where=node.where,
    )
    return [world_from_node @ local for local in placed]
