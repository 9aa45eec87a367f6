"""Owns stored light paths: which rays of a view are traced, and their arrays on disk (beside them: layer_store.py).

    LAYERS/peels.zarr/SPLIT/
      object_id         (view, branch, vertex, y, x) uint8: 0 = no vertex
      uv                (view, branch, vertex, 2, y, x) uint16: u, v times 65535; error 7.6e-6
      direction         (view, branch, vertex, 2, y, x) int16: octahedral, times 32767; error 6.5e-5 rad
      position          (view, branch, vertex, 3, y, x) float32 of 16 mantissa bits: metres; relative error 7.7e-6
      normal            (view, branch, vertex, 2, y, x) int16: octahedral, times 32767; error 6.5e-5 rad
      throughput        (view, branch, vertex, 3, y, x) float16: relative error 4.9e-4, or 3e-8
      medium_length     (view, branch, vertex, y, x) float32 of 16 mantissa bits: metres; relative error 7.7e-6
      has_left          (view, branch, y, x) bool
      end_direction     (view, branch, 2, y, x) int16: as `direction`
      end_throughput    (view, branch, 3, y, x) float16: as `throughput`

LAYERS is layers/light-path of a geometry; the quantities are those of `trace.light_path.LightPaths`. All are 0 where
there is no vertex, or where the branch has not left.

Each pixel has `samples` = side^2 rays, one through the centre of each cell of a regular grid. Together they are the
pixel-centre rays of a picture `side` times as wide and high, and so they are stored, for neighbours compress well: ray
(a, b) of the pixel in row i and column j is at y = side i + a, x = side j + b. It passes through the pixel (a + 1/2) /
side below and (b + 1/2) / side right of its corner (`subpixel_offsets`).

One chunk a vertex; one of nothing but zeros takes 16 bytes. A view of glass_table at 128 x 128 with 4 rays a pixel (2.1
vertices a ray, of 2 branches with 8 places each) takes 1.8 MB (1.4 to 2.2), two fifths of them for positions, and is
read in 0.2 s; of 4 branches it takes 3.2 MB.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float16, Float32, Shaped

from datagen.data.cameras import Cameras, subpixel_offsets, subpixel_rays
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.layer_store import LAYERS_VERSION, LightPathsHead
from datagen.data.layer_writing import ArrayFormat, create_store, write_view
from datagen.data.number_formats import UV_SCALE, decode_directions, encode_directions, quantize_uv, round_mantissa
from datagen.trace.light_path import LightPaths

if TYPE_CHECKING:
    from datagen.trace.light_path import LightPathTracer

NUM_BRANCHES = 4
"""Branches that a new store keeps."""

MAX_DEPTH = 24
"""Surfaces after which a branch of a new store is given up."""

BLOCK_RAYS = 1 << 18
"""Rays that are traced at once: bounds the memory that whole floats take."""


@dataclass(frozen=True, kw_only=True)
class _Quantity:
    """How one field of `LightPaths` is stored: values of `(any, *components)` one way and back."""

    dtype: str
    components: tuple[str, ...]
    """Name of the axis of components, if there is one."""
    encode: Callable[[np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]


def _plain(dtype: str) -> _Quantity:
    return _Quantity(dtype=dtype, components=(), encode=np.asarray, decode=np.asarray)


def _to_half(values: Float32[np.ndarray, "..."]) -> Float16[np.ndarray, "..."]:
    return np.minimum(values, np.finfo(np.float16).max).astype(np.float16)


_UV = _Quantity(
    dtype="uint16", components=("uv",), encode=quantize_uv, decode=lambda codes: codes.astype(np.float32) / UV_SCALE
)
_DIRECTION = _Quantity(dtype="int16", components=("octahedral",), encode=encode_directions, decode=decode_directions)
_POSITION = _Quantity(dtype="float32", components=("xyz",), encode=round_mantissa, decode=np.asarray)
_LENGTH = _Quantity(dtype="float32", components=(), encode=round_mantissa, decode=np.asarray)
_THROUGHPUT = _Quantity(
    dtype="float16", components=("rgb",), encode=_to_half, decode=lambda halves: halves.astype(np.float32)
)

AT_VERTICES = {
    "object_id": _plain("uint8"),
    "uv": _UV,
    "direction": _DIRECTION,
    "position": _POSITION,
    "normal": _DIRECTION,
    "throughput": _THROUGHPUT,
    "medium_length": _LENGTH,
}
AT_ENDS = {"has_left": _plain("bool"), "end_direction": _DIRECTION, "end_throughput": _THROUGHPUT}

NUM_COMPONENTS = {"uv": 2, "octahedral": 2, "xyz": 3, "rgb": 3}


def create_light_paths(
    dataset: Dataset,
    geometry: str,
    *,
    num_branches: int,
    max_vertices: int,
    samples: int,
    geometry_hash: str,
    replace: bool = False,
) -> None:
    """Lays out an empty store."""
    head = LightPathsHead(
        version=LAYERS_VERSION,
        kind="light-path",
        geometry=geometry_hash,
        num_branches=num_branches,
        max_vertices=max_vertices,
        max_depth=MAX_DEPTH,
        samples=samples,
        files={},
    )
    create_store(dataset, geometry, head, _formats(head, dataset.config.resolution), replace=replace)


def trace_view(tracer: "LightPathTracer", cameras: Cameras, view: int, head: LightPathsHead) -> Iterator[LightPaths]:
    """The paths of a view's rays, pixel by pixel, in blocks of whole rows from the top."""
    samples = head.samples
    offsets = subpixel_offsets(samples)
    width, height = cameras.width, cameras.height
    rows = max(1, BLOCK_RAYS // (width * samples))
    for first in range(0, height, rows):
        pixel = width * height * view + np.arange(width * first, width * min(first + rows, height))
        rays = subpixel_rays(cameras, pixel, np.broadcast_to(offsets, (len(pixel), samples, 2)))
        yield tracer.trace(
            *rays, max_branches=head.num_branches, max_vertices=head.max_vertices, max_depth=head.max_depth
        )


def read_light_paths_head(dataset: Dataset, geometry: str) -> LightPathsHead:
    """How a geometry's light paths were traced."""
    head = dataset.layer_store(geometry, "light-path").head
    assert isinstance(head, LightPathsHead)
    return head


def write_light_paths(dataset: Dataset, geometry: str, split: Split, view: int, blocks: Iterable[LightPaths]) -> None:
    """Commits one view's paths, given as `trace_view` yields them."""
    head = read_light_paths_head(dataset, geometry)
    size = dataset.config.resolution
    side = math.isqrt(head.samples)
    values = {name: np.zeros(array.shape, array.dtype) for name, array in _formats(head, size).items()}
    num_rays = num_cut = 0
    for paths in blocks:
        assert paths.object_id.shape[:2] == (head.num_branches, head.max_vertices), "as the store was laid out"
        y = num_rays // (side * size)
        for name, block in _encode(paths).items():
            picture = _rays_to_picture(block, size, side)
            values[name][..., y : y + picture.shape[-2], :] = picture
        num_rays += paths.object_id.shape[-1]
        num_cut += int(_is_cut(dataset, paths).any(axis=0).sum())
    assert num_rays == head.samples * size**2, "the blocks are a whole view"
    write_view(dataset, geometry, "light-path", split, view, values, overflow_share=num_cut / num_rays)


def read_light_paths(dataset: Dataset, geometry: str, split: Split, view: int) -> LightPaths:
    """One view's paths, every byte verified: `samples` consecutive rays for each pixel, pixels row by row."""
    head = read_light_paths_head(dataset, geometry)
    arrays = dataset.layer_store(geometry, "light-path").read(split, view)
    return _decode({name: _picture_to_rays(values, math.isqrt(head.samples)) for name, values in arrays.items()})


def _formats(head: LightPathsHead, resolution: int) -> dict[str, ArrayFormat]:
    """What a view's arrays look like."""
    size = math.isqrt(head.samples) * resolution
    formats = {}
    for name, quantity in (AT_VERTICES | AT_ENDS).items():
        outer = {"branch": head.num_branches, "vertex": head.max_vertices}
        if name in AT_ENDS:
            del outer["vertex"]
        inner = {axis: NUM_COMPONENTS[axis] for axis in quantity.components} | {"y": size, "x": size}
        formats[name] = ArrayFormat(
            dtype=quantity.dtype,
            axes=(*outer, *inner),
            shape=(*outer.values(), *inner.values()),
            chunk=(*(1 for _ in outer), *inner.values()),
        )
    return formats


def _encode(paths: LightPaths) -> dict[str, Shaped[np.ndarray, "... ray"]]:
    """What is stored of a bundle of rays; 0 where there is nothing."""
    encoded = {}
    for quantities, mask in ((AT_VERTICES, paths.object_id > 0), (AT_ENDS, paths.has_left)):
        for name, quantity in quantities.items():
            values = _scatter(quantity.encode(getattr(paths, name)[mask]), mask)
            encoded[name] = np.moveaxis(values, -1, -2) if quantity.components else values
    return encoded


def _decode(encoded: dict[str, Shaped[np.ndarray, "... ray"]]) -> LightPaths:
    """The inverse of `_encode`."""
    decoded = {}
    for quantities, mask in ((AT_VERTICES, encoded["object_id"] > 0), (AT_ENDS, encoded["has_left"])):
        for name, quantity in quantities.items():
            values = np.moveaxis(encoded[name], -2, -1) if quantity.components else encoded[name]
            decoded[name] = _scatter(quantity.decode(values[mask]), mask)
    return LightPaths(**decoded)


def _scatter(values: Shaped[np.ndarray, "hit *components"], mask: Bool[np.ndarray, "*shape"]) -> np.ndarray:
    """(*shape, *components): the values where the mask is set, 0 elsewhere."""
    scattered = np.zeros((*mask.shape, *values.shape[1:]), values.dtype)
    scattered[mask] = values
    return scattered


def _rays_to_picture(
    values: Shaped[np.ndarray, "*outer ray"], width: int, side: int
) -> Shaped[np.ndarray, "*outer y x"]:
    """Rays of whole rows of pixels, pixel by pixel, as rows of a picture `side` times as wide."""
    grid = values.reshape(*values.shape[:-1], -1, width, side, side)  # Row, column, row and column in the pixel.
    rows = grid.shape[-4]
    return np.moveaxis(grid, -2, -3).reshape(*values.shape[:-1], rows * side, width * side)


def _picture_to_rays(values: Shaped[np.ndarray, "*outer y x"], side: int) -> Shaped[np.ndarray, "*outer ray"]:
    """The inverse of `_rays_to_picture`."""
    height, width = (size // side for size in values.shape[-2:])
    grid = values.reshape(*values.shape[:-2], height, side, width, side)
    return np.moveaxis(grid, -3, -2).reshape(*values.shape[:-2], -1)


def _is_cut(dataset: Dataset, paths: LightPaths) -> Bool[np.ndarray, "branch ray"]:
    """Branches that are neither ended by an opaque surface nor in the open: they were given up."""
    is_glass = np.array([False, *(item.is_glass for item in dataset.objects)])
    last = np.maximum((paths.object_id > 0).sum(axis=1, keepdims=True) - 1, 0)
    last_id = np.take_along_axis(paths.object_id, last, axis=1)[:, 0]
    return is_glass[last_id] & ~paths.has_left
