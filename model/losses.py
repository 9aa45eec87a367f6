"""Owns what training makes small: a loss draws what it needs from the training pixels and compares."""

import numpy as np
import torch
from torch import Tensor, nn

from model.batches import PixelSource, take_colors


def pixel_loss(renderer: nn.Module, training: PixelSource, batch: int, rng: np.random.Generator) -> Tensor:
    """Mean absolute difference in sRGB of `batch` random pixels of all training images (section 4.4, without VGG)."""
    index = torch.from_numpy(rng.integers(len(training.rgb), size=batch)).to(training.rgb.device)
    colors = renderer(training.take(index, rng), rng=rng)
    return (colors - take_colors(training, index)).abs().mean()
