"""Owns the light paths of training and test pixels: sub-pixel rays, traced anew for every batch, as tensors."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from datagen.cameras import subpixel_offsets, subpixel_rays
from datagen.dataset import Cameras, Dataset, Split, read_cameras, read_image
from datagen.errors import HyalineError
from datagen.geometry import TRUTH, read_meshes
from model.light_path_net import LightPathBatch, LightPathConfig

if TYPE_CHECKING:
    from datagen.light_path import LightPathTracer


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPathPixels:
    """All pixels of some views, row by row and view by view; their rays are traced when they are asked for."""

    tracer: "LightPathTracer"
    cameras: Cameras
    """Those of the views alone."""
    is_opaque: Bool[np.ndarray, "object"]
    """By object id; True where a path ends. Id 0, the empty one, is not."""
    rgb: UInt8[Tensor, "pixel 3"]
    pixels_per_view: int
    max_vertices: int
    train_samples: int
    """Rays per pixel, jittered at random, while training."""
    render_samples: int
    """Rays per pixel, on a regular grid, otherwise."""
    device: torch.device

    @property
    def chunk(self) -> int:
        """Pixels that a rendering takes at once."""
        return max(1, 65_536 // self.render_samples)

    def to(self, device: torch.device) -> "LightPathPixels":
        return dataclasses.replace(self, rgb=self.rgb.to(device), device=device)

    def take(self, index: Int[Tensor, " pixel"], rng: np.random.Generator | None) -> LightPathBatch:
        """The traced rays of the pixels with these row numbers; without `rng` as many as a rendering takes."""
        samples = self.train_samples if rng is not None else self.render_samples
        shape = (len(index), samples, 2)
        offsets = subpixel_offsets(samples) if rng is None else subpixel_offsets(samples, rng.random(shape))
        origins, directions = subpixel_rays(self.cameras, index.cpu().numpy(), np.broadcast_to(offsets, shape))
        paths = self.tracer.trace(origins, directions, self.max_vertices)
        last = (paths.object_id > 0).sum(axis=1, keepdims=True) - 1
        vertex = np.arange(self.max_vertices)[None, :, None]
        is_end = (vertex == last) & self.is_opaque[paths.object_id]
        cosine = -np.einsum("bvrc,bvrc->bvr", paths.direction, paths.normal)
        reflected = paths.direction + 2 * cosine[..., None] * paths.normal

        def tensor(values: np.ndarray, *order: int) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values.transpose(*order))).to(self.device)

        return LightPathBatch(
            samples=samples,
            object_id=tensor(paths.object_id, 2, 0, 1),
            uv=tensor(paths.uv, 2, 0, 1, 3),
            throughput=tensor(paths.throughput, 2, 0, 1, 3),
            cosine=tensor(np.clip(cosine, 0, 1), 2, 0, 1),
            reflected=tensor(reflected, 2, 0, 1, 3),
            is_end=tensor(is_end, 2, 0, 1),
            end_direction=tensor(paths.end_direction, 1, 0, 2),
            end_throughput=tensor(paths.end_throughput, 1, 0, 2),
        )


def load_light_path_pixels(config: LightPathConfig, dataset: Dataset, geometry: str, split: Split,
                           views: Sequence[int], with_images: bool) -> LightPathPixels:  # fmt: skip
    """Reads cameras and (unless told otherwise) images of some views, and loads the scene for tracing.

    Raises:
        HyalineError: the geometry is a proxy, whose surface would bend light elsewhere.
    """
    if geometry != TRUTH:
        raise HyalineError(f"geometry {geometry!r}: light paths need the true one; train `--method paper` on proxies")
    from datagen.scene import is_glass, load_scene
    from datagen.variant import use_mitsuba

    use_mitsuba()
    from datagen.light_path import LightPathTracer

    materials = tuple(item.material for item in load_scene(dataset.root / "scene").objects)
    cameras = read_cameras(dataset, split)
    size = dataset.config.resolution
    images = [
        read_image(dataset, split, view) if with_images else np.zeros((size, size, 3), np.uint8) for view in views
    ]
    return LightPathPixels(
        tracer=LightPathTracer(read_meshes(dataset, geometry), materials),
        cameras=Cameras(
            world_from_camera=cameras.world_from_camera[list(views)],
            fov_x=cameras.fov_x,
            width=cameras.width,
            height=cameras.height,
        ),
        is_opaque=np.array([False, *(not is_glass(material) for material in materials)]),
        rgb=torch.from_numpy(np.concatenate([image.reshape(-1, 3) for image in images])),
        pixels_per_view=size * size,
        max_vertices=config.max_vertices,
        train_samples=config.train_samples,
        render_samples=config.render_samples,
        device=torch.device("cpu"),
    )
