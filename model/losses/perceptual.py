"""The perceptual loss: differences of VGG features, and where their weights come from."""

import dataclasses
import pickle
import zipfile
from pathlib import Path

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

from datagen.disk.errors import HyalineError
from datagen.disk.storage import sha256_file
from model.settings.losses import LossConfig
from model.settings.network_parts import VggKind

CONVOLUTIONS: dict[VggKind, tuple[int, ...]] = {"vgg16": (2, 2, 3, 3, 3), "vgg19": (2, 2, 4, 4, 4)}
"""Of each stage; a pooling that halves the picture follows each. Source: Simonyan and Zisserman 2015, columns D, E."""

CHANNELS = (64, 128, 256, 512, 512)

COMPARED_STAGES = 3
"""The last activation of each of the first three stages is compared: relu1_2, relu2_2, relu3_3 (relu3_4 of VGG19)."""

WEIGHT_FILES: dict[VggKind, str] = {"vgg16": "vgg16-397923af.pth", "vgg19": "vgg19-dcbb9e9d.pth"}
"""torchvision's names of the weights trained on ImageNet; the end is how their SHA-256 begins."""

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def find_vgg(config: LossConfig) -> LossConfig:
    """The configuration with the digest of the file that its weights are read from; nothing is ever downloaded.

    Raises:
        HyalineError: the file is not there; the line says where it belongs.
    """
    if not config.has_vgg or config.vgg_weights == "random":
        return config
    kind, path = config.vgg, vgg_path(config.vgg, config.vgg_weights)
    if not path.is_file():
        raise HyalineError(
            f"{path}: no {kind.upper()} weights; put torchvision's {WEIGHT_FILES[kind]} there, or give --vgg-weights "
            f"the path of one, random (a stand-in) or none"
        )
    digest = sha256_file(path)
    if config.vgg_weights == "auto" and not digest.startswith(path.stem.partition("-")[2]):
        raise HyalineError(f"{path}: damaged, its SHA-256 is {digest[:8]}...; put {WEIGHT_FILES[kind]} there again")
    return dataclasses.replace(config, vgg_sha256=digest)


def vgg_path(kind: VggKind, weights: str) -> Path:
    """The file of weights that are not random."""
    return Path(torch.hub.get_dir()) / "checkpoints" / WEIGHT_FILES[kind] if weights == "auto" else Path(weights)


def vgg_layers(kind: VggKind, *, stages: int = len(CHANNELS)) -> nn.Sequential:
    """The convolutional stages of VGG, of random weights; layer i is `features.i` of torchvision's files."""
    layers: list[nn.Module] = []
    num_inputs = 3
    for count, channels in zip(CONVOLUTIONS[kind][:stages], CHANNELS):
        for _ in range(count):
            layers += [nn.Conv2d(num_inputs, channels, 3, padding=1), nn.ReLU()]
            num_inputs = channels
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers)


class PerceptualLoss(nn.Module):
    """How far the VGG features of pictures are from those of the truth; nothing in it is learned.

    The mean over the compared layers of their mean absolute differences, each divided by the layer's standard deviation
    on a fixed picture: so layers count alike, whatever the scale of the weights. Pictures are normalised as ImageNet's,
    which the authors' code does not do. Random weights (Kaiming, of a fixed seed) are a stand-in: Liu et al., CVPR 2021
    (arXiv 2103.10571) find structure to matter more than training in such losses.
    """

    mean: Tensor
    std: Tensor
    scales: Tensor

    def __init__(self, kind: VggKind, weights: str) -> None:
        """Raises a HyalineError where the file of weights cannot be read, or is of another network."""
        super().__init__()
        self.features = vgg_layers(kind, stages=COMPARED_STAGES)
        if weights == "random":
            generator = torch.Generator().manual_seed(0)
            for module in self.features:
                if isinstance(module, nn.Conv2d):
                    nn.init.kaiming_normal_(module.weight, nonlinearity="relu", generator=generator)
                    nn.init.zeros_(module.bias)  # pyright: ignore[reportArgumentType]
        else:
            self.features.load_state_dict(_read_features(vgg_path(kind, weights), self.features))
        self.requires_grad_(False)
        self.compared = [
            sum(2 * count + 1 for count in CONVOLUTIONS[kind][: stage + 1]) - 2 for stage in range(COMPARED_STAGES)
        ]
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1))
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1))
        noise = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
        picture = functional.interpolate(noise, size=(64, 64), mode="bilinear")
        self.register_buffer("scales", torch.stack([layer.std() for layer in self.compare_layers(picture)]))

    def compare_layers(self, pictures: Float32[Tensor, "b 3 h w"]) -> list[Tensor]:
        """The compared activations of sRGB pictures in [0, 1], shallow first."""
        x, found = (pictures - self.mean) / self.std, []
        for place, layer in enumerate(self.features):
            x = layer(x)
            if place in self.compared:
                found.append(x)
        return found

    def forward(self, pred: Float32[Tensor, "b h w 3"], target: Float32[Tensor, "b h w 3"]) -> Float32[Tensor, ""]:
        with torch.no_grad():
            wanted = self.compare_layers(target.permute(0, 3, 1, 2))
        found = self.compare_layers(pred.permute(0, 3, 1, 2))
        differences = [(a - b).abs().mean() for a, b in zip(found, wanted, strict=True)]
        return (torch.stack(differences) / self.scales).mean()


def _read_features(path: Path, features: nn.Sequential) -> dict[str, Tensor]:
    """The convolutional weights of torchvision's file that these layers need; no other key is looked at."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, ValueError, KeyError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        raise HyalineError(f"{path}: torch cannot read it; expected torchvision's weights of VGG") from error
    found = {}
    for name, value in features.state_dict().items():
        stored = content.get(f"features.{name}") if isinstance(content, dict) else None
        if not isinstance(stored, Tensor) or stored.shape != value.shape:
            has = list(stored.shape) if isinstance(stored, Tensor) else "missing"
            raise HyalineError(
                f"{path}: features.{name} is {has}; expected {list(value.shape)}, as torchvision's VGG files have it"
            )
        found[name] = stored
    return found
