"""Owns what a user of `model train` may choose: one frozen record for each method, and the names of run folders.

Each field of a method's record is a flag that this method has, and no other. Torch is not imported here, so that
`--help` answers at once; how choices become a configuration stands beside the method (`configure_...`).
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from model.settings.paper_presets import DEFAULT_STEPS, PAPER_PRESETS


def _choice(default: object, suffix: str | dict[object, str]) -> Any:
    """A field whose `suffix` marks run folders where it is not the default: a template, or one for each value (and
    under the empty one that of all others)."""
    return field(default=default, metadata={"suffix": suffix})


@dataclass(frozen=True, kw_only=True)
class CommonChoices:
    """What every method can be told."""

    method: str
    """What to train: paper (straight layers, stacked), mlp-first (its network on the first layer), dnr (a U-Net on the
    first layer), dnr-layers (a U-Net on all layers), authors-code (what the released code ran), light-path (refracted
    paths, composited), or deepvoxels (a grid of learned features, from cameras alone). Each method has choices of its
    own: `model train --method NAME --help`."""
    dataset: str | None = None
    """Dataset folder, or its name under data/. Default: the only one there."""
    geometry: str = TRUTH
    """Whose layers to look up: truth, or a kind of proxy such as box."""
    out: Path | None = None
    """Folder of the run. Default: runs/SCENE/METHOD, with a suffix for each choice that is not the default."""
    name: str | None = None
    """Label of the run in tables. Default: from the folder's name."""
    steps: int | None = None
    """Optimiser steps; more for larger datasets. Default: 2500; 5000 with paper's best preset, each of half as many
    rays."""
    batch: int | None = _choice(None, "batch{}")
    """Random pixels a step, for U-Nets about as many in crops. Default: 8192; 16384 for U-Nets, 2048 (of several rays)
    for light-path, 1024 for paper's best preset; for deepvoxels 2 pictures."""
    updates: int | None = _choice(None, "{}-updates")
    """Updates of the weights a step, each by an equal share of its batch. Default: 1; 4 for light-path."""
    lr: float | None = _choice(None, "lr{}")
    """Learning rate of Adam. Default: 0.001; 0.002 for light-path, 0.003 for paper's best preset, for deepvoxels what
    --voxels says."""
    texture_lr: float | None = _choice(None, "texture-lr{}")
    """Learning rate of the textures. Default: the same; 0.04 for light-path, 0.02 for paper's best
    preset."""
    lr_decay: Literal["none", "linear", "cosine"] | None = _choice(None, {"none": "no-decay", "": "{}-decay"})
    """none, linear (constant, then down to 0 over the second half) or cosine. Default: linear; cosine for
    light-path and for paper's best preset, none for deepvoxels, but linear with `--voxels small`."""
    seed: int = 0
    """Seed of everything random."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes a GPU where there is one."""
    memory: Literal["auto", "ram", "mapped"] = "auto"
    """Where training data from stored layers is held: ram, or mapped, in files under ~/.cache/hyaline (or
    $XDG_CACHE_HOME) of which each step reads what it needs, so that a dataset may be larger than memory. The results
    are the same, bit by bit. auto maps what does not fit, and says so. The files may be deleted at any time."""
    overwrite: bool = False
    """Delete the run that is there and start anew."""


@dataclass(frozen=True, kw_only=True)
class LossChoices:
    """What is made small besides the difference of each pixel."""

    vgg_weights: str = _choice("none", {"random": "random-vgg", "auto": "vgg", "": "vgg"})
    """Weights of the network of a perceptual loss (section 4.4): none, auto (looks in torch's cache, downloads
    nothing), a path, or random (a stand-in, and called that in tables)."""
    vgg: Literal["vgg16", "vgg19"] = _choice("vgg16", "{}")
    """Which network that is."""
    perceptual: float | None = _choice(None, "perceptual{}")
    """Weight of the perceptual loss; that of each pixel's difference is 1. Default: 0.05."""
    adversarial: float = _choice(0.0, "adversarial{}")
    """Weight of the loss before a 70 x 70 PatchGAN, such as 0.01; 0: there is none."""
    adversarial_from: float = _choice(0.6, "from{}")
    """Share of the steps after which it begins; from then on no learning rate is above 0.0004."""
    inpaint: bool = _choice(False, "inpaint")
    """Let the discriminator judge poses without truth instead, where only texels never seen in training learn."""
    patch: int = _choice(64, "patch{}")
    """Height and width in pixels of the patches that these losses look at."""


@dataclass(frozen=True, kw_only=True)
class PaperChoices:
    """What `paper` and `mlp-first` are made of."""

    preset: Literal["published", "best"] = _choice("published", {"best": "best"})
    """published: the renderer of the paper's text. best: the same idea (straight layers, neural textures, a network
    for each pixel) with everything that was found to help it. Flags that are given override the preset's values, which
    are listed in model/settings/paper_presets.py."""
    extrinsics: Literal["none", "view", "sh"] = _choice("view", {"none": "no-extrinsics", "sh": "sh"})
    """What each layer is told of the camera: nothing, the view vector, or three bands of SH of it."""
    width: str | None = _choice(None, "w{}")
    """Hidden units of the first layer: 34k (as many as make 34,000 parameters), 256, or any number. Default: 34k; 128
    of the best preset."""
    blocks: int = _choice(3, "{}-blocks")
    """Residual blocks; each halves the channels."""
    norm: Literal["batch", "none"] | None = _choice(None, {"none": "no-norm", "batch": "batch-norm"})
    """Batch norm after each linear layer (the paper's text) or none (the authors' code). Default: batch; none with the
    best preset."""
    textures: Literal["object", "scene"] = _choice("object", "scene-texture")
    """A neural texture for each object, or one for the whole scene."""
    texture_size: int | None = _choice(None, "t{}")
    """Width and height of a texture in texels. Default: half the image's width; all of it with the best preset."""
    zero_layer: bool = _choice(False, "zero-layer")
    """Insert a layer of zeros at a random place while training (section 4.4)."""
    layers: str | None = _choice(None, "{}-layers")
    """Straight layers that are looked up: a number (the nearest ones), online (traced anew for each batch, through a
    random place of each pixel; no stored layer is read) or both, such as online-4. Default: all that are stored."""
    rays: int | None = _choice(None, "{}-rays")
    """Rays per pixel while training, a square number. Default: 1; 4 with the best preset."""
    render_rays: int | None = _choice(None, "{}-render-rays")
    """Rays per pixel while rendering, a square number. Default: 1; 16 with the best preset."""
    features: int = _choice(16, "{}-features")
    """Channels of a texture; 64 in the paper's runs on coarse proxies."""
    texture_levels: int | None = _choice(None, "{}-levels")
    """Textures summed, each half as wide as the one before; 4 in Deferred Neural Rendering. Default: 1; 5 with the best
    preset."""
    precision: Literal["fp32", "bf16"] = _choice("fp32", {"bf16": "bf16"})
    """Numbers that the network multiplies: bf16 is faster where the processor has instructions for it."""
    loss: LossChoices = LossChoices()


@dataclass(frozen=True, kw_only=True)
class LightPathChoices:
    """What `light-path` is made of."""

    texture_size: int | None = _choice(None, "t{}")
    """Width and height of a texture in texels; as many texels are shared among the objects by how much is seen of
    each. Default: the image's width."""
    rays: int | None = _choice(None, "{}-rays")
    """Rays per pixel while training, a square number. Default: 4."""
    render_rays: int | None = _choice(None, "{}-render-rays")
    """Rays per pixel while rendering, a square number. Default: 16."""
    refined_rays: int | None = _choice(None, "{}-refined-rays")
    """Rays per pixel while rendering pixels whose rays differ, a square number. Default: 64, or what --render-rays
    says."""
    branches: int = _choice(12, "{}-branches")
    """Branches followed for each ray: refracted, first mirror, then those of most light."""
    compositing: Literal["physics", "stack"] = _choice("physics", "{}")
    """Sum what shines at the ends of branches, weighted by physics; or let the stack network alone make the colour."""
    stack: int | None = _choice(None, "stack{}")
    """Hidden units of the network that sees the stacked vertices and adds what physics leaves out; 0 leaves it out.
    Default: 32, on proxies 96."""
    straight_layers: int | None = _choice(None, "{}-straight")
    """Straight layers that this network sees beside the paths. Default: 0, on proxies 24."""
    shells: int | None = _choice(None, "{}-shells")
    """Copies of each proxy, one inside the other, that straight layers meet. Default: 1, on proxies 4."""
    relief: Literal["on", "off"] | None = _choice(None, {"on": "relief", "off": "no-relief"})
    """Learn how deep below the proxy the true surface lies, and look up colour there. Default: off, on proxies on."""
    environment: int = _choice(32, "sky{}")
    """Height in texels of the finest map of the learned sky; 1 makes it two colours."""
    sky_lobes: int = _choice(12, "{}-lobes")
    """Spherical Gaussians of the learned sky, which lamps are made of. Without effect on a sky of two colours."""
    sky_lr: float = _choice(0.005, "sky-lr{}")
    """Learning rate of the learned sky's maps; its lobes learn 2.5 times as fast."""
    directions: Literal["on", "off"] | None = _choice(None, {"on": "directions", "off": "no-directions"})
    """Tell the decoder the mirrored direction. Default: off, for gloss is traced; on proxies on."""
    debias: float = _choice(0.0, "debias{}")
    """Share, 0 to 1, of what the noise of training rays adds to the loss that is subtracted; these then come in
    independent pairs. At 0 lamps are learned too dim. Not safe in long runs: rough surfaces may ripple."""
    position_octaves: int = _choice(0, "{}-octaves")
    """Octaves of the position that the decoder is told."""
    texture_levels: int = _choice(5, "{}-levels")
    """Textures summed, each half as wide as the one before."""
    loss: LossChoices = LossChoices()


@dataclass(frozen=True, kw_only=True)
class DnrChoices:
    """What `dnr` and `dnr-layers` are made of."""

    preset: Literal["fair", "authors"] = _choice("fair", {"authors": "authors"})
    """Deferred neural rendering as its own authors made it, with 16 features; or weakened as the transparent paper's
    authors ran it: 8 features, one level, the view vector as an input, whole pictures. Other choices count more."""
    unet_width: int = _choice(64, "u{}")
    """Channels of the U-Net's first level; 16 makes it 16 times smaller, for CPUs."""
    features: int | None = _choice(None, "{}-features")
    """Channels of a texture. Default: 16; 8 of the authors' preset."""
    extrinsics: Literal["none", "view", "sh"] | None = _choice(
        None, {"none": "no-extrinsics", "view": "view", "sh": "sh"}
    )
    """What each layer is told of the camera: nothing, the view vector, or nine features multiplied by three bands of SH
    of it. Default: sh; view of the authors' preset."""
    texture_size: int | None = _choice(None, "t{}")
    """Width and height of a texture in texels. Default: half the image's width."""
    texture_levels: int | None = _choice(None, "{}-levels")
    """Textures summed, each half as wide as the one before. Default: 4; 1 of the authors' preset."""
    crop: int | None = _choice(None, "crop{}")
    """Height and width of training crops in pixels; 0: whole pictures. Default: half the image's width; 0 of the
    authors' preset."""
    loss: LossChoices = LossChoices()


@dataclass(frozen=True, kw_only=True)
class AuthorsChoices:
    """What `authors-code` is made of."""

    extrinsics: Literal["none", "view", "sh"] = _choice("view", {"none": "no-extrinsics", "sh": "sh"})
    """What each layer is told of the camera: nothing, the view vector, or nine more features multiplied by SH of it."""
    width: int = _choice(64, "w{}")
    """Hidden units of the first layer: 64, because the code loses the 256 that its scripts ask for."""
    features: int = _choice(16, "{}-features")
    """Channels of a texture; nine more with sh."""
    texture_size: int | None = _choice(None, "t{}")
    """Width and height of a texture in texels. Default: half the image's width."""
    zero_layer: bool = _choice(False, "zero-layer")
    """Insert a layer of zeros at a random place while training."""
    test_dropout: Literal["on", "off"] = _choice("on", "no-test-dropout")
    """Leave dropout on while rendering, as their test script did, or turn it off."""
    loss: LossChoices = LossChoices()


@dataclass(frozen=True, kw_only=True)
class DeepVoxelsChoices:
    """What `deepvoxels` is made of."""

    voxels: Literal["small", "paper", "original"] | None = _choice(None, "{}")
    """small (a fourteenth of the parameters, no dropout, a bounded grid, L1 at rate 0.002), paper (as the paper ran it:
    L1 alone at rate 0.00001) or original (its authors' L1 and critic at rate 0.0004). Default: small without a GPU,
    paper with one."""


MethodChoices = PaperChoices | LightPathChoices | DnrChoices | AuthorsChoices | DeepVoxelsChoices
"""The choices of any method."""

CHOICES: dict[str, type[MethodChoices]] = {
    "paper": PaperChoices,
    "mlp-first": PaperChoices,
    "dnr": DnrChoices,
    "dnr-layers": DnrChoices,
    "authors-code": AuthorsChoices,
    "light-path": LightPathChoices,
    "deepvoxels": DeepVoxelsChoices,
}
"""What each method can be told besides `CommonChoices`; the methods themselves: model/methods/table.py."""


def folder_name(common: CommonChoices, choices: MethodChoices) -> str:
    """The default name of a run's folder: the method, and a suffix for each choice that is not the default."""
    parts = [common.method]
    parts += [common.geometry] if common.geometry != TRUTH else []
    parts += _suffixes(choices) + _suffixes(common)
    usual = PAPER_PRESETS[choices.preset].steps if isinstance(choices, PaperChoices) else DEFAULT_STEPS
    parts += [f"{common.steps}-steps"] if common.steps not in (None, usual) else []
    parts += [f"seed{common.seed}"] if common.seed else []
    return "-".join(parts)


def _suffixes(choices: object) -> list[str]:
    suffixes = []
    for item in dataclasses.fields(choices):  # pyright: ignore[reportArgumentType]
        value = getattr(choices, item.name)
        if dataclasses.is_dataclass(value):
            suffixes += _suffixes(value)
        elif value != item.default and "suffix" in item.metadata:
            suffix = item.metadata["suffix"]
            template = suffix.get(value) or suffix[""] if isinstance(suffix, dict) else suffix
            suffixes.append(template.format(value))
    return suffixes


def flags_of(record: type) -> set[str]:
    """The names of the flags, without dashes in front, that the fields of a record of choices make."""
    names = set()
    for item in dataclasses.fields(record):
        if isinstance(item.type, type) and dataclasses.is_dataclass(item.type):
            names |= flags_of(item.type)
        else:
            names.add(item.name.replace("_", "-"))
    return names


def named_method(arguments: list[str]) -> str | None:
    """The method that a command line names; None where it names none."""
    named = None
    for place, argument in enumerate(arguments):
        flag, equals, value = argument.partition("=")
        if flag == "--method":
            named = value if equals else (arguments[place + 1] if place + 1 < len(arguments) else None)
    return named


def refuse_foreign_flags(method: str, arguments: list[str]) -> None:
    """Refuses flags that other methods have and this one has not, rather than ignore them.

    Raises:
        HyalineError: names the flag, and the methods that have it.
    """
    own = flags_of(CHOICES[method]) | flags_of(CommonChoices)
    for argument in arguments:
        name = argument.partition("=")[0].removeprefix("--").replace("_", "-")
        having = [other for other, record in CHOICES.items() if name in flags_of(record)]
        if argument.startswith("--") and name not in own and having:
            raise HyalineError(f"--{name}: method {method} has no such choice ({', '.join(having)} has); leave it out")
