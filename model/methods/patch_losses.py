"""The losses of a run: the method's own, plus perceptual and adversarial terms on patches."""

import dataclasses
import pickle
from pathlib import Path
from typing import cast
from zipfile import BadZipFile

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from datagen.disk.errors import HyalineError
from datagen.disk.storage import read_regular, sha256
from model.methods.renderer import PatchTerms
from model.settings import FETCH, WEIGHT_FILE, LossConfig, vgg_path
from model.state import State

LEAKY_SLOPE = 0.2


class PatchDiscriminator(nn.Sequential):
    """pix2pix's PatchGAN: each of its outputs judges 70 x 70 pixels; 2,764,737 parameters.

    Source: Isola et al. 2017; instance norm, so that a patch's score does not depend on the others. It only sees
    colours, so it can judge patches without ground truth. (The authors' code also feeds it uv and object ids.)
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
    """A discriminator with its optimiser; their state is part of a checkpoint."""

    def __init__(self, *, lr: float, seed: int, device: torch.device, width: int = 64) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.discriminator = PatchDiscriminator(width=width).to(device)
        self.optimizer = torch.optim.Adam(self.discriminator.parameters(), lr=lr, betas=(0.5, 0.999))

    def loss(self, fake: Float32[Tensor, "b h w 3"], real: Float32[Tensor, "b h w 3"]) -> Float32[Tensor, ""]:
        """Trains the discriminator for one step, then returns the generator loss -log D(fake)."""
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


VGG = (64, 64, 0, 128, 128, 0, 256, 256, 256)
"""Channels of VGG16's convolutions in the first three stages, and 0 for a pooling that halves the picture. The last
activation of each stage is compared: relu1_2, relu2_2, relu3_3. Source: Simonyan and Zisserman 2015, column D."""

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def find_vgg(config: LossConfig) -> LossConfig:
    """The configuration with the digest of its file of weights; nothing is ever downloaded."""
    if not config.has_vgg or config.vgg_weights == "random":
        return config
    path = vgg_path(config.vgg_weights)
    if not path.is_file():
        raise HyalineError(f"{path}: no VGG16 weights; {FETCH}, or set --vgg-weights to random (a stand-in) or none")
    digest = sha256(read_regular(path))
    if config.vgg_weights == "imagenet" and not digest.startswith(path.stem.partition("-")[2]):
        raise HyalineError(f"{path}: damaged, its SHA-256 is {digest[:8]}...; put {WEIGHT_FILE} there again")
    return dataclasses.replace(config, vgg_sha256=digest)


def vgg_layers() -> nn.Sequential:
    """The compared stages of VGG16, of random weights; layer i is `features.i` of torchvision's file."""
    layers: list[nn.Module] = []
    num_inputs = 3
    for channels in VGG:
        layers += [nn.Conv2d(num_inputs, channels, 3, padding=1), nn.ReLU()] if channels else [nn.MaxPool2d(2)]
        num_inputs = channels or num_inputs
    return nn.Sequential(*layers)


class PerceptualLoss(nn.Module):
    """The distance between VGG features of pictures and ground truth; it has no learned parameters.

    The mean over the compared layers of their mean absolute differences, each divided by the layer's standard deviation
    on a fixed picture. Pictures are normalised like ImageNet's, unlike in the authors' code. Random weights (Kaiming,
    fixed seed) are a stand-in; source: Liu et al., CVPR 2021 (arXiv 2103.10571).
    """

    mean: Tensor
    std: Tensor
    scales: Tensor

    def __init__(self, weights: str) -> None:
        """Raises a HyalineError where the file of weights cannot be read, or is of another network."""
        super().__init__()
        self.features = vgg_layers()
        if weights == "random":
            generator = torch.Generator().manual_seed(0)
            for module in self.features:
                if isinstance(module, nn.Conv2d):
                    nn.init.kaiming_normal_(module.weight, nonlinearity="relu", generator=generator)
                    nn.init.zeros_(module.bias)  # pyright: ignore[reportArgumentType]
        else:
            _load_features(self.features, vgg_path(weights))
        self.requires_grad_(False)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1))
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1))
        noise = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
        picture = functional.interpolate(noise, size=(64, 64), mode="bilinear")
        self.register_buffer("scales", torch.stack([layer.std() for layer in self.compare_layers(picture)]))

    def compare_layers(self, pictures: Float32[Tensor, "b 3 h w"]) -> list[Tensor]:
        """The compared activations of sRGB pictures in [0, 1], shallow first."""
        x, found = (pictures - self.mean) / self.std, []
        for layer in self.features:
            if isinstance(layer, nn.MaxPool2d):
                found.append(x)
            x = layer(x)
        return [*found, x]

    def forward(self, pred: Float32[Tensor, "b h w 3"], target: Float32[Tensor, "b h w 3"]) -> Float32[Tensor, ""]:
        with torch.no_grad():
            wanted = self.compare_layers(target.permute(0, 3, 1, 2))
        found = self.compare_layers(pred.permute(0, 3, 1, 2))
        differences = [(a - b).abs().mean() for a, b in zip(found, wanted, strict=True)]
        return (torch.stack(differences) / self.scales).mean()


def _load_features(features: nn.Sequential, path: Path) -> None:
    """Reads the weights that these layers need from torchvision's file; no other key is looked at."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        features.load_state_dict({name: content[f"features.{name}"] for name in features.state_dict()})
    except (RuntimeError, ValueError, TypeError, LookupError, EOFError, pickle.UnpicklingError, BadZipFile) as error:
        raise HyalineError(f"{path}: not the weights of these layers; expected torchvision's {WEIGHT_FILE}") from error


class Losses:
    """The terms of a run besides the method's own loss, and what these learn."""

    def __init__(self, config: LossConfig, *, steps: int, seed: int, device: torch.device) -> None:
        """Raises a HyalineError where weights of VGG are not there."""
        self.config = config
        self.first_adversarial_step = round(config.adversarial_from * steps)
        self.perceptual = PerceptualLoss(config.vgg_weights).to(device) if config.has_vgg else None
        self.adversary = (
            Adversary(lr=config.adversarial_lr, seed=seed, device=device) if config.adversarial > 0 else None
        )

    @property
    def draws_pixels_alone(self) -> bool:
        """True if every step's pixels are a random batch alone, without patches."""
        return self.perceptual is None and self.adversary is None

    def is_adversarial(self, step: int) -> bool:
        return self.adversary is not None and step >= self.first_adversarial_step

    def limit_rate(self, rate: float, step: int) -> float:
        """The learning rate of a step: at most the adversarial one, once that term is used."""
        return min(rate, self.config.adversarial_lr) if self.is_adversarial(step) else rate

    def patch_terms(self, step: int, shorter: int) -> PatchTerms | None:
        """The terms of a step, which also train the discriminator; None if it has none.

        Args:
            shorter: side of the pictures in pixels, which limits that of patches.
        """
        config, perceptual = self.config, self.perceptual
        judge = self.adversary if self.is_adversarial(step) else None
        if perceptual is None and judge is None:
            return None

        def of_patches(colors: Tensor, truth: Tensor) -> Tensor:
            total = colors.new_zeros(())
            if perceptual is not None:
                total = total + config.perceptual * perceptual(colors, truth)
            if judge is not None:
                total = total + config.adversarial * judge.loss(colors, truth)
            return total

        return PatchTerms(size=min(config.patch, shorter), number=config.patches, of=of_patches)

    def state(self) -> State:
        return None if self.adversary is None else self.adversary.state()

    def load_state(self, state: State) -> None:
        if self.adversary is not None:
            self.adversary.load_state(state)
