"""Whole views as training data: cameras, pictures, and neighbouring views."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8
from torch import Tensor

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Resolution, Split
from datagen.data.dataset import Dataset
from model.batches.rays import read_colors

NUM_NEIGHBOURS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewBatch:
    """Views to draw, one after the other."""

    cameras: tuple[Camera, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """Some views of a dataset for renderers that draw whole pictures."""

    rgb: UInt8[Tensor, "pixel 3"]
    """8-bit sRGB, row by row and view by view; black without images."""
    cameras: Cameras

    @property
    def device(self) -> torch.device:
        return self.rgb.device

    @property
    def resolution(self) -> Resolution:
        """Size of a view."""
        return self.cameras.size

    @property
    def pixels_per_view(self) -> int:
        return self.resolution.pixels

    @property
    def chunk(self) -> int:
        """Pixels rendered at once: one view."""
        return self.pixels_per_view

    @property
    def whole_views(self) -> bool:
        return True

    @property
    def num_views(self) -> int:
        return len(self.cameras)

    def to(self, device: torch.device) -> "Views":
        return Views(rgb=self.rgb.to(device), cameras=self.cameras)

    def take(self, index: Int[Tensor, " ray"], rng: np.random.Generator | None) -> ViewBatch:  # noqa: ARG002
        """The views that these pixels fill; they must be all pixels of whole views, in order."""
        first = index[:: self.pixels_per_view]
        assert len(index) == len(first) * self.pixels_per_view, "pixels of half a view"
        return ViewBatch(cameras=tuple(self.cameras[int(view)] for view in first // self.pixels_per_view))

    def image(self, view: int) -> Float32[Tensor, "1 3 h w"]:
        """sRGB in [0, 1]."""
        pixels = self.rgb[view * self.pixels_per_view : (view + 1) * self.pixels_per_view]
        return (pixels.float() / 255).T.reshape(1, 3, *self.resolution.shape)

    def neighbours(self, view: int) -> list[int]:
        """The at most four other views whose optical axes are nearest in angle, nearest first."""
        forward = -torch.from_numpy(self.cameras.world_from_camera).float()[:, :3, 2]
        cosine = forward @ forward[view]
        cosine[view] = -torch.inf
        nearest = torch.argsort(cosine, descending=True, stable=True)
        return nearest[: min(NUM_NEIGHBOURS, self.num_views - 1)].tolist()


def load_views(dataset: Dataset, split: Split, views: Sequence[int], *, with_images: bool) -> Views:
    """Cameras and, with `with_images`, pictures of some views, every byte verified."""
    cameras = dataset.cameras(split)
    some = dataclasses.replace(cameras, world_from_camera=cameras.world_from_camera[list(views)])
    return Views(rgb=read_colors(dataset, split, views, with_images=with_images), cameras=some)
