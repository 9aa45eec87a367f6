"""The losses that may be added to the difference of each pixel."""

import math
from dataclasses import dataclass

from datagen.disk.errors import HyalineError
from model.settings.flags import AMOUNT, COUNT, SHARE, check_limits, choice, unflagged
from model.settings.network_parts import VggKind

LEAST_PATCH = 32
"""Rows and columns of the smallest patch that leaves a discriminator more than one value to normalise."""

NO_VGG = "none"


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Terms added to the difference of each pixel, whose weight is 1 (mean absolute, sRGB of 0 to 1)."""

    vgg_weights: str = choice(NO_VGG, {"random": "random-vgg", "auto": "vgg", "": "vgg"})
    """Weights of the network of a perceptual loss (section 4.4): none, auto (from torch's cache; downloads nothing), a
    path, or random (a stand-in, labelled as such in tables)."""
    vgg: VggKind = choice("vgg16", "{}")
    """Network of the perceptual loss."""
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
    inpaint: bool = choice(False, "inpaint")
    """Let the discriminator judge poses without ground truth instead; only texels that no training ray reached
    learn."""
    patch: int = choice(64, "patch{}", limits=(LEAST_PATCH, math.inf))
    """Height and width in pixels of the patches for these losses (U-Nets: only at poses without ground truth)."""
    patches: int = unflagged(1, limits=COUNT)
    """Patches in each step, besides the random pixels."""
    adversarial_lr: float = unflagged(0.0004)
    """Learning rate of the discriminator, and from then on the upper limit of all others (section 4.4)."""
    softness: float = unflagged(0.0, limits=AMOUNT)
    """Scale of the Charbonnier loss (less its value at 0): smaller pixel differences count by their squares, larger
    ones by their size. 0: all by their size, as in the paper. PSNR asks for squares."""
    vgg_sha256: str = unflagged("")
    """SHA-256 of the file of weights; empty for random ones."""

    def __post_init__(self) -> None:
        check_limits(self)
        if not 0 < self.adversarial_lr <= 1:
            raise HyalineError(f"adversarial_lr: is {self.adversarial_lr}; expected a learning rate in (0, 1]")
        for name, is_used, flag in (
            ("vgg", self.has_vgg, "--vgg-weights"),
            ("adversarial_from", self.adversarial > 0, "--adversarial"),
            ("patch", self.has_vgg or self.adversarial > 0, "--vgg-weights or --adversarial"),
        ):
            if not is_used and getattr(self, name) != getattr(type(self), name):
                raise HyalineError(f"{name}: has no effect without {flag}")
        if self.inpaint and not self.adversarial:
            raise HyalineError("inpaint: needs the discriminator's judgement; give --adversarial, such as 0.01")
        if self.perceptual != type(self).perceptual and not self.has_vgg:
            raise HyalineError(
                "perceptual: there is no network to compare with; give --vgg-weights auto, random or a path"
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
