"""The adversarial loss: a discriminator of patches, which learns beside the renderer by its own optimiser."""

from typing import cast

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from model.settings.state import State

LEAKY_SLOPE = 0.2


class PatchDiscriminator(nn.Sequential):
    """pix2pix's PatchGAN: each of its outputs judges 70 x 70 pixels; 2,764,737 parameters.

    Source: Isola et al. 2017; instance norm, so that what it says of a patch does not hang on the others. It sees
    colours alone, so it can judge patches that have no truth. (The authors' code shows it uv and object ids, too.)
    """

    def __init__(self, *, width: int = 64) -> None:
        layers: list[nn.Module] = [nn.Conv2d(3, width, 4, stride=2, padding=1), nn.LeakyReLU(LEAKY_SLOPE)]
        for factor, stride in ((2, 2), (4, 2), (8, 1)):
            layers += [
                nn.Conv2d(width * max(1, factor // 2), width * factor, 4, stride=stride, padding=1),
                nn.InstanceNorm2d(width * factor),
                nn.LeakyReLU(LEAKY_SLOPE),
            ]
        layers.append(nn.Conv2d(width * 8, 1, 4, padding=1))
        super().__init__(*layers)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, std=0.02)

    def judge(self, pictures: Float32[Tensor, "b h w 3"]) -> Float32[Tensor, "b 1 h_out w_out"]:
        """Logits, high where patches of sRGB pictures in [0, 1] look real."""
        return self(2 * pictures.permute(0, 3, 1, 2) - 1)


class Adversary:
    """A discriminator with its optimiser. What it has learned is part of a checkpoint."""

    def __init__(self, *, lr: float, seed: int, device: torch.device, width: int = 64) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.discriminator = PatchDiscriminator(width=width).to(device)
        self.optimizer = torch.optim.Adam(self.discriminator.parameters(), lr=lr, betas=(0.5, 0.999))

    def loss(self, fake: Float32[Tensor, "b h w 3"], real: Float32[Tensor, "b h w 3"]) -> Float32[Tensor, ""]:
        """Teaches the discriminator one step, then says how far the fakes are from passing: -log D(fake)."""
        self.discriminator.requires_grad_(True)
        doubts = _entropy(self.discriminator.judge(real), 1.0) + _entropy(self.discriminator.judge(fake.detach()), 0.0)
        self.optimizer.zero_grad(set_to_none=True)
        (0.5 * doubts).backward()
        self.optimizer.step()
        self.discriminator.requires_grad_(False)
        return _entropy(self.discriminator.judge(fake), 1.0)

    def state(self) -> State:
        return {
            "discriminator": cast(State, dict(self.discriminator.state_dict())),
            "optimizer": cast(State, self.optimizer.state_dict()),
        }

    def load_state(self, state: State) -> None:
        stored = cast(dict[str, dict[str, Tensor]], state)
        self.discriminator.load_state_dict(stored["discriminator"])
        self.optimizer.load_state_dict(stored["optimizer"])


def _entropy(logits: Tensor, label: float) -> Tensor:
    return functional.binary_cross_entropy_with_logits(logits, torch.full_like(logits, label))
