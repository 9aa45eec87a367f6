"""Rays without layers, for methods that know only the cameras."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int
from torch import Tensor

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from model.batches.rays import black, pixels_at_once, read_colors, to_device
from model.batches.traced_layers import RayPixels, SubpixelRays, cameras_of


@dataclass(frozen=True, kw_only=True, eq=False)
class PlainRays:
    """The rays of some pixels."""

    origins: Float32[Tensor, "ray 3"]
    """Camera centres in world space, metres."""
    directions: Float32[Tensor, "ray 3"]
    """Unit vectors in world space."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlainRayPixels(RayPixels):
    """All pixels of some views: rays through their centres, jittered within the pixel while training.

    All surfaces lie between `rays.cameras.near` and `far`, in metres; None where that is unknown.
    """

    @property
    def chunk(self) -> int:
        return pixels_at_once(self.device)

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> PlainRays:
        """One ray through each of the pixels with these row numbers."""
        origins, directions = self.rays.through(index.flatten().cpu().numpy(), 1, rng)
        return PlainRays(**to_device({"origins": origins, "directions": directions}, self.device))


def load_rays(dataset: Dataset, split: Split, views: Sequence[int], *, with_images: bool) -> PlainRayPixels:
    """The rays and (unless told otherwise) colours of some views; no layer is read."""
    pixels = rays_of(cameras_of(dataset, split, views))
    return dataclasses.replace(pixels, rgb=read_colors(dataset, split, views, with_images=with_images))


def rays_of(cameras: Cameras) -> PlainRayPixels:
    """The rays of any cameras, with black pixels."""
    return PlainRayPixels(rays=SubpixelRays(cameras=cameras), rgb=black(cameras), device=torch.device("cpu"))
