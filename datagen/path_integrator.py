"""Owns a path tracer that also knows Beer and Lambert, and drinks in glasses: Mitsuba's own but for smooth glass.

Mitsuba has absorption only as a participating medium, where a path is absorbed or not by a throw of dice; that noise
alone would cost more samples than all else. Here the throughput is multiplied by exp(-absorption * length) instead.
Mitsuba's `dielectric` borders on the same medium everywhere; here a surface of glass borders on whatever the ray is in
(datagen/media.py), by the formulas of `dielectric`: where that is air, the picture is the same to the last bit.
Import this module after `use_mitsuba`; vectorised variants only.
"""

# Dr.Jit's stubs do not know that a registry array can be reinterpreted, nor what `@dr.syntax` makes of a loop.
# pyright: reportArgumentType=false, reportIncompatibleMethodOverride=false

import drjit as dr
import mitsuba as mi
import numpy as np

from datagen.media import Media, medium_of, no_solids, with_solid, without_solid

MAX_VANISHED = 64
"""Surfaces that are none, since a solid of higher priority fills both sides, on one path: they are no bounces, but no
path may go on for ever."""


class MediaPath(mi.SamplingIntegrator):
    """Unidirectional path tracing with next-event estimation, multiple importance sampling, absorbing and nested glass.

    Without either it estimates what Mitsuba's `path` estimates. Cameras and lights stand in air. There is no Russian
    roulette: it costs more in noise than it saves (rr_depth above max_depth).
    """

    def __init__(self, media: Media, max_depth: int) -> None:
        super().__init__(mi.Properties())
        self.max_depth = max_depth
        self.media = media
        self.tables = None

    def sample(self, scene, sampler, ray, medium=None, active=True):  # noqa: ARG002
        """Radiance along camera rays; called by Mitsuba's film loop."""
        if self.tables is None:
            self.tables = _Tables(scene, self.media)
        radiance, valid = _trace(scene, sampler, mi.Ray3f(ray), self.tables, self.max_depth, mi.Bool(active))
        return radiance, valid, []


class _Tables:
    """What the kernel looks up: the rank of a shape by its registry id, and what media do to light.

    No dataclass: Dr.Jit 1.5 would take it for state of the loop and assign its fields.
    """

    def __init__(self, scene: "mi.Scene", media: Media) -> None:
        # Registry ids of shapes are not their places in the scene and change between loads, hence a table by id.
        ids = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))
        rank = np.full(ids.max() + 1, -1, np.int32)
        rank[ids[: len(media.rank)]] = media.rank
        self.media = media
        self.rank = mi.Int32(rank)
        self.ior = mi.Float(media.ior)
        self.absorption = mi.Float(media.absorption.ravel())


@dr.syntax
def _trace(scene, sampler, ray, tables, max_depth, active):
    context = mi.BSDFContext()
    radiance = mi.Spectrum(0)
    throughput = mi.Spectrum(1)
    solids = mi.UInt32(no_solids(tables.media))  # The solids that the ray is in.
    depth = mi.UInt32(0)
    vanished = mi.UInt32(0)  # Surfaces passed that are none.
    valid = mi.Bool(False)  # Did the camera ray hit anything?
    previous = dr.zeros(mi.Interaction3f)
    previous_pdf = mi.Float(1)
    previous_is_delta = mi.Bool(True)

    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        hit = si.is_valid()
        valid |= hit & (depth == 0)

        # The medium between the last vertex and this one. A ray in glass always hits; the guard is for leaky meshes.
        sigma_a = dr.gather(mi.Spectrum, tables.absorption, medium_of(tables.media, solids), active)
        throughput *= dr.select(hit, dr.exp(-sigma_a * dr.select(hit, si.t, 0)), 1)

        # The media on both sides of smooth glass.
        rank = dr.gather(mi.Int32, tables.rank, dr.reinterpret_array(mi.UInt32, si.shape), active & hit)
        is_glass = active & hit & (rank >= 0)
        rank = mi.UInt32(dr.maximum(rank, 0))
        with_it, without_it = with_solid(tables.media, solids, rank), without_solid(tables.media, solids, rank)
        inner, outer = medium_of(tables.media, with_it), medium_of(tables.media, without_it)
        vanishes = is_glass & (inner == outer) if tables.media.is_nested else mi.Bool(False)

        # Light that the ray runs into, weighted against having been sampled at the last vertex.
        ds = mi.DirectionSample3f(scene, si, previous)
        emitter_pdf = scene.pdf_emitter_direction(previous, ds, ~previous_is_delta)
        weight = dr.select(previous_is_delta, 1, _balance(previous_pdf, emitter_pdf))
        radiance += throughput * weight * ds.emitter.eval(si, active)
        active &= hit & ((depth + 1 < max_depth) | vanishes) & (vanished < MAX_VANISHED)

        # Light sampled from here; smooth glass has no such term.
        bsdf = si.bsdf(ray)
        active_light = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, light = scene.sample_emitter_direction(si, sampler.next_2d(active), True, active_light)
        active_light &= ds.pdf != 0
        wo = si.to_local(ds.d)
        sample1, sample2 = sampler.next_1d(active), sampler.next_2d(active)
        is_rough = active & ~is_glass
        value, pdf, bsdf_sample, bsdf_weight = bsdf.eval_pdf_sample(context, si, wo, sample1, sample2, is_rough)
        weight = dr.select(ds.delta, 1, _balance(ds.pdf, pdf))
        radiance += dr.select(active_light, throughput * value * light * weight, 0)

        # Smooth glass reflects or refracts. Where its surface is none, both media are one: nothing is reflected.
        sides = [dr.gather(mi.Float, tables.ior, side, active & is_glass) for side in (inner, outer)]
        reflectance, cos_t, _, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), sides[0] / sides[1])
        is_reflected = (sample1 <= reflectance) & ~vanishes
        glass_wo = dr.select(is_reflected, mi.reflect(si.wi), mi.refract(si.wi, cos_t, eta_ti))
        goes_in = dr.select(vanishes, dr.dot(ray.d, si.n) < 0, glass_wo.z < 0)
        solids = dr.select(is_glass & ~is_reflected, dr.select(goes_in, with_it, without_it), solids)

        # The next segment. Radiance is scaled as its solid angle is squeezed.
        throughput *= dr.select(is_glass, dr.select(is_reflected, 1, dr.square(eta_ti)), bsdf_weight)
        to_world = si.to_world(dr.select(is_glass, glass_wo, bsdf_sample.wo))
        ray = si.spawn_ray(dr.select(vanishes, ray.d, to_world))
        previous = mi.Interaction3f(si)
        previous_pdf = bsdf_sample.pdf
        previous_is_delta = is_glass | mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
        active &= dr.max(throughput) > 0
        depth += dr.select(vanishes, 0, 1)
        vanished += dr.select(vanishes, 1, 0)

    return radiance, valid


def _balance(pdf, other):
    """The power heuristic; 0 where the technique cannot have made the sample."""
    return dr.select(pdf > 0, (pdf * pdf) / dr.fma(pdf, pdf, other * other), 0)
