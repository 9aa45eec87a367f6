"""What training makes small besides the difference of each pixel."""

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
    """Terms beside the difference of each pixel, whose weight is 1 (mean absolute, sRGB of 0 to 1)."""

    vgg_weights: str = choice(NO_VGG, {"random": "random-vgg", "auto": "vgg", "": "vgg"})
    """Weights of the network of a perceptual loss (section 4.4): none, auto (looks in torch's cache, downloads
    nothing), a path, or random (a stand-in, and called that in tables)."""
    vgg: VggKind = choice("vgg16", "{}")
    """Which network that is."""
    perceptual: float = choice(0.05, "perceptual{}", limits=AMOUNT)
    """Weight of the perceptual loss; the paper names none. Measured with random weights on a blurred prediction, its
    gradient by the colours of a patch is then a sixth as long as that of their mean absolute difference."""
    adversarial: float = choice(0.0, "adversarial{}", limits=AMOUNT)
    """Weight of the loss before a 70 x 70 PatchGAN; 0: there is none. 0.01 is pix2pix's: L1 has a hundred times as
    much."""
    adversarial_from: float = choice(0.6, "from{}", limits=SHARE)
    """Share of the steps after which it begins (a warm-up without it: section 4.4); from then on no learning rate is
    above 0.0004."""
    inpaint: bool = choice(False, "inpaint")
    """Let the discriminator judge poses without truth instead, where only texels never seen in training learn."""
    patch: int = choice(64, "patch{}", limits=(LEAST_PATCH, math.inf))
    """Height and width in pixels of the patches that these losses look at (U-Nets: of poses without truth alone)."""
    patches: int = unflagged(1, limits=COUNT)
    """Of them, in each step, besides the random pixels."""
    adversarial_lr: float = unflagged(0.0004)
    """Learning rate of the discriminator, and from then on the most of every other (section 4.4)."""
    softness: float = unflagged(0.0, limits=AMOUNT)
    """Differences of pixels well below it count by their squares, those above by their size: the Charbonnier loss, less
    its value at 0. 0: all by their size, as in the paper. PSNR asks for squares."""
    vgg_sha256: str = unflagged("")
    """Of the file of weights; empty for random ones."""

    def __post_init__(self) -> None:
        check_limits(self)
        if not 0 < self.adversarial_lr <= 1:
            raise HyalineError(f"adversarial_lr: is {self.adversarial_lr}; expected a learning rate in (0, 1]")
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
