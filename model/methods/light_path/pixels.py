"""The pixels of some views, with the light paths of their rays traced for every batch."""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, UInt8
from torch import Tensor

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import GeometryKey, geometry_key, read_meshes
from datagen.data.meshes import Mesh, r2_steps
from datagen.data.paths import follows_light
from datagen.machine.mitsuba_variant import short_lived_workers, use_mitsuba
from datagen.trace.surface_tables import Limits
from model.batches.rays import black, read_colors
from model.batches.traced_layers import RayPixels, SubpixelRays, cameras_of, in_pairs
from model.methods.light_path.config import LightPathConfig, default_light_path

if TYPE_CHECKING:
    from datagen.trace.light_path import LightPathTracer, TracedPaths


STACKED_VERTICES = (4, 2)
"""Vertices of the refracted and of the first mirror branch that the stack network sees."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ends:
    """The opaque vertices on which branches end."""

    ray: Int[Tensor, " end"]
    """Index of the ray; a ray has one end for each branch that ends on a surface."""
    surface: UInt8[Tensor, " end"]
    """Texture to look up: shell k of n of object i is surface (i - 1) n + k + 1. Paths meet the outermost shell."""
    uv: Float32[Tensor, "end 2"]
    position: Float32[Tensor, "end 3"]
    throughput: Float32[Tensor, "end 3"]
    cosine: Float32[Tensor, " end"]
    """Cosine of the angle between the arriving ray and the surface normal, 0 to 1."""
    reflected: Float32[Tensor, "end 3"]
    """The arriving direction, mirrored at the surface."""
    uv_slope: Float32[Tensor, "end 2"]
    """Change of uv per metre of depth below the surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sky:
    """The branches that leave the scene."""

    ray: Int[Tensor, " exit"]
    direction: Float32[Tensor, "exit 3"]
    throughput: Float32[Tensor, "exit 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Stack:
    """The first vertices of each ray's paths, then its straight layers."""

    surface: UInt8[Tensor, "ray slot"]
    """As in `Ends`, for every shell; 0 where there is no vertex."""
    uv: Float32[Tensor, "ray slot 2"]
    throughput: Float32[Tensor, "ray slot"]
    """Mean over the colour channels."""
    cosine: Float32[Tensor, "ray slot"]
    direction: Float32[Tensor, "ray 3"]
    """Direction of the camera's ray."""
    position: Float32[Tensor, "ray straight 3"] | None
    """Hit point of each straight layer; None without straight layers."""
    reflected: Float32[Tensor, "ray straight 3"] | None
    """The ray's direction, mirrored at the surface of each straight layer."""
    uv_slope: Float32[Tensor, "ray straight 2"] | None
    """Change of uv per metre of depth below the surface of each straight layer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPathBatch:
    """The light paths of some pixels: `samples` rays for each, pixel by pixel."""

    num_pixels: int
    samples: int
    ends: Ends
    sky: Sky
    stack: Stack | None


COUNTED_PIXELS = 4096
"""Pixels that decide the sizes of textures."""


MAX_TEXTURE_SIZE = 2048

MANY_RAYS = 65_536
"""Rays that are traced at once where memory is the limit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPathPixels(RayPixels):
    """All pixels of some views; the light paths of their rays are traced when they are asked for."""

    tracer: "LightPathTracer"
    straight_tracer: "LightPathTracer | None"
    """The same surfaces, all passed in a straight line; None if the configuration has no straight layers."""
    is_opaque: Bool[np.ndarray, "object"]
    """By object id: True if paths end on it; False for id 0, which means empty."""
    config: LightPathConfig

    @property
    def chunk(self) -> int:
        """Pixels rendered at once."""
        return max(1, MANY_RAYS // self.config.render_samples)

    def refined(self) -> "LightPathPixels":
        """The same pixels with `refined_samples` rays each."""
        samples = self.config.refined_samples
        return dataclasses.replace(self, config=dataclasses.replace(self.config, render_samples=samples))

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> LightPathBatch:
        """The paths of the rays through these pixels; without `rng`, as many rays as for rendering."""
        config = self.config
        pixels = index.flatten().cpu().numpy()
        samples, seed, facets = config.render_samples, 0, None
        if rng is None:
            origins, directions = self.rays.through(pixels, samples, None)
        else:
            samples, seed = config.train_samples, int(rng.integers(1 << 31))
            through = self.rays.through_pairs if config.paired_rays else self.rays.through
            origins, directions = through(pixels, samples, rng)
            facets = self._facets(len(pixels), samples, rng)
        # Only the ends of branches are needed: one place holds the last vertex.
        with short_lived_workers():
            limits = Limits(max_branches=config.branches, max_vertices=1)
            paths = self.tracer.trace_colors(origins, directions, limits, seed=seed, facets=facets)
            stack = self._stack(origins, directions, seed, facets) if config.stack_hidden else None
        return LightPathBatch(
            num_pixels=index.numel(), samples=samples, ends=self._ends(paths), sky=self._sky(paths), stack=stack
        )

    def _facets(self, num_pixels: int, samples: int, rng: np.random.Generator) -> Float32[np.ndarray, "ray 2"]:
        """Random numbers by which each pixel's rays choose facets of rough surfaces: in pairs half a period apart, or
        all spread evenly, as in rendering."""

        if self.config.paired_rays:
            first = rng.random((num_pixels, -(-samples // 2), 2))
            points = in_pairs(first, lambda place: (place + 0.5) % 1)[:, :samples]
        else:
            points = (rng.random((num_pixels, 1, 2)) + r2_steps(samples)) % 1
        return points.reshape(-1, 2).astype(np.float32)

    def _ends(self, paths: "TracedPaths") -> Ends:
        branch, ray = np.nonzero(~paths.has_left & self.is_opaque[paths.object_id[:, 0]])
        place = (branch, 0, ray)
        cosine, reflected = _mirrored(paths.direction[place], paths.normal[place])
        return Ends(
            ray=self._tensor(ray),
            surface=self._tensor(_surface_of(paths.object_id[place], self.config.shells)),
            uv=self._tensor(paths.uv[place]),
            position=self._tensor(paths.position[place]),
            throughput=self._tensor(paths.throughput[place]),
            cosine=self._tensor(cosine),
            reflected=self._tensor(reflected),
            uv_slope=self._tensor(paths.uv_slope[place]),
        )

    def _sky(self, paths: "TracedPaths") -> Sky:
        place = np.nonzero(paths.has_left)
        return Sky(
            ray=self._tensor(place[1]),
            direction=self._tensor(paths.end_direction[place]),
            throughput=self._tensor(paths.end_throughput[place]),
        )

    def _stack(self, origins: np.ndarray, directions: np.ndarray, seed: int, facets: np.ndarray | None) -> Stack:
        # With the paths' own facets: if a pixel's facets were always spread evenly, its ray pairs would not be
        # independent, and `--debias` would reward the network for contrasts that cancel between them.
        limits = Limits(len(STACKED_VERTICES), max_vertices=max(STACKED_VERTICES), max_depth=max(STACKED_VERTICES))
        paths = self.tracer.trace(origins, directions, limits, seed=seed, facets=facets)
        places = [(branch, vertex) for branch, count in enumerate(STACKED_VERTICES) for vertex in range(count)]
        slots = [_slot(paths, *place) for place in places]
        for slot in slots:
            slot["surface"] = _surface_of(slot["surface"], self.config.shells)
        straight_layers = []
        if self.config.straight_layers:
            assert self.straight_tracer is not None
            straight = _straight(self.straight_tracer, origins, directions, self.config.straight_layers)
            straight_layers = [_slot(straight, 0, layer) for layer in range(self.config.straight_layers)]
        slots += straight_layers

        def column(key: str, slots: list[dict[str, np.ndarray]]) -> Tensor:
            return self._tensor(np.stack([slot[key] for slot in slots], axis=1))

        return Stack(
            surface=column("surface", slots),
            uv=column("uv", slots),
            throughput=column("throughput", slots),
            cosine=column("cosine", slots),
            direction=self._tensor(directions),
            position=column("position", straight_layers) if straight_layers else None,
            reflected=column("reflected", straight_layers) if straight_layers else None,
            uv_slope=column("uv_slope", straight_layers) if straight_layers else None,
        )

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)


def share_texels(dataset: Dataset, geometry: str, size: int) -> tuple[int, ...]:
    """Widths of the objects' textures: about `size` squared texels for each, shared as the training rays need them.

    An object where many paths end (a floor) gets a wide texture, one seen in few pixels a narrow one, but at least a
    third of `size`; one where no path ends (glass) gets an eighth. On proxies, straight hits count, too.
    """
    pixels = load_light_path_pixels(
        default_light_path((2,) * len(dataset.objects), is_proxy=not follows_light(geometry)),
        dataset,
        geometry,
        "train",
        range(dataset.config.train.views),
        False,
    )
    return texel_widths(pixels, len(dataset.objects), size)


def texel_widths(pixels: LightPathPixels, num_objects: int, size: int) -> tuple[int, ...]:
    """`share_texels` for the rays of some pixels."""
    index = np.random.default_rng(0).integers(len(pixels.rgb), size=COUNTED_PIXELS)
    batch = pixels.take(torch.from_numpy(index), None)
    met = [batch.ends.surface]
    if pixels.config.straight_layers:
        assert batch.stack is not None
        met.append(batch.stack.surface[:, sum(STACKED_VERTICES) :].flatten())
    surfaces = torch.cat(met).long()
    # The textures of a proxy's shells are as wide as its own.
    objects = (surfaces[surfaces > 0] - 1) // pixels.config.shells
    counts = torch.bincount(objects, minlength=num_objects)
    share = counts.double() / counts.sum().clamp_min(1)
    wanted = (share * len(share)).sqrt() * size
    least = torch.where(share > 0, size // 3, size // 8).clamp_min(2)
    return tuple(int(width) for width in wanted.maximum(least).clamp_max(MAX_TEXTURE_SIZE).round())


def load_light_path_pixels(
    config: LightPathConfig, dataset: Dataset, geometry: str, split: Split, views: Sequence[int], with_images: bool
) -> LightPathPixels:
    """Reads cameras and, with `with_images`, pictures of some views, and loads the scene for tracing."""
    pixels = trace_light_paths(config, dataset, geometry, cameras_of(dataset, split, views))
    return dataclasses.replace(pixels, rgb=read_colors(dataset, split, views, with_images=with_images))


def trace_light_paths(config: LightPathConfig, dataset: Dataset, geometry: str, cameras: Cameras) -> LightPathPixels:
    """The pixels of any cameras, black, with the scene loaded for tracing."""
    surfaces = _load_surfaces(geometry_key(dataset, geometry), config.shells if config.straight_layers else 0)
    return LightPathPixels(
        tracer=surfaces.tracer,
        straight_tracer=surfaces.straight_tracer,
        rays=SubpixelRays(cameras=cameras),
        is_opaque=surfaces.is_opaque,
        rgb=black(cameras),
        config=config,
        device=torch.device("cpu"),
    )


def nest_shells(meshes: tuple[Mesh, ...], shells: int) -> tuple[Mesh, ...]:
    """Each mesh, then smaller copies of it about the centre of its bounding box, 1 - k / shells as large for copy k."""
    return tuple(_scaled(mesh, 1 - copy / shells) for mesh in meshes for copy in range(shells))


def _scaled(mesh: Mesh, scale: float) -> Mesh:
    if scale == 1 or not len(mesh.vertices):  # A removed object has an empty mesh.
        return mesh
    center = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return dataclasses.replace(mesh, vertices=center + np.float32(scale) * (mesh.vertices - center))


def _slot(paths: "TracedPaths", branch: int, vertex: int) -> dict[str, np.ndarray]:
    """Inputs of the stack network at one vertex of all rays."""
    cosine, reflected = _mirrored(paths.direction[branch, vertex], paths.normal[branch, vertex])
    return {
        "surface": paths.object_id[branch, vertex],
        "uv": paths.uv[branch, vertex],
        "throughput": paths.throughput[branch, vertex].mean(axis=-1),
        "cosine": cosine,
        "position": paths.position[branch, vertex],
        "reflected": reflected,
        "uv_slope": paths.uv_slope[branch, vertex],
    }


def _surface_of(object_id: UInt8[np.ndarray, " vertex"], shells: int) -> UInt8[np.ndarray, " vertex"]:
    """The outermost shell of each object; 0 stays 0."""
    return np.where(object_id > 0, (object_id.astype(np.int64) - 1) * shells + 1, 0).astype(np.uint8)


def _mirrored(
    direction: Float32[np.ndarray, "vertex 3"], normal: Float32[np.ndarray, "vertex 3"]
) -> tuple[Float32[np.ndarray, " vertex"], Float32[np.ndarray, "vertex 3"]]:
    """The cosine, in [0, 1], at which rays arrive at surfaces, and their directions mirrored there."""
    cosine = -np.einsum("vc,vc->v", direction, normal)
    return np.clip(cosine, 0, 1), direction + 2 * cosine[:, None] * normal


def _straight(tracer: "LightPathTracer", origins: np.ndarray, directions: np.ndarray, num_layers: int) -> "TracedPaths":
    return tracer.trace(origins, directions, Limits(1, max_vertices=num_layers, max_depth=num_layers))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Surfaces:
    """The loaded part of `LightPathPixels`."""

    tracer: "LightPathTracer"
    straight_tracer: "LightPathTracer | None"
    is_opaque: Bool[np.ndarray, "object"]


# Training, scoring and prediction use the same surfaces: they are loaded once, and their kernels are recorded once.
@functools.lru_cache(maxsize=1)
def _load_surfaces(key: GeometryKey, shells: int) -> _Surfaces:
    from datagen.scene.folder import load_scene_as

    # The tracer's module can be imported only when Mitsuba has its variant.
    use_mitsuba()
    from datagen.trace.light_path import LightPathTracer
    from datagen.trace.surface_tables import tints_of

    scene = load_scene_as(key.dataset, key.geometry)
    materials = tuple(item.material for item in scene.objects)
    tints = tints_of(scene, own_uv=follows_light(key.geometry))
    meshes = read_meshes(key.dataset, key.geometry)
    nested = nest_shells(meshes, shells)
    return _Surfaces(
        tracer=LightPathTracer(meshes, materials, tints),
        straight_tracer=LightPathTracer(nested, (None,) * len(nested)) if nested else None,
        is_opaque=np.array([False, *(not material.is_glass for material in materials)]),
    )
