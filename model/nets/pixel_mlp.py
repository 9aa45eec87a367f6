"""The paper's renderer network: a residual MLP that turns one pixel's stacked layers into its colour, and its camera
inputs: none, the view vector of Eq. 3, or its spherical harmonics."""

import functools
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_linear_bn_weights

from datagen.data.dataset import Dataset
from datagen.data.geometries import GeometryKey, geometry_key, read_meshes
from datagen.disk.errors import HyalineError
from model.nets.texture import object_layout, sample
from model.settings import Extrinsics, Norm, check_width

LEAKY_SLOPE = 0.2


class LinearUnit(nn.Module):
    """Linear layer, batch norm, LeakyReLU."""

    def __init__(self, num_inputs: int, num_outputs: int, norm: Norm) -> None:
        super().__init__()
        self.linear = nn.Linear(num_inputs, num_outputs)
        self.norm = nn.BatchNorm1d(num_outputs) if norm == "batch" else nn.Identity()
        self.activation = nn.LeakyReLU(LEAKY_SLOPE, inplace=True)

    def forward(self, x: Float[Tensor, "ray c_in"]) -> Float[Tensor, "ray c_out"]:
        return self.activation(self.norm(self.linear(x)))

    def folded(self) -> tuple[Tensor, Tensor]:
        """Weight (c_out, c_in) and bias (c_out) of the linear layer with the batch norm, as it is at evaluation."""
        norm = self.norm
        if not isinstance(norm, nn.BatchNorm1d):
            return self.linear.weight, self.linear.bias
        assert norm.running_mean is not None
        assert norm.running_var is not None
        return fuse_linear_bn_weights(
            self.linear.weight, self.linear.bias, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
        )


class ResidualBlock(nn.Module):
    """Two units whose input is added to their output, then a unit that halves the channels."""

    def __init__(self, width: int, norm: Norm) -> None:
        super().__init__()
        self.first = LinearUnit(width, width, norm)
        self.second = LinearUnit(width, width, norm)
        self.halve = LinearUnit(width, width // 2, norm)

    def forward(self, x: Float[Tensor, "ray c"]) -> Float[Tensor, "ray c_half"]:
        return self.halve(x + self.second(self.first(x)))


class PixelMlp(nn.Module):
    """Colours of pixels from their stacked layers.

    Source: paper section 4.3. Its "256 hidden units" and its "34k parameters" exclude each other; `width` decides:
    `width_for_34k` or 256. At evaluation batch norm uses its running statistics (the authors' test script left their
    dropout on). The output has no activation: clip it to [0, 1] for display.
    """

    def __init__(self, num_inputs: int, *, width: int, blocks: int, norm: Norm) -> None:
        super().__init__()
        check_width(width, blocks)
        self.first = LinearUnit(num_inputs, width, norm)
        self.blocks = nn.Sequential(*(ResidualBlock(width >> index, norm) for index in range(blocks)))
        self.last = nn.Linear(width >> blocks, 3)
        # Start at mid-grey: from zero, Adam would move only 0.001 per step towards the mean colour.
        nn.init.constant_(self.last.bias, 0.5)

    def forward(self, x: Float32[Tensor, "ray c"]) -> Float32[Tensor, "ray 3"]:
        """sRGB colours, about [0, 1], of the inputs of all layers, nearest first."""
        return self.last(self.blocks(self.first(x)))

    def residual_blocks(self) -> list[ResidualBlock]:
        """The blocks in their order."""
        return cast(list[ResidualBlock], list(self.blocks))

    def folded(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and biases of all layers at evaluation, in their order."""
        units = [self.first]
        for block in self.residual_blocks():
            units += [block.first, block.second, block.halve]
        return [*(unit.folded() for unit in units), (self.last.weight, self.last.bias)]


@functools.cache
def width_for_34k(num_inputs: int) -> int:
    """The hidden width that brings a network of three blocks closest to the 34,000 parameters of paper section 4.3."""
    return min(range(8, 385, 8), key=lambda width: abs(count_parameters(num_inputs, width, 3) - 34_000))


def count_parameters(num_inputs: int, width: int, blocks: int, norm: Norm = "batch") -> int:
    """Learned numbers of a `PixelMlp`, without building it on a real device."""
    with torch.device("meta"):
        net = PixelMlp(num_inputs, width=width, blocks=blocks, norm=norm)
    return sum(parameter.numel() for parameter in net.parameters())


def bake_position_table(dataset: Dataset, geometry: str, size: int) -> Float32[Tensor, "texel 3"]:
    """The position textures P of all objects, packed as `object_layout((size,) * objects)`: world positions in metres.

    The last table is cached, because training and prediction use the same one: it must not be written to.
    """
    return _bake_position_table(geometry_key(dataset, geometry), size)


def positions_for(
    extrinsics: Extrinsics, dataset: Dataset, geometry: str, size: int
) -> Float32[Tensor, "texel 3"] | None:
    """The table of `bake_position_table`; None for a renderer without camera inputs."""
    return None if extrinsics == "none" else bake_position_table(dataset, geometry, size)


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
