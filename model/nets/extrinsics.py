"""The renderer's camera inputs: none, the view vector of Eq. 3, or its spherical harmonics."""

import functools

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor, nn
from torch.nn import functional

from datagen.data.dataset import Dataset
from datagen.data.geometries import GeometryKey, geometry_key, read_meshes
from datagen.disk.errors import HyalineError
from model.nets.texture import object_layout, sample
from model.settings import Extrinsics


def bake_position_table(dataset: Dataset, geometry: str, size: int) -> Float32[Tensor, "texel 3"]:
    """The position textures P of all objects, packed as `object_layout((size,) * objects)`: world positions in metres.

    The last table is cached, because training and prediction use the same one: it must not be written to.
    """
    return _bake_position_table(geometry_key(dataset, geometry), size)


@functools.lru_cache(maxsize=1)
def _bake_position_table(key: GeometryKey, size: int) -> Float32[Tensor, "texel 3"]:
    from datagen.scene.atlas import bake_positions

    meshes = read_meshes(key.dataset, key.geometry)
    table = np.concatenate([bake_positions(mesh, size).reshape(-1, 3) for mesh in meshes])
    if not np.isfinite(table).all():
        raise HyalineError(
            f"{key.dataset.root}: a position texture of {key.geometry} is not finite; check its meshes and uv"
        )
    return torch.from_numpy(np.ascontiguousarray(table, np.float32))


def positions_for(
    extrinsics: Extrinsics, dataset: Dataset, geometry: str, size: int
) -> Float32[Tensor, "texel 3"] | None:
    """The table of `bake_position_table`; None for a renderer without camera inputs."""
    return None if extrinsics == "none" else bake_position_table(dataset, geometry, size)


def spherical_harmonics(direction: Float32[Tensor, "*b 3"]) -> Float32[Tensor, "*b 9"]:
    """The first three bands of the real orthonormal spherical harmonics of unit directions.

    Order: 1; y, z, x; xy, yz, 3z^2 - 1, xz, x^2 - y^2.
    """
    x, y, z = direction.unbind(-1)
    bands = [
        torch.full_like(x, 0.28209479177387814),
        0.4886025119029199 * y,
        0.4886025119029199 * z,
        0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        1.0925484305920792 * y * z,
        0.31539156525252005 * (3 * z * z - 1),
        1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    ]
    return torch.stack(bands, dim=-1)


class ExtrinsicInputs(nn.Module):
    """Extra inputs of every layer; zeros where a layer is empty.

    Source: paper Eq. 3 and section 4.6: v = normalize(p_camera - sample(uv | P)), from the surface to the camera. They
    are concatenated, as the text says (the authors' code multiplies SH into nine texture channels).
    """

    positions: Tensor

    def __init__(self, kind: Extrinsics, positions: Float32[Tensor, "texel 3"], *, num_objects: int, size: int) -> None:
        super().__init__()
        self.kind: Extrinsics = kind
        self.layout = object_layout((size,) * num_objects)
        # Not learned, and always baked from the meshes, so not part of a checkpoint.
        self.register_buffer("positions", positions, persistent=False)

    def forward(
        self,
        uv: Float32[Tensor, "ray layer 2"],
        object_id: UInt8[Tensor, "ray layer"],
        p_camera: Float32[Tensor, "ray 3"],
    ) -> Float32[Tensor, "ray layer e"]:
        p_surface = sample([self.positions], uv, object_id, [self.layout], [1.0])
        view = functional.normalize(p_camera[:, None] - p_surface, dim=-1)
        inputs = view if self.kind == "view" else spherical_harmonics(view)
        return inputs * (object_id != 0)[..., None]
