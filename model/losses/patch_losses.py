"""The losses of a run: the method's own, plus perceptual and adversarial terms on patches, and in-painting.

In-painting: on poses without ground truth, texels that no training ray visits learn to look real. Source: the paper's
proposal for surfaces never seen in training (section 6), with the discriminator on views without ground truth from
DeepVoxels.
"""

import dataclasses
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from datagen.data.cameras import Cameras, look_at
from datagen.data.config import Resolution
from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.disk.errors import HyalineError
from datagen.disk.storage import read_regular, sha256
from model.batches.layers import trace_layers
from model.batches.rays import PixelSource, RayBatch, draw_patches, take_colors
from model.losses.pixel_losses import PatchTerms
from model.nets.texture import NeuralTextures, bilinear_taps
from model.settings import LossConfig, VggKind
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


VGG: dict[VggKind, tuple[int, ...]] = {
    "vgg16": (64, 64, 0, 128, 128, 0, 256, 256, 256),
    "vgg19": (64, 64, 0, 128, 128, 0, 256, 256, 256, 256),
}
"""Channels of the convolutions in the first three stages, and 0 for a pooling that halves the picture. The last
activation of each stage is compared: relu1_2, relu2_2, relu3_3 (relu3_4 of VGG19). Source: Simonyan and Zisserman 2015,
columns D and E."""

WEIGHT_FILES: dict[VggKind, str] = {"vgg16": "vgg16-397923af.pth", "vgg19": "vgg19-dcbb9e9d.pth"}
"""torchvision's names of the weights trained on ImageNet; they end with the first digits of their SHA-256."""

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def find_vgg(config: LossConfig) -> LossConfig:
    """The configuration with the digest of its file of weights; nothing is ever downloaded."""
    if not config.has_vgg or config.vgg_weights == "random":
        return config
    kind, path = config.vgg, vgg_path(config.vgg, config.vgg_weights)
    if not path.is_file():
        raise HyalineError(
            f"{path}: no {kind.upper()} weights; put torchvision's {WEIGHT_FILES[kind]} there, or set --vgg-weights to "
            f"its path, random (a stand-in) or none"
        )
    digest = sha256(read_regular(path))
    if config.vgg_weights == "auto" and not digest.startswith(path.stem.partition("-")[2]):
        raise HyalineError(f"{path}: damaged, its SHA-256 is {digest[:8]}...; put {WEIGHT_FILES[kind]} there again")
    return dataclasses.replace(config, vgg_sha256=digest)


def vgg_path(kind: VggKind, weights: str) -> Path:
    """The file of weights that are not random."""
    return Path(torch.hub.get_dir()) / "checkpoints" / WEIGHT_FILES[kind] if weights == "auto" else Path(weights)


def vgg_layers(kind: VggKind) -> nn.Sequential:
    """The compared stages of VGG, of random weights; layer i is `features.i` of torchvision's files."""
    layers: list[nn.Module] = []
    num_inputs = 3
    for channels in VGG[kind]:
        layers += [nn.Conv2d(num_inputs, channels, 3, padding=1), nn.ReLU()] if channels else [nn.MaxPool2d(2)]
        num_inputs = channels or num_inputs
    return nn.Sequential(*layers)


class PerceptualLoss(nn.Module):
    """The distance between VGG features of pictures and ground truth; it has no learned parameters.

    The mean over the compared layers of their mean absolute differences, each divided by the layer's standard deviation
    on a fixed picture, so that layers have equal weight whatever the scale of their weights. Pictures are normalised
    like ImageNet's, unlike in the authors' code. Random weights (Kaiming, fixed seed) are a stand-in: Liu et al., CVPR
    2021 (arXiv 2103.10571), find that structure matters more than training in such losses.
    """

    mean: Tensor
    std: Tensor
    scales: Tensor

    def __init__(self, kind: VggKind, weights: str) -> None:
        """Raises a HyalineError where the file of weights cannot be read, or is of another network."""
        super().__init__()
        self.features = vgg_layers(kind)
        if weights == "random":
            generator = torch.Generator().manual_seed(0)
            for module in self.features:
                if isinstance(module, nn.Conv2d):
                    nn.init.kaiming_normal_(module.weight, nonlinearity="relu", generator=generator)
                    nn.init.zeros_(module.bias)  # pyright: ignore[reportArgumentType]
        else:
            _load_features(self.features, vgg_path(kind, weights))
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
        raise HyalineError(f"{path}: not the weights of these layers; expected torchvision's file of --vgg") from error


NUM_POSES = 64
"""Number of poses without ground truth for in-painting."""

DISTANCES, HEIGHTS = (0.4, 1.2), (0.1, 1.0)
"""Distance and height over the rig's target, relative to those of random training cameras."""

AIM = 0.25
"""Largest offset of the look-at point from the target, relative to the camera's distance."""


class Inpainter:
    """Renders patches of poses without ground truth; gradients reach only unvisited texels."""

    def __init__(
        self,
        renderer: nn.Module,
        training: PixelSource[RayBatch],
        dataset: Dataset,
        geometry: str,
        *,
        num_layers: int,
        seed: int,
        device: torch.device,
    ) -> None:
        """Counts the texel visits of all training rays, and finds pixels that show an unvisited texel."""
        self.visits = {
            f"{name}.table": count_visits(module, training)
            for name, module in renderer.named_modules()
            if isinstance(module, NeuralTextures)
        }
        cameras = novel_cameras(dataset, NUM_POSES, np.random.default_rng([seed, 1]))
        self.pixels = trace_layers(read_meshes(dataset, geometry), cameras, num_layers).to(device)
        finest = next(module for module in renderer.modules() if isinstance(module, NeuralTextures))
        self.showing = pixels_showing(finest, next(iter(self.visits.values())) == 0, self.pixels).nonzero().flatten()
        if not len(self.showing):
            raise HyalineError(f"{dataset.root}: training rays visit every visible texel; leave out --inpaint")

    def render(self, renderer: nn.Module, number: int, size: int, rng: np.random.Generator) -> Tensor:
        """Colours (patch, row, column, 3) of patches around pixels that show an unvisited texel.

        The network and all visited texels are constants, and batch norm uses its running statistics.
        """
        index = patches_around(
            self.showing[torch.from_numpy(rng.integers(len(self.showing), size=number))], size, self.pixels.resolution
        )
        parameters = {name: value.detach() for name, value in renderer.named_parameters()}
        for name, visits in self.visits.items():
            table = renderer.get_parameter(name)
            parameters[name] = torch.where(visits[:, None] > 0, table.detach(), table)
        renderer.eval()
        colors = functional_call(renderer, parameters, (self.pixels.take(index, None),))
        renderer.train()
        return colors.view(number, size, size, 3)


def count_visits(textures: NeuralTextures, pixels: PixelSource[RayBatch]) -> Int[Tensor, " texel"]:
    """The number of layers on the pixels' centre rays that sample each texel with any weight."""
    counts = torch.zeros(textures.layout.num_texels, dtype=torch.int64, device=pixels.device)
    for _, texels, weights in _look_ups(textures, pixels):
        counts += torch.bincount(texels[weights > 0], minlength=len(counts))
    return counts


def pixels_showing(
    textures: NeuralTextures, wanted: Bool[Tensor, " texel"], pixels: PixelSource[RayBatch]
) -> Bool[Tensor, " pixel"]:
    """The pixels with a layer whose look-up takes at least half of its weight from wanted texels."""
    found = []
    for hit, texels, weights in _look_ups(textures, pixels):
        is_wanted = torch.zeros(hit.shape, dtype=torch.bool, device=hit.device)
        is_wanted[hit] = (weights * wanted[texels]).sum(dim=1) >= 0.5
        found.append(is_wanted.any(dim=1))
    return torch.cat(found)


def _look_ups(textures: NeuralTextures, pixels: PixelSource[RayBatch]) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Chunk by chunk, which layers of the pixels are not empty, and the texels that these look up, with weights."""
    for part in torch.arange(len(pixels.rgb), device=pixels.device).split(pixels.chunk):
        rays = pixels.take(part, None)
        hit = rays.object_id != 0
        yield hit, *bilinear_taps(rays.uv[hit], rays.object_id[hit], textures.layout)


def patches_around(pixel: Int[Tensor, " patch"], size: int, resolution: Resolution) -> Int[Tensor, "patch row column"]:
    """Row numbers of the square patches around these pixels, moved inwards at a view's border."""
    height, width = resolution.shape
    view, row, column = pixel // resolution.pixels, pixel // width % height, pixel % width
    first_row, first_column = (
        (place - size // 2).clamp(0, side - size) for place, side in ((row, height), (column, width))
    )
    steps = torch.arange(size, device=pixel.device)
    rows, columns = first_row[:, None, None] + steps[:, None], first_column[:, None, None] + steps
    return (view[:, None, None] * height + rows) * width + columns


def novel_cameras(dataset: Dataset, number: int, rng: np.random.Generator) -> Cameras:
    """Poses around the training cameras, but nearer, farther and lower; test cameras are not used."""
    from datagen.scene.folder import open_scene  # Not before: training without in-painting needs no scene.

    cameras = dataset.cameras("train")
    target = np.array(open_scene(dataset).cameras.target)
    offset = cameras.world_from_camera[rng.integers(len(cameras.world_from_camera), size=number), :3, 3] - target
    offset = offset * rng.uniform(*DISTANCES, (number, 1))
    offset[:, 2] *= rng.uniform(*HEIGHTS, number)
    aims = target + AIM * np.linalg.norm(offset, axis=1, keepdims=True) * rng.uniform(-1, 1, (number, 3))
    poses = [look_at(position, aim) for position, aim in zip(target + offset, aims, strict=True)]
    return dataclasses.replace(cameras, world_from_camera=np.stack(poses))


class Losses:
    """A method's own loss with the further terms of a configuration, and what these learn."""

    def __init__(
        self,
        config: LossConfig,
        *,
        steps: int,
        seed: int,
        device: torch.device,
        make_inpainter: Callable[[], Inpainter],
    ) -> None:
        """Raises a HyalineError where weights of VGG are not there, or there is nothing to in-paint."""
        self.config = config
        self.first_adversarial_step = round(config.adversarial_from * steps)
        self.perceptual = PerceptualLoss(config.vgg, config.vgg_weights).to(device) if config.has_vgg else None
        self.adversary = (
            Adversary(lr=config.adversarial_lr, seed=seed, device=device) if config.adversarial > 0 else None
        )
        self.inpainter = make_inpainter() if config.inpaint else None

    @property
    def draws_pixels_alone(self) -> bool:
        """True if every step's pixels are a random batch alone, without patches."""
        return self.perceptual is None and self.adversary is None

    def is_adversarial(self, step: int) -> bool:
        return self.adversary is not None and step >= self.first_adversarial_step

    def limit_rate(self, rate: float, step: int) -> float:
        """The learning rate of a step: at most the adversarial one, once that term is used."""
        return min(rate, self.config.adversarial_lr) if self.is_adversarial(step) else rate

    def loss(
        self,
        own: Callable[..., Tensor],
        renderer: nn.Module,
        training: PixelSource,
        batch: int,
        rng: np.random.Generator,
        *,
        step: int,
    ) -> Tensor:
        """The loss of step `step`, where `own` is the renderer's loss; also trains the discriminator."""
        config = self.config
        judge = self.adversary if self.is_adversarial(step) else None
        size = min(config.patch, training.resolution.shorter)

        def of_patches(colors: Tensor, truth: Tensor) -> Tensor:
            total = colors.new_zeros(())
            if self.perceptual is not None:
                total = total + config.perceptual * self.perceptual(colors, truth)
            if judge is not None and self.inpainter is None:
                total = total + config.adversarial * judge.loss(colors, truth)
            return total

        has_terms = self.perceptual is not None or (judge is not None and self.inpainter is None)
        terms = PatchTerms(size=size, number=config.patches, of=of_patches) if has_terms else None
        total = own(training, batch, rng, softness=config.softness, patch_terms=terms)
        if judge is not None and self.inpainter is not None:
            index = draw_patches(training, config.patches, size, rng)
            real = take_colors(training, index.flatten()).view(*index.shape, 3)
            total = total + config.adversarial * judge.loss(
                self.inpainter.render(renderer, config.patches, size, rng), real
            )
        return total

    def state(self) -> State:
        return None if self.adversary is None else self.adversary.state()

    def load_state(self, state: State) -> None:
        if self.adversary is not None:
            self.adversary.load_state(state)
