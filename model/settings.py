"""Settings: what a run is asked to do, as flags of `model train`; torch is not needed to read them."""

import dataclasses
import math
import os
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from datagen.data.paths import TRUTH, Geometry
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, from_json, in_python
from datagen.terminal.parsing import changed_fields

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

RecordT = TypeVar("RecordT", bound="DataclassInstance")

Limits = tuple[float, float]
"""Least and largest value of a number; infinity if it has no upper limit."""

COUNT: Limits = (1, math.inf)
AMOUNT: Limits = (0, math.inf)
SHARE: Limits = (0, 1)
RATE: Limits = (1e-9, 1)
SEED: Limits = (0, 2**32 - 1)


def choice(
    default: Any,
    suffix: str | dict[object, str] = "",
    *,
    flag: str = "",
    limits: Limits | None = None,
) -> Any:
    """A field of a record that is a flag.

    Args:
        suffix: what marks a run's folder where the value is not the usual one: a template, or one for each value (and
            under the empty one that of all others); empty: nothing does.
        flag: its name on the command line, without dashes; default: the field's.
        limits: of its number, which `check_limits` checks.
    """
    about = {"suffix": suffix, "flag": flag, "limits": limits}
    return dataclasses.field(default=default, metadata=about)


def unflagged(default: Any, *, limits: Limits | None = None) -> Any:
    """A field without a flag: the method's defaults set it, or the dataset."""
    return dataclasses.field(default=default, metadata={"is_hidden": True, "limits": limits})


def check_limits(record: object) -> None:
    """Check the numbers of a record against the limits of their fields; None is within any.

    Raises:
        HyalineError: a number that is not a number, too small or too large.
    """
    for item in dataclasses.fields(record):  # pyright: ignore[reportArgumentType]
        value, limits = getattr(record, item.name), item.metadata.get("limits")
        if limits is None or value is None or (limits[0] <= value <= limits[1] and value < math.inf):
            continue
        wanted = f"{limits[0]} to {limits[1]}" if limits[1] < math.inf else f"at least {limits[0]}"
        raise HyalineError(f"{item.name}: is {value}; expected {wanted}")


def with_settings(record: RecordT, settings: Mapping[str, object]) -> RecordT:
    """The record with the values of some of its flags changed; names of flags that it does not have are left alone."""
    kinds, changed = typing.get_type_hints(type(record)), {}
    for item in dataclasses.fields(record):
        value = getattr(record, item.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            changed[item.name] = with_settings(value, settings)
            continue
        name = item.metadata.get("flag", "").replace("-", "_") or item.name
        if name in settings and not item.metadata.get("is_hidden"):
            changed[item.name] = from_json(kinds[item.name], typing.cast(Json, in_python(settings[name])), where=name)
    return dataclasses.replace(record, **changed)


def suffixes(record: object, usual: object) -> list[str]:
    """What marks the folder of a run: a word for each field that is not as usual, in the fields' order."""
    words = []
    for item, value in changed_fields(record, usual):
        suffix = item.metadata.get("suffix", f"{item.name.replace('_', '-')}{{}}")
        template = suffix[value if value in suffix else ""] if isinstance(suffix, dict) else suffix
        words += [template.format(value)] if template else []
    return words


Extrinsics = Literal["none", "view", "sh"]

EXTRINSIC_CHANNELS: dict[Extrinsics, int] = {"none": 0, "view": 3, "sh": 9}
"""Inputs that each layer gets besides its features. Source: paper section 4.6."""

Norm = Literal["batch", "none"]

UNetNorm = Literal["instance", "batch"]


MOST_RAYS = 1024
"""Rays per pixel, in training and in rendering."""


def check_width(width: int, blocks: int) -> None:
    """Raises a HyalineError where a width cannot be halved `blocks` times."""
    if width < 1 or blocks < 0 or width % (1 << blocks):
        raise HyalineError(f"hidden: is {width} with {blocks} blocks; expected a multiple of {1 << max(blocks, 0)}")


def check_samples(name: str, samples: int) -> None:
    """Raises a HyalineError unless this number of cells tiles a pixel as a square grid."""
    if not 1 <= samples <= MOST_RAYS or math.isqrt(samples) ** 2 != samples:
        raise HyalineError(f"{name}: is {samples}; expected a square number of rays per pixel, 1 to {MOST_RAYS}")


def check_texels(name: str, size: int, *, is_open: bool = False) -> None:
    """Raises a HyalineError unless a texture can have this width in texels; with `is_open`, 0 leaves it open."""
    if not (2 <= size <= 8192 or (is_open and size == 0)):
        raise HyalineError(f"{name}: is {size}; expected 2 to 8192 texels")


Device = Literal["auto", "cpu", "cuda"]

RUNS = Path("runs")
"""Default folder of the runs, as RUNS/SCENE/NAME."""


@dataclass(frozen=True, kw_only=True)
class RunFlags:
    """What a run trains on, where it is stored, and where it is computed."""

    geometry: Geometry = choice(TRUTH)
    """Whose layers to look up: truth, a kind of proxy, or what `proxies make --name` or `model fit --name` made."""
    out: Path | None = choice(None)
    """Folder of the run. Default: runs/SCENE/METHOD, with a suffix for each choice that is not the default."""
    label: str | None = choice(None)
    """Label of the run on its page. Default: the name of its folder, which tables of scores always show."""
    seed: int = choice(0, "seed{}", limits=SEED)
    """Seed of all random numbers."""
    device: Device = choice("auto")
    """Where to compute; auto uses a GPU if there is one."""
    costs: bool = choice(False)
    """Write costs.json to the run's folder: the wall time, CPU time and memory of training, shown on the run's page of
    the report. These are the only numbers that differ between identical trainings."""
    overwrite: bool = choice(False)
    """Delete the existing run and start over."""

    def __post_init__(self) -> None:
        check_limits(self)


LEAST_PATCH = 32
"""Rows and columns of the smallest patch that leaves a discriminator more than one value to normalise."""

NO_VGG = "none"
WEIGHT_FILE = "vgg16-397923af.pth"
"""torchvision's name of the weights trained on ImageNet; it ends with the first digits of their SHA-256."""

FETCH = (
    "fetch them with `python -c 'import torch; "
    f'torch.hub.load_state_dict_from_url("https://download.pytorch.org/models/{WEIGHT_FILE}")\'`'
)


def vgg_path(weights: str) -> Path:
    """The file of weights that are not random; those of ImageNet are where `torch.hub` keeps what it downloads."""
    home = os.environ.get("TORCH_HOME", f"{os.environ.get('XDG_CACHE_HOME', '~/.cache')}/torch")
    return Path(home).expanduser() / "hub/checkpoints" / WEIGHT_FILE if weights == "imagenet" else Path(weights)


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Terms added to the difference of each pixel, whose weight is 1 (mean absolute, sRGB of 0 to 1)."""

    vgg_weights: str = choice(NO_VGG, {NO_VGG: "", "random": "random-vgg", "": "vgg"})
    """Weights of the network of a perceptual loss (section 4.4): none, imagenet (from torch's cache; nothing is
    downloaded), auto (imagenet if they are there, otherwise none), a path, or random (a stand-in)."""
    vgg: Literal["vgg16", "vgg19"] = unflagged("vgg16")
    """Network of the perceptual loss; runs of earlier versions may have VGG19."""
    perceptual: float = choice(0.05, "perceptual{}", limits=AMOUNT)
    """Weight of the perceptual loss; the paper names none."""
    # At 0.05, measured with random weights on a blurred prediction, the gradient at a patch's colours has a sixth of
    # the length of that of the mean absolute difference.
    adversarial: float = choice(0.0, "adversarial{}", limits=AMOUNT)
    """Weight of the adversarial loss of a 70 x 70 PatchGAN; 0 turns it off. 0.01 is pix2pix's, where L1 weighs a
    hundred times as much."""
    adversarial_from: float = choice(0.6, "from{}", limits=SHARE)
    """Fraction of the steps after which the adversarial loss begins (section 4.4 warms up without it); from then on no
    learning rate is above 0.0004."""
    inpaint: bool = unflagged(False)
    """In-painting of texels that no training ray reached: runs of earlier versions may have it."""
    patch: int = choice(64, "patch{}", limits=(LEAST_PATCH, math.inf))
    """Height and width in pixels of the patches for these losses; U-Nets judge their crops."""
    patches: int = unflagged(1, limits=COUNT)
    """Patches in each step, besides the random pixels."""
    adversarial_lr: float = unflagged(0.0004, limits=RATE)
    """Learning rate of the discriminator, and from then on the upper limit of all others (section 4.4)."""
    softness: float = unflagged(0.0, limits=AMOUNT)
    """Scale of the Charbonnier loss (less its value at 0): smaller pixel differences count by their squares, larger
    ones by their size. 0: all by their size, as in the paper. PSNR asks for squares."""
    vgg_sha256: str = unflagged("")
    """SHA-256 of the file of weights; empty for random ones."""

    def __post_init__(self) -> None:
        check_limits(self)
        for name, is_used, flag in (
            ("adversarial_from", self.adversarial > 0, "--adversarial"),
            ("patch", self.has_vgg or self.adversarial > 0, "--vgg-weights or --adversarial"),
        ):
            if not is_used and getattr(self, name) != getattr(type(self), name):
                raise HyalineError(f"{name}: has no effect without {flag}")
        if self.perceptual != type(self).perceptual and not self.has_vgg:
            raise HyalineError(
                "perceptual: there is no network to compare with; give --vgg-weights imagenet, random or a path"
            )

    @property
    def has_vgg(self) -> bool:
        """True when there is a perceptual loss."""
        return self.vgg_weights != NO_VGG

    def describe(self) -> str:
        """What it brings in that no picture of the dataset has taught, in words; empty for nothing."""
        if not self.has_vgg:
            return ""
        name = self.vgg.upper()
        return f"{name} of random weights (a stand-in)" if self.vgg_weights == "random" else f"pre-trained {name}"


LrDecay = Literal["none", "linear", "cosine"]
OptimizerKind = Literal["adam", "muon"]


@dataclass(frozen=True, kw_only=True)
class Optimisation:
    """The optimizer, its batches and its learning rates, for methods whose loss is their own."""

    batch: int = choice(8192, "batch{}", limits=COUNT)
    """Random pixels per step, drawn from all training images; for U-Nets about as many in crops, for deepvoxels images.
    The paper names no number; the authors' code takes one whole image per step. CPU time grows with it."""
    updates: int = choice(1, "{}-updates", limits=COUNT)
    """Weight updates per step, each from an equal part of its batch. For equal rays, more updates fit better."""
    optimizer: OptimizerKind = choice("adam", "{}")
    """adam (section 4.4), or muon: Muon for the network's matrices, Adam for the rest."""
    lr: float = choice(0.001, "lr{}", limits=RATE)
    """Learning rate (section 4.4)."""
    texture_lr: float | None = choice(None, "texture-lr{}", limits=RATE)
    """Learning rate of the textures. Default: the network's, as in the paper."""
    lr_decay: LrDecay = choice("linear", {"none": "no-decay", "": "{}-decay"})
    """Decay of the learning rate: none, linear (constant for the first half of the steps, then down to 0) or cosine.
    The paper's text names none; the authors' scripts use linear (100 epochs constant, 100 epochs linear)."""
    beta1: float = unflagged(0.9, limits=(0, 0.9999))
    """Adam's first decay rate; 0.5 in the authors' code."""
    weight_decay: float = unflagged(0.0, limits=AMOUNT)
    """Weight decay of the network alone, as Adam adds it; 0.0001 in the authors' code. Not with Muon."""
    steps: int = choice(2500, "{}-steps", limits=COUNT)
    """Optimizer steps; larger datasets need more. The paper names no number; at 128 x 128 pixels the held-out PSNR of
    `paper` flattens out by 2500."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.batch < 2 * self.updates:
            raise HyalineError(
                f"batch: is {self.batch}; expected at least 2 pixels for each of {self.updates} updates a step, "
                "batch norm needs a spread"
            )
        if self.optimizer == "muon" and self.weight_decay:
            raise HyalineError("optimizer: is muon, which has no weight decay here; use adam")


@dataclass(frozen=True, kw_only=True)
class PixelOptimisation(Optimisation):
    """Optimisation, for methods that accept extra loss terms."""

    loss: LossConfig = field(default_factory=LossConfig)


def decided(optimisation: Optimisation) -> Optimisation:
    """The same with weights `auto` replaced by what they mean on this machine, so that records tell."""
    if not isinstance(optimisation, PixelOptimisation) or optimisation.loss.vgg_weights != "auto":
        return optimisation
    weights = "imagenet" if vgg_path("imagenet").is_file() else NO_VGG
    return dataclasses.replace(optimisation, loss=dataclasses.replace(optimisation.loss, vgg_weights=weights))


def decay(kind: LrDecay, progress: float) -> float:
    """The factor on the learning rate after a share `progress`, in [0, 1), of the steps."""
    match kind:
        case "none":
            return 1.0
        case "linear":
            return min(1.0, 2 * (1 - progress))
        case "cosine":
            return 0.5 * (1 + math.cos(math.pi * progress))
