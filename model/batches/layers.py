"""Pixels with the straight layers along their rays: stored ones, or traced for every batch."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float32, Int, Int16, UInt8, UInt16
from torch import Tensor

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import geometry_key
from datagen.data.layers import UV_SCALE
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import short_lived_workers
from datagen.quantities import peeler_of
from model.batches.rays import PixelSource, RayBatch, black, cameras_of, rays_through, read_colors, to_device

if TYPE_CHECKING:
    from datagen.trace.peel import Peeler


@dataclass(frozen=True, kw_only=True, eq=False)
class Pixels(PixelSource[RayBatch]):
    """Pixels with their stored layers, in the dataset's own small integers."""

    uv: Int16[Tensor, "pixel layer 2"]
    """The bits of uint16, because torch 2.13 has few operations on that type."""
    object_id: UInt8[Tensor, "pixel layer"]

    @cached_property
    def p_camera(self) -> Float32[Tensor, "view 3"]:
        """Camera centres in world space, metres."""
        return torch.from_numpy(self.cameras.world_from_camera[:, :3, 3].astype(np.float32)).to(self.device)

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> RayBatch:  # noqa: ARG002
        """The rays of the pixels with these row numbers: always those through pixel centres."""
        grid = self.grid_of(index)
        index = index.flatten()
        return RayBatch(
            # `index_select` takes a third of the time of brackets.
            uv=(self.uv.index_select(0, index).int() & 0xFFFF).float() / UV_SCALE,
            object_id=self.object_id.index_select(0, index),
            p_camera=self.p_camera.index_select(0, index // self.pixels_per_view),
            grid=grid,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedLayerPixels(PixelSource[RayBatch]):
    """Pixels whose rays' layers are traced when a batch asks for them."""

    peeler: "Peeler"
    num_layers: int
    train_samples: int = 1
    render_samples: int = 1

    @property
    def chunk(self) -> int:
        return max(1, 65_536 // self.render_samples)

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> RayBatch:
        """The layers of the rays through these pixels; without `rng`, as many rays as for rendering."""

        samples = self.train_samples if rng is not None else self.render_samples
        origins, directions = rays_through(self.cameras, index.flatten().cpu().numpy(), samples, rng)
        with short_lived_workers():
            uv, object_id = self.peeler.peel_rays(origins, directions, self.num_layers)
        return RayBatch(
            **to_device({"uv": uv, "object_id": object_id, "p_camera": origins}, self.device),
            samples=samples,
            grid=self.grid_of(index),
        )


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
    store = dataset.layer_store(geometry)
    stacks = []
    for view in views:
        layers = store.read(split, view, only=["uv", "object_id"])
        if (most := layers["object_id"].max(initial=0)) > len(dataset.objects):
            raise HyalineError(
                f"{dataset.root}: layers of {geometry}, {split} view {view}, name object {most}; "
                f"expected at most {len(dataset.objects)}, peel it again"
            )
        # Two planes of uv are stored.
        stacks.append((np.moveaxis(layers["uv"], 0, -1)[:max_layers], layers["object_id"][:max_layers]))
    pixels = _stored(cameras_of(dataset, split, views), stacks, whole_views=whole_views)
    return dataclasses.replace(pixels, rgb=read_colors(dataset, split, views)) if with_images else pixels


def _stored(
    cameras: Cameras,
    stacks: Sequence[tuple[UInt16[np.ndarray, "layer h w 2"], UInt8[np.ndarray, "layer h w"]]],
    *,
    whole_views: bool,
) -> Pixels:
    """Black pixels with the uv and object ids of their views' layers."""
    num_layers = len(stacks[0][1])
    # Contiguous layers per pixel: otherwise a random batch misses the cache once per layer.
    uv = np.concatenate([np.moveaxis(uv, 0, 2).reshape(-1, num_layers, 2) for uv, _ in stacks])
    object_id = np.concatenate([np.moveaxis(object_id, 0, 2).reshape(-1, num_layers) for _, object_id in stacks])
    return Pixels(
        cameras=cameras,
        rgb=black(cameras),
        uv=torch.from_numpy(uv.view(np.int16)),
        object_id=torch.from_numpy(object_id),
        whole_views=whole_views,
    )


def peel_cameras(
    dataset: Dataset, geometry: str, num_layers: int, cameras: Cameras, *, whole_views: bool = False
) -> Pixels:
    """The pixels of any cameras, black, with the layers that `datagen peel` would store for them.

    Args:
        whole_views: the renderer needs neighbouring pixels.
    """

    peeler = peeler_of(geometry_key(dataset, geometry))
    with short_lived_workers():
        views = [peeler.peel(cameras, view, num_layers)[0] for view in range(len(cameras))]
    return _stored(cameras, [(layers.uv, layers.object_id) for layers in views], whole_views=whole_views)


def trace_cameras(
    dataset: Dataset, geometry: str, num_layers: int, cameras: Cameras, *, train_samples: int, render_samples: int
) -> TracedLayerPixels:
    """The pixels of any cameras, black, with the surfaces loaded for tracing."""
    return TracedLayerPixels(
        cameras=cameras,
        rgb=black(cameras),
        peeler=peeler_of(geometry_key(dataset, geometry)),
        num_layers=num_layers,
        train_samples=train_samples,
        render_samples=render_samples,
    )
