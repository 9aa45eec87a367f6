"""Sub-pixel rays of training and test pixels, and the straight layers along them, traced for every batch."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from datagen.data.cameras import Cameras, subpixel_offsets, subpixel_rays
from datagen.data.config import Resolution, Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import GeometryKey, geometry_key, read_meshes
from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import short_lived_workers, use_mitsuba
from model.batches.rays import Pixels, RayBatch, black, read_colors, to_device

if TYPE_CHECKING:
    from datagen.trace.peel import Peeler


Rays = tuple[Float32[np.ndarray, "ray 3"], Float32[np.ndarray, "ray 3"]]
"""Origins and unit directions."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SubpixelRays:
    """The rays through all pixels of some views, row by row and view by view."""

    cameras: Cameras
    """The cameras of these views only."""

    @property
    def resolution(self) -> Resolution:
        return Resolution(width=self.cameras.width, height=self.cameras.height)

    def through(self, index: Int[np.ndarray, " pixel"], samples: int, rng: np.random.Generator | None) -> Rays:
        """Origins and unit directions of `samples` (a square number) rays through each of the pixels, pixel by pixel.

        They lie in the cells of a grid that tiles the pixel: at their centres, or jittered in them by `rng`.
        """
        shape = (len(index), samples, 2)
        offsets = subpixel_offsets(samples) if rng is None else subpixel_offsets(samples, rng.random(shape))
        return subpixel_rays(self.cameras, index, np.broadcast_to(offsets, shape))

    def through_pairs(self, index: Int[np.ndarray, " pixel"], samples: int, rng: np.random.Generator) -> Rays:
        """As `through`, but rays 2k and 2k + 1 of a pixel lie opposite each other, and such pairs are independent, so
        the spread of their means measures the noise, which it does not for rays in separate cells."""
        pairs = -(-samples // 2)
        offsets = in_pairs(rng.random((len(index), pairs, 2)), lambda place: 1 - place)[:, :samples]
        return subpixel_rays(self.cameras, index, offsets)


def in_pairs(
    first: Float[np.ndarray, "pixel pair 2"], opposite: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, "pixel sample 2"]:
    """Each point, followed by its `opposite`."""
    return np.stack([first, opposite(first)], axis=2).reshape(len(first), -1, 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class RayPixels:
    """All pixels of some views, whose rays are made when a batch asks for them."""

    rays: SubpixelRays
    rgb: UInt8[Tensor, "pixel 3"]
    device: torch.device

    @property
    def resolution(self) -> Resolution:
        return self.rays.resolution

    @property
    def pixels_per_view(self) -> int:
        return self.resolution.pixels

    @property
    def whole_views(self) -> bool:
        return False

    def to(self, device: torch.device) -> Self:
        return dataclasses.replace(self, rgb=self.rgb.to(device), device=device)


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedLayerPixels(RayPixels):
    """All pixels of some views; the straight layers of their rays are traced when they are asked for."""

    peeler: "Peeler"
    num_layers: int
    train_samples: int
    render_samples: int

    @property
    def chunk(self) -> int:
        return max(1, 65_536 // self.render_samples)

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> RayBatch:
        """The layers of the rays through these pixels; without `rng`, as many rays as for rendering."""
        samples = self.train_samples if rng is not None else self.render_samples
        origins, directions = self.rays.through(index.flatten().cpu().numpy(), samples, rng)
        with short_lived_workers():
            uv, object_id = self.peeler.peel_rays(origins, directions, self.num_layers)
        return RayBatch(
            **to_device({"uv": uv, "object_id": object_id, "p_camera": origins}, self.device),
            samples=samples,
            grid=(index.shape[0], index.shape[1], index.shape[2]) if index.ndim == 3 else None,
        )


def load_traced_layers(
    dataset: Dataset,
    geometry: str,
    num_layers: int,
    split: Split,
    views: Sequence[int],
    with_images: bool,
    *,
    train_samples: int,
    render_samples: int,
) -> TracedLayerPixels:
    """Reads cameras and, with `with_images`, pictures of some views, and loads the surfaces for tracing."""
    pixels = trace_cameras(
        dataset,
        geometry,
        num_layers,
        cameras_of(dataset, split, views),
        train_samples=train_samples,
        render_samples=render_samples,
    )
    return dataclasses.replace(pixels, rgb=read_colors(dataset, split, views, with_images=with_images))


def trace_cameras(
    dataset: Dataset, geometry: str, num_layers: int, cameras: Cameras, *, train_samples: int, render_samples: int
) -> TracedLayerPixels:
    """The pixels of any cameras, black, with the surfaces loaded for tracing."""
    return TracedLayerPixels(
        peeler=_load_peeler(geometry_key(dataset, geometry)),
        rays=SubpixelRays(cameras=cameras),
        rgb=black(cameras),
        num_layers=num_layers,
        train_samples=train_samples,
        render_samples=render_samples,
        device=torch.device("cpu"),
    )


def peel_cameras(
    dataset: Dataset, geometry: str, num_layers: int, cameras: Cameras, *, whole_views: bool = False
) -> Pixels:
    """The pixels of any cameras, black, with the layers that `datagen peel` would store for them.

    Args:
        whole_views: the renderer needs neighbouring pixels.
    """
    peeler = _load_peeler(geometry_key(dataset, geometry))
    with short_lived_workers():
        views = [peeler.peel(cameras, view, num_layers)[0] for view in range(len(cameras))]
    uv = np.concatenate([np.moveaxis(layers.uv, 0, 2).reshape(-1, num_layers, 2) for layers in views])
    object_id = np.concatenate([np.moveaxis(layers.object_id, 0, 2).reshape(-1, num_layers) for layers in views])
    return Pixels(
        uv=torch.from_numpy(uv.view(np.int16)),
        object_id=torch.from_numpy(object_id),
        rgb=black(cameras),
        p_camera=torch.from_numpy(cameras.world_from_camera[:, :3, 3].astype(np.float32)),
        resolution=Resolution(width=cameras.width, height=cameras.height),
        whole_views=whole_views,
    )


def trace_layers(meshes: tuple[Mesh, ...], cameras: Cameras, num_layers: int) -> TracedLayerPixels:
    """The pixels of any cameras, black, with one ray each through their centres."""
    return TracedLayerPixels(
        peeler=_make_peeler(meshes),
        rays=SubpixelRays(cameras=cameras),
        rgb=black(cameras),
        num_layers=num_layers,
        train_samples=1,
        render_samples=1,
        device=torch.device("cpu"),
    )


@functools.lru_cache(maxsize=1)
def _load_peeler(key: GeometryKey) -> "Peeler":
    return _make_peeler(read_meshes(key.dataset, key.geometry))


def _make_peeler(meshes: tuple[Mesh, ...]) -> "Peeler":
    use_mitsuba()
    from datagen.trace.peel import Peeler

    return Peeler(meshes)


def cameras_of(dataset: Dataset, split: Split, views: Sequence[int]) -> Cameras:
    """The cameras of some views of a split."""
    cameras = dataset.cameras(split)
    return dataclasses.replace(cameras, world_from_camera=cameras.world_from_camera[list(views)])
