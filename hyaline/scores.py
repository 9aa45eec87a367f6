"""Scoring one predicted picture against the true one, as `eval report` does."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

from datagen.disk.errors import HyalineError
from datagen.disk.records import checked
from eval.score import metrics


@dataclass(frozen=True, kw_only=True)
class Scores:
    """The scores of one picture."""

    psnr_db: float
    """Peak signal-to-noise ratio, peak 255; inf where both are identical."""
    ssim: float | None
    """Wang et al. 2004, at most 1; None for pictures of fewer than 11 pixels a side."""
    delta_e: float
    """CIE DE2000 under D65, mean over pixels."""
    flip: float | None
    """LDR-FLIP at 67 pixels per degree, 0 to 1; None without the package flip-evaluator."""
    lpips: float | None
    """LPIPS 0.1 with AlexNet; None without the package lpips and torchvision's weights."""
    masked_psnr_db: float | None
    """PSNR of the pixels in the mask alone; None without a mask, or with an empty one."""


@checked
def score(
    pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None = None
) -> Scores:
    """Scores a picture; a split's score is the mean of its pictures' scores.

    >>> import numpy as np
    >>> target = np.full((16, 16, 3), 100, np.uint8)
    >>> scores = score(target + np.uint8(10), target, mask=np.ones((16, 16), bool))
    >>> round(scores.psnr_db, 2) == round(scores.masked_psnr_db, 2) == 28.13   # 10 log10(255^2 / 10^2)
    True

    Args:
        pred: 8-bit sRGB.
        target: 8-bit sRGB, the ground truth.
        mask: pixels for `masked_psnr_db`, for example `view.mask("glass")`.

    Raises:
        HyalineError: pictures that are not 8-bit, a mask that is not bool, or sizes that differ.
    """
    if pred.shape != target.shape or not target.size:
        raise HyalineError(f"pred: has shape {pred.shape}; expected {target.shape}, that of target, and not empty")
    if mask is not None and mask.shape != target.shape[:2]:
        raise HyalineError(f"mask: has shape {mask.shape}; expected {target.shape[:2]}, that of target")
    is_large = min(target.shape[:2]) >= metrics.SSIM_WINDOW
    return Scores(
        psnr_db=metrics.psnr(pred, target),
        ssim=metrics.ssim(pred, target) if is_large else None,
        delta_e=float(metrics.delta_e_2000(pred, target).mean()),
        flip=metrics.flip(pred, target),
        lpips=metrics.lpips(pred, target),
        masked_psnr_db=metrics.masked_psnr(pred, target, mask) if mask is not None and mask.any() else None,
    )
