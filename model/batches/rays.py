"""The training data in memory: every pixel of some views with its layers, and random batches of them."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Int, Int16, UInt8, UInt16
from torch import Tensor

from datagen.data.cameras import Cameras
from datagen.data.config import Resolution, Split
from datagen.data.dataset import Dataset
from datagen.data.layers import UV_SCALE
from datagen.disk.errors import HyalineError

Batch_co = TypeVar("Batch_co", covariant=True)

ALIGNMENT = 16
"""Bytes between the starts of arrays that are copied together: a multiple of every type's size."""


@runtime_checkable
class PixelSource(Protocol[Batch_co]):
    """All pixels of some views, row by row and view by view, and the renderer's inputs for any of them."""

    @property
    def rgb(self) -> UInt8[Tensor, "pixel 3"]:
        """8-bit sRGB; black without images."""
        ...

    @property
    def device(self) -> torch.device:
        """The device of batches; `rgb` may be elsewhere."""
        ...

    @property
    def resolution(self) -> Resolution:
        """Size of a view."""
        ...

    @property
    def pixels_per_view(self) -> int: ...

    @property
    def chunk(self) -> int:
        """Pixels rendered at once."""
        ...

    @property
    def whole_views(self) -> bool:
        """True if views are rendered as a whole, because the renderer needs neighbouring pixels."""
        ...

    def to(self, device: torch.device) -> "PixelSource[Batch_co]": ...

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> Batch_co:
        """The renderer's input for the pixels with these row numbers; `rng` is given in training only.

        Row numbers with three axes are square patches (patch, row, column), in this order; see `draw_patches`.
        """
        ...


def draw_rows(pixels: PixelSource, number: int, rng: np.random.Generator) -> Int[np.ndarray, " pixel"]:
    """Row numbers of random pixels."""
    return rng.integers(len(pixels.rgb), size=number)


@dataclass(frozen=True, kw_only=True, eq=False)
class RayBatch:
    """A renderer's input for some pixels: the layers along each pixel's ray, nearest first."""

    uv: Float32[Tensor, "ray layer 2"]
    object_id: UInt8[Tensor, "ray layer"]
    """0 where the layer is empty."""
    p_camera: Float32[Tensor, "ray 3"]
    """Camera centres in world space, metres."""
    samples: int = 1
    """Rays per pixel, stored pixel by pixel; their colours are averaged."""
    grid: tuple[int, int, int] | None = None
    """Number of patches, rows and columns that the pixels form; None if they are unordered."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pixels:
    """All pixels of some views, row by row and view by view, in the dataset's own small integers."""

    uv: Int16[Tensor, "pixel layer 2"]
    """The bits of uint16, because torch 2.13 has few operations on that type."""
    object_id: UInt8[Tensor, "pixel layer"]
    rgb: UInt8[Tensor, "pixel 3"]
    """8-bit sRGB."""
    p_camera: Float32[Tensor, "view 3"]
    resolution: Resolution
    whole_views: bool = False
    """True if views are rendered as a whole, because the renderer needs neighbouring pixels."""

    @property
    def device(self) -> torch.device:
        return self.rgb.device

    @property
    def pixels_per_view(self) -> int:
        return self.resolution.pixels

    @property
    def chunk(self) -> int:
        return self.pixels_per_view if self.whole_views else pixels_at_once(self.device)

    def to(self, device: torch.device) -> "Pixels":
        names = ("uv", "object_id", "rgb", "p_camera")
        return dataclasses.replace(self, **{name: getattr(self, name).to(device) for name in names})

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> RayBatch:  # noqa: ARG002
        """The rays of the pixels with these row numbers: always those through pixel centres."""
        grid = grid_of(self, index, whole_views=self.whole_views)
        index = index.flatten()
        return RayBatch(
            # `index_select` takes a third of the time of brackets.
            uv=(self.uv.index_select(0, index).int() & 0xFFFF).float() / UV_SCALE,
            object_id=self.object_id.index_select(0, index),
            p_camera=self.p_camera.index_select(0, index // self.pixels_per_view),
            grid=grid,
        )


def pixels_at_once(device: torch.device) -> int:
    """Pixels rendered at once from stored layers: on a CPU few enough for a network layer's output to stay in the
    caches until the next layer reads it."""
    return 16_384 if device.type == "cpu" else 65_536


def load_pixels(
    dataset: Dataset,
    geometry: str,
    split: Split,
    views: Sequence[int],
    *,
    with_images: bool = True,
    max_layers: int | None = None,
    whole_views: bool = False,
) -> Pixels:
    """Reads layers, cameras and, with `with_images`, pictures of some views, every byte verified.

    Args:
        max_layers: number of nearest layers to keep; None: all.
        whole_views: the renderer needs neighbouring pixels.
    """
    p_camera = dataset.cameras(split).world_from_camera[list(views), :3, 3].astype(np.float32)
    stacks = [read_stack(dataset, geometry, split, view, max_layers) for view in views]
    return Pixels(
        uv=torch.from_numpy(np.concatenate([uv for uv, _ in stacks]).view(np.int16)),
        object_id=torch.from_numpy(np.concatenate([object_id for _, object_id in stacks])),
        rgb=read_colors(dataset, split, views, with_images=with_images),
        p_camera=torch.from_numpy(p_camera),
        resolution=dataset.config.resolution,
        whole_views=whole_views,
    )


def read_stack(
    dataset: Dataset, geometry: str, split: Split, view: int, max_layers: int | None
) -> tuple[UInt16[np.ndarray, "pixel layer 2"], UInt8[np.ndarray, "pixel layer"]]:
    """uv and object ids of a view's pixels in its nearest layers, every byte verified."""
    layers = dataset.layer_store(geometry).read(split, view, only=["uv", "object_id"])
    uv, object_id = np.moveaxis(layers["uv"], 0, -1), layers["object_id"]
    if object_id.max(initial=0) > len(dataset.objects):
        raise HyalineError(
            f"{dataset.root}: layers of {geometry}, {split} view {view}, name object {object_id.max()}; "
            f"expected at most {len(dataset.objects)}, peel it again"
        )
    kept_id = object_id[:max_layers]
    uv = np.moveaxis(uv[:max_layers], 0, 2).reshape(-1, len(kept_id), 2)
    # Contiguous layers per pixel: otherwise a random batch misses the cache once per layer.
    return np.ascontiguousarray(uv), np.ascontiguousarray(np.moveaxis(kept_id, 0, 2).reshape(-1, len(kept_id)))


def grid_of(pixels: PixelSource, index: Int[Tensor, "*pixel"], *, whole_views: bool) -> tuple[int, int, int] | None:
    """Number of patches, rows and columns that the pixels with these row numbers form; None if they are unordered.

    Args:
        whole_views: row numbers with one axis belong to whole views.
    """
    if index.ndim == 3:
        return index.shape[0], index.shape[1], index.shape[2]
    if whole_views:
        return len(index) // pixels.pixels_per_view, *pixels.resolution.shape
    return None


def draw_patches(
    pixels: PixelSource, number: int, size: int, rng: np.random.Generator, *, strides: Sequence[int] = (1,)
) -> Int[Tensor, "patch row column"]:
    """Row numbers of the pixels of square patches at random places of random views.

    Args:
        size: rows and columns of a patch, at most the shorter side of a view.
        strides: 1 for every pixel, 2 for every second one ...; each patch draws one of those that fit.
    """
    height, width = pixels.resolution.shape
    fitting = [stride for stride in strides if (size - 1) * stride < min(height, width)]
    stride = rng.choice(fitting, size=number)
    free = np.array([[height], [width]]) - (size - 1) * stride
    view = rng.integers(len(pixels.rgb) // pixels.pixels_per_view, size=number)
    row, column = rng.integers(free, size=(2, number))
    rows, columns = (first[:, None] + np.arange(size) * stride[:, None] for first in (row, column))
    index = (view[:, None, None] * height + rows[:, :, None]) * width + columns[:, None, :]
    return to_device({"index": index}, pixels.rgb.device)["index"]


def read_colors(dataset: Dataset, split: Split, views: Sequence[int], *, with_images: bool) -> UInt8[Tensor, "pixel 3"]:
    """All pixels of the views; black without images: rendering a test view never opens its truth."""
    black = np.zeros((*dataset.config.resolution.shape, 3), np.uint8)
    images = [dataset.view(split, view).image if with_images else black for view in views]
    return torch.from_numpy(np.concatenate([image.reshape(-1, 3) for image in images]))


Key = TypeVar("Key")


def to_device(arrays: Mapping[Key, np.ndarray], device: torch.device) -> dict[Key, Tensor]:
    """Arrays as tensors on a device. A GPU gets them in one copy from pinned memory, for which nothing waits."""
    if device.type == "cpu":
        return {key: torch.from_numpy(np.ascontiguousarray(values)) for key, values in arrays.items()}
    starts = np.cumsum([0, *(-(-values.nbytes // ALIGNMENT) * ALIGNMENT for values in arrays.values())]).tolist()
    packed = np.empty(starts[-1], np.uint8)
    for start, values in zip(starts, arrays.values()):
        packed[start : start + values.nbytes] = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
    moved = torch.from_numpy(packed).pin_memory().to(device, non_blocking=True)
    return {
        key: moved[start : start + values.nbytes].view(torch.from_numpy(values[:0].copy()).dtype).view(values.shape)
        for start, (key, values) in zip(starts, arrays.items())
    }


def black(cameras: Cameras) -> UInt8[Tensor, "pixel 3"]:
    """Black colours for all pixels of cameras without pictures."""
    return torch.zeros(len(cameras) * cameras.height * cameras.width, 3, dtype=torch.uint8)


def take_colors(pixels: PixelSource, index: Int[Tensor, " ray"]) -> Float32[Tensor, "ray 3"]:
    """The true sRGB colours in [0, 1] of the pixels with these row numbers."""
    return pixels.rgb.index_select(0, index).to(pixels.device).float() / 255


def insert_empty_layer(rays: RayBatch, place: Int[Tensor, " ray"]) -> RayBatch:
    """The rays with one more, empty layer as layer `place` (0 to num_layers) of its ray.

    An empty layer's features and extrinsics are zeros, so this is the paper's random zero layer (section 4.4).
    """
    num_rays, num_layers = rays.object_id.shape
    padded_id = torch.cat([rays.object_id, rays.object_id.new_zeros(num_rays, 1)], dim=1)
    padded_uv = torch.cat([rays.uv, rays.uv.new_zeros(num_rays, 1, 2)], dim=1)
    layer = torch.arange(num_layers + 1, device=place.device)[None]
    source = torch.where(layer == place[:, None], num_layers, layer - (layer > place[:, None]).long())
    return RayBatch(
        uv=padded_uv.gather(1, source[..., None].expand(-1, -1, 2)),
        object_id=padded_id.gather(1, source),
        p_camera=rays.p_camera,
        samples=rays.samples,
        grid=rays.grid,
    )


def insert_random_layer(rays: RayBatch, rng: np.random.Generator | None) -> RayBatch:
    """The rays with one more empty layer: at a random position in each ray, or after all others without `rng`."""
    num_rays, num_layers = rays.object_id.shape
    last = np.full(num_rays, num_layers)
    place = last if rng is None else rng.integers(num_layers + 1, size=num_rays)
    return insert_empty_layer(rays, to_device({"place": place}, rays.object_id.device)["place"])


def srgb_curve(linear: Float32[Tensor, "*b"]) -> Float32[Tensor, "*b"]:
    """The sRGB curve, continued below 0 and above 1 so that gradients are not lost. Source: IEC 61966-2-1."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def mean_color(radiance: Float32[Tensor, "pixel sample 3"]) -> Float32[Tensor, "pixel 3"]:
    """sRGB colour of each pixel from the linear radiance of its rays."""
    return srgb_curve(radiance.mean(dim=1))


LEAST_PAIRED = 4
"""Least number of a pixel's rays, in pairs, to estimate the noise of their mean."""


def variance_of_mean(radiance: Float32[Tensor, "pixel sample 3"]) -> Float32[Tensor, "pixel 3"]:
    """Estimated variance of `mean_color` over the choice of rays, where rays 2k and 2k + 1 form independent pairs.

    Uses the slope of the sRGB curve at the mean, without gradients. 0 with only one pair.
    """
    samples = radiance.shape[1]
    if samples < LEAST_PAIRED:
        return torch.zeros_like(radiance[:, 0])
    paired = samples // 2 * 2
    # On a CPU, torch's own means and variances of so few numbers take twice as long.
    pairs = 0.5 * (radiance[:, 0:paired:2] + radiance[:, 1:paired:2])
    spread = (pairs - pairs.mean(dim=1, keepdim=True)).square().sum(dim=1) / (paired // 2 - 1)
    mean = radiance.detach().mean(dim=1)
    slope = torch.where(mean <= 0.0031308, 12.92, (1.055 / 2.4) * mean.clamp_min(0.0031308) ** (1 / 2.4 - 1))
    return spread * (2 / samples) * slope.square()


def linear_curve(srgb: Float32[Tensor, "*b"]) -> Float32[Tensor, "*b"]:
    """The inverse of `srgb_curve`."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
