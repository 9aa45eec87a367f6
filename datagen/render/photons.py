"""Photons: from the lamps by way of glass and mirrors to matt surfaces, for the map of caustics.

Import this module after `use_mitsuba`.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from datagen.render.caustics import CausticMap
from datagen.render.path_integrator import (
    PathTracer,
    is_matt,
    meet_glass,
    part_colors,
    pass_medium,
    ratio_of_indices,
    start_off,
    surface_at,
)
from datagen.scene.media import medium_of, solids_around

NUM_PHOTONS = 1 << 20
"""Photons sent to glass and mirrors; about half of them arrive."""
PHOTON_SEED = 0x5EED


def map_caustics(tables: PathTracer) -> CausticMap | None:
    """A map of caustics from photons that the sampled lights send to glass and mirrors; None if none arrives."""
    lit = [shape for shape in tables.scene.shapes() if not shape.is_emitter() and not is_matt(shape.bsdf())]
    if not lit:
        return None
    # Small things get more than their share, since their caustics are no less visible.
    areas = np.array([float(np.array(shape.surface_area()).item()) for shape in lit])
    counts = np.ceil(NUM_PHOTONS * np.sqrt(areas) / np.sqrt(areas).sum()).astype(int)
    arrivals = [
        _send_photons(tables, shape, count, area / count, index)
        for index, (shape, count, area) in enumerate(zip(lit, counts.tolist(), areas.tolist(), strict=True))
    ]
    p, d, power = (np.concatenate(part, axis=-1) for part in zip(*arrivals, strict=True))
    if not len(power):
        return None
    return CausticMap(mi.Point3f(p), mi.Vector3f(d), mi.Float(power), _sampler(len(lit), len(power)))


def _send_photons(tables, shape, count: int, area: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Photons that the lights send to points on a shape: places (3, n) of arrival, directions back, and power."""
    sampler = _sampler(seed, count)
    aim = mi.SurfaceInteraction3f(shape.sample_position(0, sampler.next_2d()), dr.zeros(mi.Color0f))
    ds, light = tables.scene.sample_emitter_direction(aim, sampler.next_2d(), False)
    power = light * dr.abs_dot(ds.d, aim.n) * area
    ray = mi.Ray3f(ds.p + ds.n * tables.lamp_offset, -ds.d)
    p, d, power, has_arrived = _trace_photons(tables.scene, ray, power, sampler, tables)
    dr.eval(p, d, power, has_arrived)
    kept = np.array(has_arrived) & (np.array(dr.mean(power)) > 0)
    return np.array(p)[:, kept], np.array(d)[:, kept], np.array(dr.mean(power))[kept]


def _sampler(seed: int, count: int) -> "mi.Sampler":
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(PHOTON_SEED + seed, count)
    return sampler


@dr.syntax
def _trace_photons(scene, ray, power, sampler, tables):
    """Where photons end, the directions back, their power, and whether they met a matt surface after a detour."""
    context = mi.BSDFContext()
    colors = (mi.UInt32(sampler.next_1d() * 3), mi.Float(3)) if tables.disperses else None
    has_all = mi.Bool(True)
    solids = mi.UInt32(tables.air)
    depth = mi.UInt32(0)
    p, has_arrived = mi.Point3f(0), mi.Bool(False)
    active = dr.max(power) > 0

    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        active &= si.is_valid()
        offset, transmitted = pass_medium(tables, solids, ray, si, active)
        power *= transmitted
        is_glass, with_it, without_it = solids_around(tables.media, tables.rank, solids, si.shape, active)
        sides = medium_of(tables.media, with_it), medium_of(tables.media, without_it)
        vanishes = is_glass & (sides[0] == sides[1]) if tables.media.is_nested else mi.Bool(False)
        eta = ratio_of_indices(tables, sides, colors, is_glass)
        power, has_all = part_colors(tables, sides, colors, is_glass & ~vanishes, power, has_all)

        bsdf = si.bsdf(ray)
        ends = active & ~is_glass & is_matt(bsdf)
        p = dr.select(ends, si.p, p)
        has_arrived |= ends & (depth > 0)
        active &= ~ends & (depth + 1 < tables.max_depth)

        samples = sampler.next_1d(active), sampler.next_2d(active)
        surface = surface_at(tables, si, eta, is_glass, active & ~vanishes)
        bsdf_sample, bsdf_weight = bsdf.sample(context, si, *samples, active & ~is_glass)
        is_reflected, glass_wo, _ = meet_glass(tables, si, eta, surface, vanishes, samples)
        goes_in = dr.select(vanishes, dr.dot(ray.d, si.n) < 0, glass_wo.z < 0)
        solids = dr.select(is_glass & ~is_reflected, dr.select(goes_in, with_it, without_it), solids)
        # Power, unlike radiance, is not squeezed as it enters glass.
        power *= dr.select(active & ~is_glass, bsdf_weight, dr.select(active & ~is_reflected, surface.tint, 1))
        d = dr.select(vanishes, ray.d, si.to_world(dr.select(is_glass, glass_wo, bsdf_sample.wo)))
        ray = dr.select(active, mi.Ray3f(start_off(si, offset, d), d), ray)
        active &= dr.max(power) > 0
        depth += 1

    return p, -ray.d, power, has_arrived
