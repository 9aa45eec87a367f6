"""Sources of pixels: all those of some views, and the rays of random batches of them."""

import dataclasses
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8
from torch import Tensor

from datagen.data.cameras import Camera, Cameras, subpixel_offsets, subpixel_rays
from datagen.data.config import Resolution, Split
from datagen.data.dataset import Dataset

Batch_co = TypeVar("Batch_co", covariant=True)

CPU = torch.device("cpu")

ALIGNMENT = 16
"""Bytes between the starts of arrays that are copied together: a multiple of every type's size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelSource(Generic[Batch_co]):
    """All pixels of some views, row by row and view by view, and the renderer's inputs for any of them."""

    cameras: Cameras
    """Those of these views alone."""
    rgb: UInt8[Tensor, "pixel 3"]
    """8-bit sRGB; black without images."""
    device: torch.device = CPU
    """The device of batches."""
    whole_views: bool = False
    """True if views are rendered as a whole, because the renderer needs neighbouring pixels."""

    @property
    def resolution(self) -> Resolution:
        """Size of a view."""
        return self.cameras.size

    @property
    def pixels_per_view(self) -> int:
        return self.resolution.pixels

    @property
    def chunk(self) -> int:
        """Pixels rendered at once: on a CPU few enough for a network layer's output to stay in the caches until the
        next layer reads it."""
        return self.pixels_per_view if self.whole_views else 16_384 if self.device.type == "cpu" else 65_536

    def to(self, device: torch.device) -> Self:
        """The same pixels on another device."""
        parts = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        moved = {name: part.to(device) for name, part in parts.items() if isinstance(part, Tensor)}
        return dataclasses.replace(self, device=device, **moved)

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> Batch_co:
        """The renderer's input for the pixels with these row numbers; `rng` is given in training only.

        Row numbers with three axes are square patches (patch, row, column), in this order; see `draw_patches`.
        """
        raise NotImplementedError

    def grid_of(self, index: Int[Tensor, "*pixel"]) -> tuple[int, int, int] | None:
        """Number of patches, rows and columns that the pixels with these row numbers form; None if unordered."""
        if index.ndim == 3:
            return index.shape[0], index.shape[1], index.shape[2]
        return (len(index) // self.pixels_per_view, *self.resolution.shape) if self.whole_views else None


Draw = tuple[Int[Tensor, " pixel"], np.random.Generator]
"""Row numbers of a batch's pixels, and the generator of its rays, which has drawn the row numbers."""

Batch = TypeVar("Batch")


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedPixels(PixelSource[Batch]):
    """Pixels whose rays are traced for each batch, several batches at once for less."""

    made: deque[tuple[object, np.random.Generator, Batch]] | None = None
    """The batches of a step that were made ahead, each between the state of its generator before the rays were drawn
    and the generator after that; None if batches are traced when they are asked for."""

    def take_all(self, draws: Sequence[Draw], *, beside_torch: bool = False) -> list[Batch]:
        """The batches of several draws, as `take` gives each.

        Args:
            beside_torch: on the calling thread alone, because another one computes with torch.
        """
        raise NotImplementedError

    def take_drawn(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator) -> Batch:
        """`take` in training: the next batch that was made ahead, if there are any."""
        if self.made is None:
            return self.take_all([(index, rng)])[0]
        before, after, batch = self.made.popleft()
        assert rng.bit_generator.state == before, "the batches made ahead are not those that are asked for"
        rng.bit_generator.state = after.bit_generator.state
        return batch


TracedT = TypeVar("TracedT", bound=TracedPixels)


def made_ahead(
    pixels: TracedT, draw: Callable[[int], list[np.random.Generator]], steps: range, *, size: int
) -> Generator[TracedT, None, None]:
    """The pixels for each step; a second thread traces their batches during the step before, while torch computes.

    Each batch has a generator of its own, so a run that is resumed at any step gets the same batches.

    Args:
        draw: fresh generators of a step's batches, by step.
        size: pixels in each batch.
    """

    def make(step: int) -> deque[tuple[object, np.random.Generator, object]]:
        draws = [(torch.from_numpy(draw_rows(pixels, size, rng)), rng) for rng in draw(step)]
        before = [rng.bit_generator.state for _, rng in draws]
        batches = pixels.take_all(draws, beside_torch=True)
        return deque((state, rng, batch) for state, (_, rng), batch in zip(before, draws, batches, strict=True))

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="trace ahead") as thread:
        coming = thread.submit(make, steps.start)
        for step in steps:
            now = coming
            if step + 1 < steps.stop:
                coming = thread.submit(make, step + 1)
            yield dataclasses.replace(pixels, made=now.result())


SourceT = TypeVar("SourceT", bound=PixelSource)


def load_views_of(
    make: Callable[[Cameras], SourceT], dataset: Dataset, split: Split, views: Sequence[int], *, with_images: bool
) -> SourceT:
    """The pixels of some views as `make` gives those of any cameras; with images, in their true colours."""
    source = make(cameras_of(dataset, split, views))
    return dataclasses.replace(source, rgb=read_colors(dataset, split, views)) if with_images else source


def cameras_of(dataset: Dataset, split: Split, views: Sequence[int]) -> Cameras:
    """The cameras of some views of a split."""
    cameras = dataset.cameras(split)
    return dataclasses.replace(cameras, world_from_camera=cameras.world_from_camera[list(views)])


def draw_rows(pixels: PixelSource, number: int, rng: np.random.Generator) -> Int[np.ndarray, " pixel"]:
    """Row numbers of random pixels."""
    return rng.integers(len(pixels.rgb), size=number)


Rays = tuple[Float32[np.ndarray, "ray 3"], Float32[np.ndarray, "ray 3"]]
"""Origins and unit directions."""


def rays_through(
    cameras: Cameras, index: Int[np.ndarray, " pixel"], samples: int, rng: np.random.Generator | None
) -> Rays:
    """Origins and unit directions of `samples` (a square number) rays through each of the pixels, pixel by pixel.

    They lie in the cells of a grid that tiles the pixel: at their centres, or jittered in them by `rng`.
    """
    shape = (len(index), samples, 2)
    offsets = subpixel_offsets(samples) if rng is None else subpixel_offsets(samples, rng.random(shape))
    return subpixel_rays(cameras, index, np.broadcast_to(offsets, shape))


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


def read_colors(dataset: Dataset, split: Split, views: Sequence[int]) -> UInt8[Tensor, "pixel 3"]:
    """All pixels of the views."""
    return torch.from_numpy(np.concatenate([dataset.view(split, view).image.reshape(-1, 3) for view in views]))


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


def insert_empty_layer(rays: RayBatch, rng: np.random.Generator | None) -> RayBatch:
    """The rays with one more, empty layer: at a random position in each ray, or after all others without `rng`.

    An empty layer's features and extrinsics are zeros, so this is the paper's random zero layer (section 4.4).
    """
    num_rays, num_layers = rays.object_id.shape
    places = np.full(num_rays, num_layers) if rng is None else rng.integers(num_layers + 1, size=num_rays)
    place = to_device({"place": places}, rays.object_id.device)["place"]
    padded_id = torch.cat([rays.object_id, rays.object_id.new_zeros(num_rays, 1)], dim=1)
    padded_uv = torch.cat([rays.uv, rays.uv.new_zeros(num_rays, 1, 2)], dim=1)
    layer = torch.arange(num_layers + 1, device=place.device)[None]
    source = torch.where(layer == place[:, None], num_layers, layer - (layer > place[:, None]).long())
    uv = padded_uv.gather(1, source[..., None].expand(-1, -1, 2))
    return dataclasses.replace(rays, uv=uv, object_id=padded_id.gather(1, source))


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
