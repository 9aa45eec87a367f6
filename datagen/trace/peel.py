"""Straight layers: every surface along a pixel's ray, found by Mitsuba's ray tracer. Call `use_mitsuba` first.

This rule misses no layer and finds none twice: the origin stays fixed, the distance t advances by a relative 2.4e-7
past each hit, a repeated hit of the last primitive does not count, and intersections are the robust ones. Mitsuba's own
`spawn_ray` loses half of the hits where surfaces are closer than 1e-4.
"""

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np
from jaxtyping import Float32, Int32, UInt8

from datagen.data.cameras import Cameras
from datagen.data.layers import UV_SCALE, Layers
from datagen.data.meshes import Mesh, is_there
from datagen.machine.compiled import compiled
from datagen.machine.mitsuba_variant import no_collection
from datagen.render.mitsuba_scene import id_of_shape, load_geometry_mitsuba, shapes_by_id, to_columns

if TYPE_CHECKING:
    from builtins import range as prange  # numba's prange splits the loop among threads.
else:
    from numba import prange

ADVANCE = 1 + 2.4e-7
"""Factor by which t passes a hit: two float32 steps."""

SPARE_STEPS = 64
"""Trace steps beyond the number of layers, for repeated hits of one primitive; grazing rays take a dozen."""

RECORDINGS = 64
"""Kernels that a peeler keeps, one for each number of rays and layers: recording one takes longer than running it."""

TILE = 4
"""Rays are traced in tiles of 4 x 4 pixels, 1.6 times faster than in scan lines."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hits:
    """All hits of a bundle of rays, nearest first."""

    shape: Int32[np.ndarray, "layer ray"]
    """Place among the meshes that are there, -1 where empty; `Peeler.object_ids[shape + 1]` are object ids."""
    prim: Int32[np.ndarray, "layer ray"]
    """Index of the face."""
    barycentric: Float32[np.ndarray, "layer ray 2"]
    """Weights of the face's second and third vertex."""
    t: Float32[np.ndarray, "layer ray"]
    """Distance along the ray, 0 where empty."""
    has_more: np.ndarray
    """(ray,) bool: whether the ray had more hits than layers."""


class Peeler:
    """A loaded geometry, for peeling any number of views."""

    def __init__(self, meshes: tuple[Mesh, ...]) -> None:
        import drjit as dr

        # Mitsuba gets only objects with a mesh; ids still count all objects.
        kept = [index for index, mesh in enumerate(meshes) if is_there(mesh)]
        self.object_ids = np.array([0, *(index + 1 for index in kept)], np.uint8)
        meshes = tuple(meshes[index] for index in kept)
        self._scene = load_geometry_mitsuba(meshes)
        self._shape_of = shapes_by_id(self._scene)
        self._trace = dr.freeze(_trace, limit=RECORDINGS, warn_after=1 << 30)
        # uv of the corners of all faces of all meshes, looked up by (shape, face) in one gather.
        self._first_face = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])[:-1]
        self._corner_uv = np.concatenate([mesh.uv[mesh.faces] for mesh in meshes])

    def trace(
        self,
        origin: Float32[np.ndarray, "3"] | Float32[np.ndarray, "ray 3"],
        directions: Float32[np.ndarray, "ray 3"],
        num_layers: int,
    ) -> Hits:
        """The first `num_layers` hits of any number of rays from one origin, or one each, along unit directions."""
        import drjit as dr
        import mitsuba as mi

        count, is_coherent = len(directions), origin.ndim == 1
        if count == 0:  # Dr.Jit would end the process.
            index, number = np.zeros((num_layers, 0), np.int32), np.zeros((num_layers, 0, 2), np.float32)
            return Hits(shape=index, prim=index, barycentric=number, t=number[..., 0], has_more=np.zeros(0, bool))
        # Opaque values; otherwise every camera would be recorded as a kernel of its own.
        start = [dr.opaque(mi.Float, float(value)) for value in origin] if is_coherent else to_columns(origin)
        along = mi.Vector3f(*to_columns(directions))
        with no_collection():
            outputs = self._trace(self._scene, mi.Point3f(*start), along, count, num_layers, is_coherent)
        shapes, prims, b1s, b2s, ts, num_hits = (np.array(values) for values in outputs)
        shape = (num_layers, count)
        return Hits(
            shape=self._shape_of[shapes].reshape(shape),
            prim=prims.reshape(shape),
            barycentric=np.stack([b1s, b2s], axis=-1).reshape(*shape, 2),
            t=ts.reshape(shape),
            has_more=num_hits > num_layers,
        )

    def peel(self, cameras: Cameras, view: int, num_layers: int) -> tuple[Layers, float]:
        """The layers of one view, and the share of its rays that had more hits than layers."""
        origin, directions = cameras[view].rays()
        order = _tiled(cameras.width, cameras.height)
        hits = self.trace(origin, directions.reshape(-1, 3)[order], num_layers)
        image = (num_layers, cameras.height, cameras.width)
        layers = Layers(
            uv=np.empty((*image, 2), np.uint16), object_id=np.empty(image, np.uint8), depth=np.empty(image, np.float32)
        )
        flat = (num_layers, len(order))
        _to_layers(
            order,
            hits.shape,
            hits.prim,
            hits.barycentric,
            hits.t,
            self.object_ids,
            self._first_face,
            self._corner_uv,
            layers.uv.reshape(*flat, 2),
            layers.object_id.reshape(flat),
            layers.depth.reshape(flat),
        )
        return layers, float(hits.has_more.mean())

    def peel_rays(
        self, origins: Float32[np.ndarray, "ray 3"], directions: Float32[np.ndarray, "ray 3"], num_layers: int
    ) -> tuple[Float32[np.ndarray, "ray layer 2"], UInt8[np.ndarray, "ray layer"]]:
        """uv and object ids along any rays, nearest first; both 0 beyond the last surface."""
        hits = self.trace(origins, directions, num_layers)
        shape = (len(directions), num_layers)
        uv, object_id = np.empty((*shape, 2), np.float32), np.empty(shape, np.uint8)
        _to_stacks(
            hits.shape, hits.prim, hits.barycentric, self.object_ids, self._first_face, self._corner_uv, uv, object_id
        )
        return uv, object_id


@numba.njit
def _interpolate(corners, barycentric):
    """uv at a hit from those of its face's corners, in float32."""
    b1, b2 = barycentric[0], barycentric[1]
    b0 = np.float32(1) - b1 - b2
    return (
        b0 * corners[0, 0] + b1 * corners[1, 0] + b2 * corners[2, 0],
        b0 * corners[0, 1] + b1 * corners[1, 1] + b2 * corners[2, 1],
    )


@compiled(nogil=True)
def _to_stacks(
    shape: Int32[np.ndarray, "layer ray"],
    prim: Int32[np.ndarray, "layer ray"],
    barycentric: Float32[np.ndarray, "layer ray 2"],
    object_ids: np.ndarray,
    first_face: np.ndarray,
    corner_uv: Float32[np.ndarray, "face 3 2"],
    uv: Float32[np.ndarray, "ray layer 2"],
    object_id: UInt8[np.ndarray, "ray layer"],
) -> None:
    """Writes interpolated uv and object id of every hit, ray by ray; 0 where empty. Too little work for threads."""
    for ray in range(shape.shape[1]):
        for layer in range(len(shape)):
            mesh = shape[layer, ray]
            object_id[ray, layer] = object_ids[mesh + 1]
            if mesh < 0:
                uv[ray, layer, 0] = uv[ray, layer, 1] = 0
                continue
            corners = corner_uv[first_face[mesh] + prim[layer, ray]]
            uv[ray, layer, 0], uv[ray, layer, 1] = _interpolate(corners, barycentric[layer, ray])


@compiled(parallel=True, nogil=True)
def _to_layers(
    order: Int32[np.ndarray, " ray"],
    shape: Int32[np.ndarray, "layer ray"],
    prim: Int32[np.ndarray, "layer ray"],
    barycentric: Float32[np.ndarray, "layer ray 2"],
    t: Float32[np.ndarray, "layer ray"],
    object_ids: np.ndarray,
    first_face: np.ndarray,
    corner_uv: Float32[np.ndarray, "face 3 2"],
    uv: np.ndarray,
    object_id: np.ndarray,
    depth: np.ndarray,
) -> None:
    """Writes the hits of rays to their pixels: interpolated uv in 16 bits, object id and distance; 0 where empty.

    uv are computed in float32 and rounded from float64: stored layers depend on every step.
    """
    last = np.float64(UV_SCALE)
    for ray in prange(len(order)):
        pixel = order[ray]
        for layer in range(len(shape)):
            mesh = shape[layer, ray]
            object_id[layer, pixel] = object_ids[mesh + 1]
            depth[layer, pixel] = t[layer, ray]
            if mesh < 0:
                uv[layer, pixel, 0] = uv[layer, pixel, 1] = 0
                continue
            corners = corner_uv[first_face[mesh] + prim[layer, ray]]
            found = _interpolate(corners, barycentric[layer, ray])
            for axis in range(2):
                uv[layer, pixel, axis] = np.uint16(np.rint(min(max(np.float64(found[axis]), 0.0), 1.0) * last))


def _trace(scene, o, d, count, num_layers, is_coherent):
    """One kernel for all layers; returns ids of meshes, faces, barycentric weights, distances, and each ray's hits."""
    import drjit as dr
    import mitsuba as mi

    size = num_layers * count
    shapes, prims = dr.zeros(mi.UInt32, size), dr.zeros(mi.Int32, size)
    b1s, b2s, ts = (dr.zeros(mi.Float, size) for _ in range(3))
    ray_index = dr.arange(mi.UInt32, count)

    def is_tracing(*state):
        return state[-1]

    def advance(t, layer, step, last_shape, last_prim, active):
        ray = mi.Ray3f(dr.fma(d, t, o), d)
        pi = scene.ray_intersect_preliminary(ray, coherent=is_coherent, active=active)
        active &= pi.is_valid()
        shape, prim = id_of_shape(pi), mi.Int32(pi.prim_index)
        t_hit = t + pi.t
        is_new = active & ~((shape == last_shape) & (prim == last_prim))
        target = layer * count + ray_index
        stored = is_new & (layer < num_layers)
        dr.scatter(shapes, shape, target, stored)
        dr.scatter(prims, prim, target, stored)
        dr.scatter(b1s, pi.prim_uv.x, target, stored)
        dr.scatter(b2s, pi.prim_uv.y, target, stored)
        dr.scatter(ts, t_hit, target, stored)
        layer = dr.select(is_new, layer + 1, layer)
        t = dr.select(active, t_hit * ADVANCE, t)
        last_shape, last_prim = dr.select(active, shape, last_shape), dr.select(active, prim, last_prim)
        step += 1
        active &= (layer <= num_layers) & (step < num_layers + 1 + SPARE_STEPS)
        return t, layer, step, last_shape, last_prim, active

    state = (
        dr.zeros(mi.Float, count),
        dr.zeros(mi.UInt32, count),
        dr.zeros(mi.UInt32, count),
        dr.zeros(mi.UInt32, count),
        dr.full(mi.Int32, -1, count),
        dr.full(mi.Bool, True, count),
    )
    result = dr.while_loop(state, is_tracing, advance, label="peel")
    return shapes, prims, b1s, b2s, ts, result[1]


@functools.cache
def _tiled(width: int, height: int) -> Int32[np.ndarray, "ray"]:
    """Pixel indices in tracing order; cached, since all views have the same."""
    row, column = np.divmod(np.arange(width * height), width)
    return np.lexsort((column, row, column // TILE, row // TILE)).astype(np.int32)
