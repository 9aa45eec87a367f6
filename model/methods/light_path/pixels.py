"""The pixels of some views, with the light paths of their rays traced for every batch."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from datagen.data.cameras import Cameras, subpixel_offsets, subpixel_rays
from datagen.data.dataset import Dataset
from datagen.data.geometries import GeometryKey, geometry_key, read_meshes
from datagen.data.meshes import Mesh, r2_steps
from datagen.data.paths import follows_light
from datagen.machine.mitsuba_variant import short_lived_workers, use_mitsuba
from datagen.trace.surface_tables import LIMITS, Limits
from model.batches.rays import Draw, Rays, TracedPixels, black, rays_through, to_device
from model.methods.light_path.config import LightPathConfig

if TYPE_CHECKING:
    from datagen.trace.branch_outputs import PathEnds
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
    throughput: Float32[Tensor, "end 3"]
    cosine: Float32[Tensor, " end"]
    """Cosine of the angle between the arriving ray and the surface normal, 0 to 1."""
    reflected: Float32[Tensor, "end 3"] | None = None
    """The arriving direction, mirrored at the surface; None, like the next, where the configuration uses neither."""
    uv_slope: Float32[Tensor, "end 2"] | None = None
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
    reflected: Float32[Tensor, "ray straight 3"] | None = None
    """The ray's direction, mirrored at the surface of each straight layer; None without straight layers."""
    uv_slope: Float32[Tensor, "ray straight 2"] | None = None
    """Change of uv per metre of depth below the surface of each straight layer."""


Part = TypeVar("Part", Ends, Sky, Stack)


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPathBatch:
    """The light paths of some pixels: `samples` rays for each, pixel by pixel."""

    num_pixels: int
    samples: int
    ends: Ends
    sky: Sky
    stack: Stack | None


MANY_RAYS = 65_536
"""Rays that are traced at once where memory is the limit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPathPixels(TracedPixels[LightPathBatch]):
    """Pixels whose rays' light paths are traced when they are asked for."""

    tracer: "LightPathTracer"
    straight_tracer: "LightPathTracer | None"
    """The same surfaces, all passed in a straight line; None if the configuration has no straight layers."""
    num_objects: int
    config: LightPathConfig
    limits: Limits = LIMITS
    """Of light paths; the number of branches is the configuration's."""

    @property
    def chunk(self) -> int:
        """Pixels rendered at once."""
        return max(1, MANY_RAYS // self.config.render_samples)

    def with_rays(self, samples: int) -> "LightPathPixels":
        """The same pixels, rendered with this many rays each."""
        return dataclasses.replace(self, config=dataclasses.replace(self.config, render_samples=samples))

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> LightPathBatch:
        """The paths of the rays through these pixels; without `rng`, as many rays as for rendering."""
        if rng is not None:
            return self.take_drawn(index, rng)
        return self.take_through(index, subpixel_offsets(self.config.render_samples))

    def take_through(self, index: Int[Tensor, "*pixel"], places: Float[np.ndarray, "sample 2"]) -> LightPathBatch:
        """The paths of the rays through the same places of each of these pixels, as `subpixel_rays` takes them."""
        pixels, samples = index.flatten().cpu().numpy(), len(places)
        origins, directions = subpixel_rays(self.cameras, pixels, np.broadcast_to(places, (len(pixels), samples, 2)))
        return self._trace(origins, directions, [0, len(directions)], samples)[0]

    def take_all(self, draws: Sequence[Draw], *, beside_torch: bool = False) -> list[LightPathBatch]:
        """Training batches traced together, which takes two thirds of the time of one after the other."""
        config = self.config
        samples = config.train_samples
        through = pairs_through if config.paired_rays else rays_through
        seeds, rays, facets = [], [], []
        for index, rng in draws:
            pixels = index.flatten().cpu().numpy()
            seeds.append(int(rng.integers(1 << 31)))
            rays.append(through(self.cameras, pixels, samples, rng))
            facets.append(self._facets(len(pixels), samples, rng))
        origins, directions = (np.concatenate(part) for part in zip(*rays, strict=True))
        starts = np.cumsum([0, *(len(part) for part in facets)]).tolist()
        # The first batch's seed turns the dice of all; their facets are their own.
        return self._trace(
            origins,
            directions,
            starts,
            samples,
            seed=seeds[0],
            facets=np.concatenate(facets),
            beside_torch=beside_torch,
        )

    def _trace(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        starts: list[int],
        samples: int,
        *,
        seed: int = 0,
        facets: np.ndarray | None = None,
        beside_torch: bool = False,
    ) -> list[LightPathBatch]:
        """The paths of the rays between each two of `starts`."""
        config = self.config
        straight = None
        with short_lived_workers(none=beside_torch):
            # The stack meets the facets that the paths meet: if a pixel's facets were always spread evenly, its ray
            # pairs would not be independent, and `--debias` would reward the network for contrasts that cancel.
            paths = self.tracer.trace_ends(
                origins,
                directions,
                self.limits._replace(max_branches=config.branches),
                stacked=STACKED_VERTICES if config.stack_hidden else (),
                has_details=config.needs_details,
                seed=seed,
                facets=facets,
            )
            if config.seen_straight:
                assert self.straight_tracer is not None
                layers = Limits(1, max_vertices=config.straight_layers, max_depth=config.straight_layers)
                straight = self.straight_tracer.trace(origins, directions, layers)
        columns = {
            Ends: {
                "ray": _in_batch(paths.ray, starts),
                "surface": _surface_of(paths.object_id, config.shells),
                "uv": paths.uv,
                "throughput": paths.throughput,
                "cosine": paths.cosine,
                "reflected": paths.reflected,
                "uv_slope": paths.uv_slope,
            },
            Sky: {
                "ray": _in_batch(paths.exit_ray, starts),
                "direction": paths.exit_direction,
                "throughput": paths.exit_throughput,
            },
            Stack: self._stack(paths, directions, straight),
        }
        given = {(kind, name): values for kind in columns for name, values in columns[kind].items()}
        moved = to_device({key: values for key, values in given.items() if values is not None}, self.device)

        def part(kind: type[Part], first: int, last: int) -> Part:
            return kind(**{name: values[first:last] for (owner, name), values in moved.items() if owner is kind})

        ends, exits = (itertools.pairwise(np.searchsorted(rays, starts)) for rays in (paths.ray, paths.exit_ray))
        return [
            LightPathBatch(
                num_pixels=(rows[1] - rows[0]) // samples,
                samples=samples,
                ends=part(Ends, *end_rows),
                sky=part(Sky, *exit_rows),
                stack=part(Stack, *rows) if columns[Stack] else None,
            )
            for rows, end_rows, exit_rows in zip(itertools.pairwise(starts), ends, exits, strict=True)
        ]

    def _facets(self, num_pixels: int, samples: int, rng: np.random.Generator) -> Float32[np.ndarray, "ray 2"]:
        """Random numbers by which each pixel's rays choose facets of rough surfaces: in pairs half a period apart, or
        all spread evenly, as in rendering."""
        if self.config.paired_rays:
            first = rng.random((num_pixels, -(-samples // 2), 2))
            points = in_pairs(first, lambda place: (place + 0.5) % 1)[:, :samples]
        else:
            points = (rng.random((num_pixels, 1, 2)) + r2_steps(samples)) % 1
        return points.reshape(-1, 2).astype(np.float32)

    def _stack(
        self, paths: "PathEnds", directions: np.ndarray, straight: "TracedPaths | None"
    ) -> dict[str, np.ndarray]:
        """The arrays of `Stack`; none if no vertices were asked for."""
        if paths.stack is None:
            return {}
        columns = {
            "surface": _surface_of(paths.stack.object_id, self.config.shells),
            "uv": paths.stack.uv,
            "throughput": paths.stack.throughput,
            "cosine": paths.stack.cosine,
        }
        if straight is not None:
            cosine = -np.einsum("...c,...c", straight.direction[0], straight.normal[0])
            reflected = straight.direction[0] + 2 * cosine[..., None] * straight.normal[0]  # Mirrored.
            further = {
                "surface": straight.object_id[0],
                "uv": straight.uv[0],
                "throughput": straight.throughput[0].mean(axis=-1),
                "cosine": np.clip(cosine, 0, 1),
            }
            for name, values in further.items():
                columns[name] = np.concatenate([columns[name], np.moveaxis(values, 0, 1)], axis=1)
            columns["reflected"], columns["uv_slope"] = reflected.swapaxes(0, 1), straight.uv_slope[0].swapaxes(0, 1)
        return {**columns, "direction": directions}


def pairs_through(cameras: Cameras, index: Int[np.ndarray, " pixel"], samples: int, rng: np.random.Generator) -> Rays:
    """As `rays_through`, but rays 2k and 2k + 1 of a pixel lie opposite each other, and such pairs are independent, so
    the spread of their means measures the noise, which it does not for rays in separate cells."""
    pairs = -(-samples // 2)
    offsets = in_pairs(rng.random((len(index), pairs, 2)), lambda place: 1 - place)[:, :samples]
    return subpixel_rays(cameras, index, offsets)


def in_pairs(
    first: Float[np.ndarray, "pixel pair 2"], opposite: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, "pixel sample 2"]:
    """Each point, followed by its `opposite`."""
    return np.stack([first, opposite(first)], axis=2).reshape(len(first), -1, 2)


def trace_light_paths(config: LightPathConfig, dataset: Dataset, geometry: str, cameras: Cameras) -> LightPathPixels:
    """The pixels of any cameras, black, with the scene loaded for tracing."""
    shells = config.shells if config.straight_layers else 0
    tracer, straight_tracer = _load_surfaces(geometry_key(dataset, geometry), shells)
    return LightPathPixels(
        tracer=tracer,
        straight_tracer=straight_tracer,
        cameras=cameras,
        rgb=black(cameras),
        num_objects=len(dataset.objects),
        config=config,
    )


def nest_shells(meshes: tuple[Mesh, ...], shells: int) -> tuple[Mesh, ...]:
    """Each mesh, then smaller copies of it about the centre of its bounding box, 1 - k / shells as large for copy k."""
    return tuple(_scaled(mesh, 1 - copy / shells) for mesh in meshes for copy in range(shells))


def _scaled(mesh: Mesh, scale: float) -> Mesh:
    if scale == 1 or not len(mesh.vertices):  # A removed object has an empty mesh.
        return mesh
    center = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return dataclasses.replace(mesh, vertices=center + np.float32(scale) * (mesh.vertices - center))


def _in_batch(rays: Int[np.ndarray, " end"], starts: list[int]) -> Int[np.ndarray, " end"]:
    """Indices of rays, ascending, counted from the start of the batch that each ray belongs to."""
    return rays - np.repeat(starts[:-1], np.diff(np.searchsorted(rays, starts)))


def _surface_of(object_id: UInt8[np.ndarray, "*vertex"], shells: int) -> UInt8[np.ndarray, "*vertex"]:
    """The outermost shell of each object; 0 stays 0."""
    if shells == 1:
        return object_id
    return np.where(object_id > 0, (object_id.astype(np.int64) - 1) * shells + 1, 0).astype(np.uint8)


# Training, scoring and prediction use the same surfaces: they are loaded once, and their kernels are recorded once.
@functools.lru_cache(maxsize=1)
def _load_surfaces(key: GeometryKey, shells: int) -> "tuple[LightPathTracer, LightPathTracer | None]":
    """The tracer of light paths, and that of straight layers if there are shells."""
    from datagen.scene.folder import open_scene

    # The tracer's module can be imported only when Mitsuba has its variant.
    use_mitsuba()
    from datagen.trace.light_path import LightPathTracer
    from datagen.trace.surface_tables import tints_of

    scene = open_scene(key.dataset, key.geometry)
    materials = tuple(item.material for item in scene.objects)
    meshes = read_meshes(key.dataset, key.geometry)
    tracer = LightPathTracer(meshes, materials, tints_of(scene, own_uv=follows_light(key.geometry)))
    nested = nest_shells(meshes, shells)
    return tracer, LightPathTracer(nested, (None,) * len(nested)) if nested else None
