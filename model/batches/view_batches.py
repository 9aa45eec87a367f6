"""Views without layers, for methods that know only the cameras: whole ones with their neighbours, and plain rays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int
from torch import Tensor

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from model.batches.layers import rays_through
from model.batches.rays import PixelSource, black, load_views_of, to_device

NUM_NEIGHBOURS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewBatch:
    """Views to draw, one after the other."""

    cameras: tuple[Camera, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Views(PixelSource[ViewBatch]):
    """Some views of a dataset for renderers that draw whole pictures."""

    whole_views: bool = True

    @property
    def num_views(self) -> int:
        return len(self.cameras)

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


def views_of(cameras: Cameras) -> Views:
    """Any cameras, with black pixels."""
    return Views(cameras=cameras, rgb=black(cameras))


def load_views(dataset: Dataset, split: Split, views: Sequence[int], *, with_images: bool) -> Views:
    """Cameras and, with `with_images`, pictures of some views, every byte verified."""
    return load_views_of(views_of, dataset, split, views, with_images=with_images)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlainRays:
    """The rays of some pixels."""

    origins: Float32[Tensor, "ray 3"]
    """Camera centres in world space, metres."""
    directions: Float32[Tensor, "ray 3"]
    """Unit vectors in world space."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlainRayPixels(PixelSource[PlainRays]):
    """Rays through the pixels' centres, jittered within the pixel while training, for methods that know only cameras.

    All surfaces lie between `cameras.near` and `far`, in metres; None where that is unknown.
    """

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> PlainRays:
        """One ray through each of the pixels with these row numbers."""
        origins, directions = rays_through(self.cameras, index.flatten().cpu().numpy(), 1, rng)
        return PlainRays(**to_device({"origins": origins, "directions": directions}, self.device))


def rays_of(cameras: Cameras) -> PlainRayPixels:
    """The rays of any cameras, with black pixels."""
    return PlainRayPixels(cameras=cameras, rgb=black(cameras))


def load_rays(dataset: Dataset, split: Split, views: Sequence[int], *, with_images: bool) -> PlainRayPixels:
    """The rays and, with `with_images`, colours of some views; no layer is read."""
    return load_views_of(rays_of, dataset, split, views, with_images=with_images)
