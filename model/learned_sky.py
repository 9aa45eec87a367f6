"""The learned sky: light from outside of the scene, as radiance by direction."""

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from model.texture import FINER_COUNTS, level_scales


class LearnedSky(nn.Module):
    """Latitude-longitude maps, finest first, whose sum makes the radiance of a direction.

    The finest is `height` texels high and twice as wide; the others are halved down to a single colour: directions in
    which no training ray left are filled in from around them, as texels are.
    """

    def __init__(self, height: int) -> None:
        super().__init__()
        # As of the list that they once were: weights of older runs load.
        for level, size in enumerate(_map_sizes(height)):
            self.register_parameter(str(level), nn.Parameter(torch.zeros(3, *size)))

    @property
    def maps(self) -> list[Float32[Tensor, "3 tex_h tex_w"]]:
        """Finest first."""
        return list(self.parameters())

    def forward(self, direction: Float32[Tensor, "exit 3"]) -> Float32[Tensor, "exit 3"]:
        """Radiance from unit directions; whatever for the zero vector, whose throughput is 0."""
        x, y, z = direction.unbind(-1)
        azimuth = torch.atan2(y, x) / torch.pi  # Both from -1 to 1.
        polar = 2 * torch.acos(z.clamp(-1, 1)) / torch.pi - 1
        maps = [_look_up_map(texels, azimuth, polar) for texels in self.maps]
        scales = level_scales(len(maps), FINER_COUNTS)
        return functional.softplus(torch.stack([scale * level for scale, level in zip(scales, maps)]).sum(dim=0))


def _map_sizes(height: int) -> list[tuple[int, int]]:
    """Heights and widths of the maps of the sky: twice as wide as high, then halved down to a single texel."""
    return [*((height >> level, 2 * height >> level) for level in range(height.bit_length())), (1, 1)]


def _look_up_map(
    texels: Float32[Tensor, "3 tex_h tex_w"], azimuth: Float32[Tensor, " exit"], polar: Float32[Tensor, " exit"]
) -> Float32[Tensor, "exit 3"]:
    """Bilinear look-ups in a map that goes once around; both angles run from -1 to 1."""
    # A column of the other end stands beside each end.
    padded = functional.pad(texels[None], (1, 1, 0, 0), mode="circular")
    width = texels.shape[2]
    place = torch.stack([azimuth * width / (width + 2), polar], dim=-1)
    found = functional.grid_sample(padded, place[None, None], padding_mode="border", align_corners=False)
    return found[0, :, 0].T
