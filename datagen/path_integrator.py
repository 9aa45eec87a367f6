"""Owns a path tracer that also knows Beer and Lambert: Mitsuba's own, with tinted glass in closed form.

Mitsuba has absorption only as a participating medium, where a path is absorbed or not by a throw of dice; that noise
alone would cost more samples than all else. Here the throughput is multiplied by exp(-absorption * length) instead.
Import this module after `use_mitsuba`; vectorised variants only.
"""

# Dr.Jit's stubs do not know that a registry array can be reinterpreted, nor what `@dr.syntax` makes of a loop.
# pyright: reportArgumentType=false, reportIncompatibleMethodOverride=false

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float


class AbsorbingPath(mi.SamplingIntegrator):
    """Unidirectional path tracing with next-event estimation, multiple importance sampling and absorbing glass.

    Without absorption it estimates what Mitsuba's `path` estimates. Glass must not be nested: leaving any glass leads
    to air. There is no Russian roulette: it costs more in noise than it saves (rr_depth above max_depth).
    """

    def __init__(self, absorption: Float[np.ndarray, "shape 3"], max_depth: int) -> None:
        super().__init__(mi.Properties())
        self.max_depth = max_depth
        self.absorption = absorption
        self.table = None

    def sample(self, scene, sampler, ray, medium=None, active=True):  # noqa: ARG002
        """Radiance along camera rays; called by Mitsuba's film loop."""
        if self.table is None:
            self.table = _absorption_table(scene, self.absorption)
        radiance, valid = _trace(scene, sampler, mi.Ray3f(ray), self.table, self.max_depth, mi.Bool(active))
        return radiance, valid, []


def _absorption_table(scene: "mi.Scene", absorption: Float[np.ndarray, "shape 3"]) -> "mi.Float":
    # Registry ids of shapes are not their places in the scene and change between loads, hence a table by id.
    ids = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))[: len(absorption)]
    table = np.zeros((ids.max() + 1, 3), np.float32)
    table[ids] = absorption
    return mi.Float(table.ravel())


@dr.syntax
def _trace(scene, sampler, ray, table, max_depth, active):
    context = mi.BSDFContext()
    radiance = mi.Spectrum(0)
    throughput = mi.Spectrum(1)
    sigma_a = mi.Spectrum(0)  # Absorption of the medium that the ray is in, 1/m.
    depth = mi.UInt32(0)
    valid = mi.Bool(False)  # Did the camera ray hit anything?
    previous = dr.zeros(mi.Interaction3f)
    previous_pdf = mi.Float(1)
    previous_is_delta = mi.Bool(True)

    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        hit = si.is_valid()
        valid |= hit & (depth == 0)

        # The medium between the last vertex and this one. A ray in glass always hits; the guard is for leaky meshes.
        throughput *= dr.select(hit, dr.exp(-sigma_a * dr.select(hit, si.t, 0)), 1)

        # Light that the ray runs into, weighted against having been sampled at the last vertex.
        ds = mi.DirectionSample3f(scene, si, previous)
        emitter_pdf = scene.pdf_emitter_direction(previous, ds, ~previous_is_delta)
        weight = dr.select(previous_is_delta, 1, _balance(previous_pdf, emitter_pdf))
        radiance += throughput * weight * ds.emitter.eval(si, active)
        active &= hit & (depth + 1 < max_depth)

        # Light sampled from here; smooth glass has no such term.
        bsdf = si.bsdf(ray)
        active_light = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, light = scene.sample_emitter_direction(si, sampler.next_2d(active), True, active_light)
        active_light &= ds.pdf != 0
        wo = si.to_local(ds.d)
        sample1, sample2 = sampler.next_1d(active), sampler.next_2d(active)
        value, pdf, bsdf_sample, bsdf_weight = bsdf.eval_pdf_sample(context, si, wo, sample1, sample2, active)
        weight = dr.select(ds.delta, 1, _balance(ds.pdf, pdf))
        radiance += dr.select(active_light, throughput * value * light * weight, 0)

        # The next segment.
        throughput *= bsdf_weight
        refracted = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.DeltaTransmission)
        entering = bsdf_sample.wo.z < 0
        inside = dr.gather(mi.Spectrum, table, dr.reinterpret_array(mi.UInt32, si.shape), active & refracted & entering)
        sigma_a = dr.select(refracted, dr.select(entering, inside, 0), sigma_a)
        ray = si.spawn_ray(si.to_world(bsdf_sample.wo))
        previous = mi.Interaction3f(si)
        previous_pdf = bsdf_sample.pdf
        previous_is_delta = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
        active &= dr.max(throughput) > 0
        depth += 1

    return radiance, valid


def _balance(pdf, other):
    """The power heuristic; 0 where the technique cannot have made the sample."""
    return dr.select(pdf > 0, (pdf * pdf) / dr.fma(pdf, pdf, other * other), 0)
