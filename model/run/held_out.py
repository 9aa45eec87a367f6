"""Held-out views: pictures that a run does not train on, a quarter of whose pixels measure its progress."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int, UInt8

from model.batches.rays import PixelSource
from model.methods.renderer import Renderer
from model.run.predict import predict_pixels

STRIDE = 2
"""Every second pixel of every second row is scored: a quarter of the time, for a score that differs by hundredths of a
decibel."""

Pictures = UInt8[np.ndarray, "view h w 3"]


def choose_held_out(num_views: int, at_most: int) -> list[int]:
    """The training views that are held out to measure progress: evenly spread, and at most a fifth of all."""
    number = min(at_most, num_views // 5)
    return [(2 * index + 1) * num_views // (2 * number) for index in range(number)]


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOut:
    """The pixels of the held-out views, with their pictures."""

    pixels: PixelSource

    @property
    def rows(self) -> Int[np.ndarray, "view h w"]:
        """Row numbers of the scored pixels."""
        return np.arange(len(self.pixels.rgb)).reshape(-1, *self.pixels.resolution.shape)[:, ::STRIDE, ::STRIDE]

    @property
    def truth(self) -> Pictures:
        """The true colours of the scored pixels."""
        return self.pixels.rgb.cpu().numpy()[self.rows]

    def draw(self, renderer: Renderer) -> Pictures:
        """The predicted colours of the scored pixels."""
        if self.pixels.whole_views:
            return predict_pixels(renderer, self.pixels)[self.rows]
        return predict_pixels(renderer, self.pixels, torch.from_numpy(self.rows.flatten())).reshape(*self.rows.shape, 3)


def mean_psnr(predicted: Pictures, truth: Pictures) -> float:
    """The mean over views of the PSNR in dB of 8-bit pictures."""
    error = (predicted.astype(np.float64) - truth) / 255
    mse = np.square(error).reshape(len(truth), -1).mean(axis=1)
    return float(np.mean(-10 * np.log10(np.maximum(mse, 1e-12))))
