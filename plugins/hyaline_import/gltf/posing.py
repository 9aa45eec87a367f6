"""The shape of a mesh as a glTF file poses it: morph targets by their weights, and skins on their joints.

Source: glTF 2.0 sections 3.7.2.2 and 3.7.3.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from datagen.disk.errors import HyalineError
from hyaline_import.gltf.file import GltfFile


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
