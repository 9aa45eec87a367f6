"""The metrics: pure functions of one predicted and one true picture, both 8-bit sRGB.

A split's score is the mean over its pictures of these values (`mean_of`), not the value of the pooled error.
"""

import functools
import importlib
import importlib.util
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import cast

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.terminal.command import say

PEAK = 255
SSIM_WINDOW = 11
"""Side of the Gaussian window in pixels; SSIM is undefined for smaller pictures."""
LPIPS_SIDE = 31
"""Least side of a picture in pixels that is left something of by AlexNet's pooling."""
ALEXNET = "alexnet-owt-7be5be79.pth"
"""torchvision's file of weights."""
HIGHLIGHTS = 0.02
"""Share of glass pixels that are scored as highlights."""


def psnr(pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"]) -> float:
    """Peak signal-to-noise ratio in dB, peak 255; inf when identical."""
    return decibels(float(np.mean(_squared_error(pred, target))))


def masked_psnr(
    pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> float:
    """PSNR in dB of the pixels in `mask`, which must not be empty: MSE = sum(mask err^2) / (3 sum(mask)).

    Blanking the rest of both pictures and dividing by all pixels would flatter small masks instead.
    """
    assert mask.any()
    return decibels(float(np.mean(_squared_error(pred, target)[mask])))


def psnr_uint8_wrap(pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"]) -> float:
    """The value that the paper authors' released script calls PSNR, in dB, only for comparison with their tables.

    It is not a PSNR: it subtracts and squares 8-bit integers, so squared errors are taken modulo 256. An error of 16
    counts as 0, and every pair of pictures scores at least 24 dB. Source: computeStats.py of
    Mirjang/TransparentNeuralRendering.
    """
    with np.errstate(over="ignore"):  # The overflow is the point.
        wrapped = np.square(np.subtract(pred, target, dtype=np.uint8), dtype=np.uint8)
    return decibels(float(np.mean(wrapped, dtype=np.float64)))


def ssim(pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"]) -> float:
    """Structural similarity with the published settings: Gaussian window of sigma 1.5 (11 x 11), at most 1.

    Both sides are at least 11 pixels. Source: Wang et al. 2004; the mean over channels and over pixels whose window
    lies inside, as scikit-image computes it.
    """
    from skimage.metrics import structural_similarity

    score = structural_similarity(
        target / PEAK,
        pred / PEAK,
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    return float(cast(float, score))  # A pair only when asked for gradients.


def delta_e_2000(pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Colour difference CIE DE2000 of each pixel, sRGB to CIE Lab under D65; about 1 is just noticeable."""
    import colour

    lab = [colour.XYZ_to_Lab(colour.sRGB_to_XYZ(image / PEAK)) for image in (target, pred)]
    return np.asarray(colour.delta_E(lab[0], lab[1], method="CIE 2000"))


def flip(pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"]) -> float | None:
    """LDR-FLIP, the difference seen when flipping between both pictures, 0 to 1; None without flip-evaluator.

    The mean over pixels at 67 pixels per degree, the package's default: a 0.7 m wide 4K display seen from 0.7 m.
    Source: Andersson et al. 2020, computed by NVIDIA's own package.
    """
    package = _flip_package()
    if package is None:
        return None
    images = [(image / PEAK).astype(np.float32) for image in (target, pred)]
    error, _, _ = package.evaluate(*images, "LDR", applyMagma=False, computeMeanError=False)
    return float(error.mean(dtype=np.float64))


def lpips(pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"]) -> float | None:
    """LPIPS 0.1, the distance of AlexNet's features, 0 for equal pictures; None without its package and weights.

    Both sides are at least 31 pixels. Source: Zhang et al. 2018, computed by its authors' package.
    """
    distance = _lpips_distance()
    if distance is None or min(target.shape[:2]) < LPIPS_SIDE:
        return None
    return distance(*(image * np.float32(2 / PEAK) - 1 for image in (pred, target)))


@functools.cache
def _lpips_distance() -> Callable[[np.ndarray, np.ndarray], float] | None:
    """The distance of two pictures in -1 to 1; None unless everything is installed, since nothing is downloaded."""
    if not all(map(importlib.util.find_spec, ("lpips", "torchvision", "torch"))):
        return None
    import torch

    if not (Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET).is_file():
        return None
    try:
        package = importlib.import_module("lpips")
    except (ImportError, OSError, RuntimeError) as error:  # torchvision raises the latter two beside another torch.
        say(f"no LPIPS: the package lpips cannot be imported ({error})")
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # lpips 0.1.4 calls torchvision as versions before 0.13 wanted it.
        network = package.LPIPS(net="alex", verbose=False)

    def distance(*images: np.ndarray) -> float:
        with torch.inference_mode():
            return float(network(*(torch.from_numpy(image).permute(2, 0, 1)[None] for image in images)))

    return distance


def highlights(target: UInt8[np.ndarray, "h w 3"], glass: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The brightest 2 % of some pixels by their mean true sRGB, with all that are as bright.

    Source: the paper's section 4.6 judges specular highlights, which are too small for PSNR to show.
    """
    light = target.mean(axis=-1)
    return glass & (light >= np.quantile(light[glass], 1 - HIGHLIGHTS))


@functools.cache
def _flip_package() -> ModuleType | None:
    """NVIDIA's package; None if it is not installed."""
    name = "flip_evaluator"
    return None if importlib.util.find_spec(name) is None else importlib.import_module(name)


def mean_of(values: Sequence[float | None]) -> float | None:
    """The mean of a split's per-picture values; None if no picture has one.

    Pictures without a value (None) and identical pictures (inf dB) are left out, unless all are identical, so that one
    picture does not make the mean infinite. Tables print how many were left out.
    """
    known = [value for value in values if value is not None]
    finite = [value for value in known if math.isfinite(value)]
    if finite:
        return math.fsum(finite) / len(finite)
    return math.inf if known else None


def _squared_error(pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return np.square(pred.astype(np.float64) - target)


def decibels(mse: float) -> float:
    """PSNR in dB of a mean squared error in levels of 255 squared; inf for 0."""
    return math.inf if mse == 0 else 10 * math.log10(PEAK**2 / mse)
