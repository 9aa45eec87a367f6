"""The U-Net of Deferred Neural Rendering: pictures of features in, pictures of colours out."""

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from model.settings.network_parts import UNetNorm

NUM_HALVINGS = 5
"""The network works on pictures whose height and width are multiples of 2 ** NUM_HALVINGS."""

LEAKY_SLOPE = 0.2


class UNet(nn.Module):
    """The five-level U-Net of pix2pix with 4 x 4 kernels and strides of 2; 16,671,107 parameters for 16 inputs.

    Source: Thies et al. 2019 (arXiv 1904.12356), layers as in the first author's public code: the way up alone is
    normalised, neither the innermost nor the outermost layer's input is. `batch` stands for what the transparent
    paper's authors ran: statistics of the batch at hand, at test as well, of one picture at a time.
    """

    def __init__(self, num_inputs: int, *, width: int = 64, norm: UNetNorm = "instance") -> None:
        super().__init__()
        down = [width, 2 * width, 4 * width, 8 * width, 8 * width]
        self.down = nn.ModuleList(
            nn.Conv2d(before, after, 4, stride=2, padding=1) for before, after in zip([num_inputs, *down], down)
        )
        # From the second on, each takes what comes up beside what went down at its height.
        up = [(8 * width, 8 * width), (16 * width, 4 * width), (8 * width, 2 * width), (4 * width, width)]
        self.up = nn.ModuleList(nn.ConvTranspose2d(*pair, 4, stride=2, padding=1) for pair in up)
        self.norms = nn.ModuleList(
            nn.InstanceNorm2d(after) if norm == "instance" else nn.BatchNorm2d(after, track_running_stats=False)
            for _, after in up
        )
        self.last = nn.ConvTranspose2d(2 * width, 3, 4, stride=2, padding=1)

    def forward(self, x: Float32[Tensor, "b c h w"]) -> Float32[Tensor, "b 3 h w"]:
        """Colours in (-1, 1); pictures of any size, padded with zeros below and to the right while they are inside."""
        height, width = x.shape[-2:]
        step = 1 << NUM_HALVINGS
        x = functional.pad(x, (0, -width % step, 0, -height % step))
        skips = []
        for place, conv in enumerate(self.down):
            x = conv(x if place == 0 else functional.leaky_relu(x, LEAKY_SLOPE))
            skips.append(x)
        x = skips.pop()
        for conv, norm in zip(self.up, self.norms, strict=True):
            x = torch.cat([skips.pop(), norm(conv(functional.relu(x)))], dim=1)
        return torch.tanh(self.last(functional.relu(x)))[..., :height, :width]
