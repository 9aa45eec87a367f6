"""The path tracer for ground truth: absorbing and nested glass, and the cheapest samples that soft light allows.

It estimates the same as Mitsuba's `path`, and more: absorption multiplies the throughput by exp(-absorption * length),
and a glass surface borders on the medium that the ray is in (datagen/scene/media.py), by the formulas of `dielectric`
and `roughdielectric`. A path keeps all colour channels until it first hits glass that disperses, and continues with one
of them; the paths of a pixel are divided evenly among the channels.

Its random numbers are Sobol's (render/sobol.py). Light is sampled only where there is something to aim at: a soft sky
is found as well by the rays that materials send out, for half the rays. Where glass or a mirror is between a lamp and a
matt surface, half of the rays follow a map of caustics (render/caustics.py).
Import this module after `use_mitsuba`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float32

from datagen.render.albedo import albedo_table
from datagen.render.caustics import CausticMap, Spot
from datagen.render.facets import albedo, bounce_off_facet, gain_of_facets, lobe_of_glass
from datagen.render.sobol import SobolPoints
from datagen.scene.materials import Surface
from datagen.scene.media import (
    LAST_PLACE,
    RAY_OFFSET,
    SAME_INDEX,
    Media,
    largest_coordinate,
    medium_of,
    no_solids,
    skipped_length,
    solids_around,
)

Lanes = Any
"""A Dr.Jit array with one lane per path. Annotated, since pyright takes minutes to infer such types in `_trace`."""

MAX_VANISHED = 64
"""Largest number of vanished surfaces on one path, where a solid of higher priority fills both sides: they are not
bounces, but a path must end."""

GUIDED_SHARE = 0.5
"""Share of the rays from a matt surface that follow the map of caustics, where it has entries."""


class PathTracer:
    """Unidirectional path tracing with multiple importance sampling. Cameras and lights are in air.

    There is no Russian roulette: it costs more in noise than it saves. Tables of shapes are by registry id. Not a
    dataclass: Dr.Jit 1.5 would treat it as loop state and assign its fields.
    """

    def __init__(
        self,
        scene: "mi.Scene",
        media: Media,
        surfaces: Sequence[Surface],
        *,
        max_depth: int,
        has_lamps: bool,
        aims: bool,
    ) -> None:
        """Args:
        surfaces: of each object.
        has_lamps: whether there are emitters besides the environment.
        aims: whether emitters are sampled at each rough vertex, too.
        """
        # A shape's registry id differs from its place in the scene and changes between loads, hence tables by id.
        ids = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))

        def by_id(values: np.ndarray, missing: float) -> np.ndarray:
            table = np.full((ids.max() + 1, *values.shape[1:]), missing, values.dtype)
            table[ids[: len(values)]] = values
            return table.ravel()

        is_glass = np.array([surface.event == "refracts" for surface in surfaces])
        roughness = np.array([surface.roughness for surface in surfaces], np.float32)
        tint = np.array([surface.color for surface in surfaces], np.float32)
        ior = np.array([surface.ior for surface in surfaces], np.float32)
        boxes = [shape.bbox() for shape in scene.shapes()]
        offsets = [RAY_OFFSET * largest_coordinate(np.array([box.min, box.max])) for box in boxes]
        self.scene, self.media, self.air = scene, media, no_solids(media)
        self.max_depth, self.has_lamps, self.aims = max_depth, has_lamps, aims
        self.offset = mi.Float(by_id(np.array(offsets, np.float32), 0))
        self.lamp_offset = max(offsets[len(media.rank) :], default=0.0)
        self.has_facets, self.has_rough_glass = bool(roughness.any()), bool(roughness[is_glass].any())
        self.alpha, self.coat_ior = mi.Float(by_id(roughness, 0)), mi.Float(by_id(ior, 1))
        self.albedo = mi.Float(albedo_table().ravel()) if self.has_facets else mi.Float(1)
        self.has_tint, self.tint = bool((tint[is_glass] != 1).any()), mi.Float(by_id(tint, 1))
        self.rank = mi.Int32(by_id(media.rank, -1))
        self.disperses = bool(media.parts_colors.any())
        self.parts_colors = mi.Bool(media.parts_colors)
        self.ior = mi.Float(media.iors.ravel() if self.disperses else media.ior)
        self.absorption = mi.Float(media.absorption.ravel())
        self.caustics: CausticMap | None = None
        """Set it before the first picture (render/photons.py)."""

    def render(
        self, sensor: "mi.Sensor", *, width: int, height: int, spp: int, seed: int
    ) -> Float32[np.ndarray, "h w 3"]:
        """Mean radiance of each pixel under a box filter; identical to the last bit every time.

        (Mitsuba's film adds a pixel's samples in whatever order threads finish, which changes the sum's rounding.)
        """
        sample = dr.arange(mi.UInt32, width * height * spp)
        pixel, index = sample // spp, sample % spp
        points = SobolPoints(spp, seed)
        scramble = points.scramble_of(pixel)
        place = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
        place += points.sample_2d(scramble, index, mi.UInt32(0), mi.Bool(True))
        ray, _ = sensor.sample_ray(0, 0, place / mi.Point2f(width, height), mi.Point2f(0.5))
        colors = _share_out_channels(index, spp, scramble) if self.disperses else None
        radiance = _trace(self.scene, mi.Ray3f(ray), points, scramble, index, colors, self)
        dr.eval(radiance)
        channels = [np.array(channel).reshape(height, width, spp) for channel in radiance]
        return np.stack([channel.mean(axis=2, dtype=np.float64) for channel in channels], axis=-1).astype(np.float32)


def _share_out_channels(index, spp, scramble) -> tuple[Lanes, Lanes]:
    """The colour channel of each sample's path after dispersion, by thirds in random order, and its weight."""
    run = index * 3 // spp
    first, end = (run * spp + 2) // 3, ((run + 1) * spp + 2) // 3
    weight = mi.Float(spp) / mi.Float(end - first) if spp >= 3 else mi.Float(3)
    return (run + scramble % 3) % 3, weight


@dr.syntax
def _trace(scene, ray, points, scramble, index, colors, tables):
    """Radiance along camera rays; `colors` come from `_share_out_channels`, None if no glass disperses."""
    context = mi.BSDFContext()
    radiance, throughput = mi.Spectrum(0), mi.Spectrum(1)
    solids = mi.UInt32(tables.air)  # The solids that the ray is in.
    dimension = mi.UInt32(2)  # Of the random numbers; the camera took two.
    depth, vanished = mi.UInt32(0), mi.UInt32(0)  # Bounces, and vanished surfaces passed.
    previous = dr.zeros(mi.Interaction3f)
    previous_pdf = mi.Float(1)
    previous_is_delta = mi.Bool(True)
    active, escaped = mi.Bool(True), mi.Bool(False)  # Did the path run into the sky?
    has_all = mi.Bool(True)  # Does it carry all channels, having met no glass that disperses?

    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        hit = si.is_valid()

        offset, transmitted = pass_medium(tables, solids, ray, si, active & hit)
        throughput *= transmitted

        # The media on both sides of glass.
        is_glass, with_it, without_it = solids_around(tables.media, tables.rank, solids, si.shape, active & hit)
        sides = medium_of(tables.media, with_it), medium_of(tables.media, without_it)
        vanishes = is_glass & (sides[0] == sides[1]) if tables.media.is_nested else mi.Bool(False)

        eta = ratio_of_indices(tables, sides, colors, is_glass)
        throughput, has_all = part_colors(tables, sides, colors, is_glass & ~vanishes, throughput, has_all)

        # Light that the ray hits, weighted against light sampling at the last vertex.
        weight = mi.Float(1)
        if dr.hint(tables.aims, mode="scalar"):
            ds = mi.DirectionSample3f(scene, si, previous)
            emitter_pdf = scene.pdf_emitter_direction(previous, ds, active & ~previous_is_delta)
            weight = dr.select(previous_is_delta, 1, _balance(previous_pdf, emitter_pdf))
        if dr.hint(tables.has_lamps, mode="scalar"):
            radiance += throughput * weight * si.emitter(scene, active & hit).eval(si, active & hit)
        escaped |= active & ~hit
        throughput *= dr.select(hit, 1, weight)  # The sky's radiance follows after the loop.
        active &= hit & ((depth + 1 < tables.max_depth) | vanishes) & (vanished < MAX_VANISHED)

        sample1 = points.sample(scramble, index, dimension, active)
        sample2 = points.sample_2d(scramble, index, dimension + 1, active)
        dimension += 3
        bsdf = si.bsdf(ray)
        is_rough, matt = active & ~is_glass, is_matt(bsdf)
        surface = surface_at(tables, si, eta, is_glass, active & ~vanishes)
        if dr.hint(tables.aims, mode="scalar"):
            # Light sampled from here; smooth glass has no such term.
            active_light = active & ((mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & ~is_glass) | surface.is_frosted)
            place = points.sample_2d(scramble, index, dimension, active_light)
            dimension += 2
            ds, light = scene.sample_emitter_direction(si, place, False, active_light)
            active_light &= _is_lit(scene, tables, si, offset, ds, active_light)
            wo = si.to_local(ds.d)
            value, pdf, bsdf_sample, bsdf_weight = _scatter(tables, context, si, bsdf, wo, sample1, sample2, is_rough)
            value *= gain_of_facets(matt, surface, wo, value / dr.maximum(pdf, 1e-20))
            value, pdf = _scattered_by_glass(tables, si, eta, wo, surface, (value, pdf))
            weight = dr.select(ds.delta, 1, _balance(ds.pdf, pdf))
            radiance += dr.select(active_light, throughput * value * light * weight, 0)
        else:
            bsdf_sample, bsdf_weight = bsdf.sample(context, si, sample1, sample2, is_rough)
        bsdf_weight *= gain_of_facets(matt, surface, bsdf_sample.wo, bsdf_weight)

        # Glass reflects or refracts. Where its surface vanishes, both media are the same and nothing is reflected.
        is_reflected, glass_wo, glass_share = meet_glass(tables, si, eta, surface, vanishes, (sample1, sample2))
        goes_in = dr.select(vanishes, dr.dot(ray.d, si.n) < 0, glass_wo.z < 0)
        solids = dr.select(is_glass & ~is_reflected, dr.select(goes_in, with_it, without_it), solids)

        # The next segment; a path that has ended keeps its last. Radiance is scaled as its solid angle is squeezed.
        throughput *= dr.select(active, dr.select(is_glass, glass_share, bsdf_weight), 1)
        d = dr.select(vanishes, ray.d, si.to_world(dr.select(is_glass, glass_wo, bsdf_sample.wo)))
        ray = dr.select(active, mi.Ray3f(start_off(si, offset, d), d), ray)
        previous = mi.Interaction3f(si)
        _, previous_pdf = _scattered_by_glass(tables, si, eta, glass_wo, surface, (bsdf_weight, bsdf_sample.pdf))
        previous_is_delta = (is_glass & ~surface.is_frosted) | mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
        active &= dr.max(throughput) > 0
        depth += dr.select(vanishes, 0, 1)
        vanished += dr.select(vanishes, 1, 0)

    return radiance + dr.select(escaped, throughput * _sky(scene, ray, escaped), 0)


def _scatter(tables, context, si, bsdf, wo, sample1, sample2, active) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """As `bsdf.eval_pdf_sample`; from matt surfaces with known caustics, a share of the rays follows the map of them.

    Both ways to choose a direction are one density, so that either may find what the other was meant for.
    """
    caustics: CausticMap | None = tables.caustics
    if caustics is None:
        return bsdf.eval_pdf_sample(context, si, wo, sample1, sample2, active)
    spot = caustics.find(si.p, active)
    has_spot = active & is_matt(bsdf) & (spot.first < spot.end)
    is_guided = has_spot & (sample1 < GUIDED_SHARE)
    own_sample1 = dr.select(has_spot, (sample1 - GUIDED_SHARE) / (1 - GUIDED_SHARE), sample1)
    value, pdf, bsdf_sample, weight = bsdf.eval_pdf_sample(context, si, wo, own_sample1, sample2, active)
    pdf = _mixed_pdf(caustics, spot, si, wo, pdf, has_spot)
    followed = si.to_local(caustics.sample(spot, sample1 / GUIDED_SHARE, sample2, is_guided))
    chosen = dr.select(is_guided, followed, bsdf_sample.wo)
    chosen_value, chosen_pdf = bsdf.eval_pdf(context, si, chosen, has_spot)
    chosen_pdf = _mixed_pdf(caustics, spot, si, chosen, chosen_pdf, has_spot)
    bsdf_sample.wo = chosen
    bsdf_sample.pdf = dr.select(has_spot, chosen_pdf, bsdf_sample.pdf)
    return value, pdf, bsdf_sample, dr.select(has_spot, chosen_value / dr.maximum(chosen_pdf, 1e-30), weight)


def _mixed_pdf(caustics: CausticMap, spot: Spot, si, wo, bsdf_pdf, has_spot) -> Lanes:
    """The density of a direction that the material or the map chooses; the material alone where nothing is known."""
    mixed = dr.lerp(bsdf_pdf, caustics.pdf(spot, si.to_world(wo), has_spot), GUIDED_SHARE)
    return dr.select(has_spot, mixed, bsdf_pdf)


def is_matt(bsdf) -> Lanes:
    """Whether a material scatters light widely, with a gloss or without."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)


def pass_medium(tables, solids, ray, si, hit) -> tuple[Lanes, Lanes]:
    """The distance off the next surface at which rays start, and the transmittance of the medium on the way to it."""
    offset = dr.gather(mi.Float, tables.offset, dr.reinterpret_array(mi.UInt32, si.shape), hit)
    sigma_a = dr.gather(mi.Spectrum, tables.absorption, medium_of(tables.media, solids), hit)
    length = si.t + skipped_length(offset, dr.dot(ray.d, si.n))
    return offset, dr.select(hit, dr.exp(-sigma_a * dr.select(hit, length, 0)), 1)


def start_off(si, offset, d) -> Lanes:
    """The origin of a ray that leaves a surface along `d`; Mitsuba's `spawn_ray` would start 0.1 mm off."""
    return si.p + si.n * dr.mulsign(offset, dr.dot(si.n, d))


def _is_lit(scene, tables, si, offset, ds, active) -> Lanes:
    """Whether nothing is between a surface and the point of a light; the ray ends just short of the light."""
    o = start_off(si, offset, ds.d)
    way = ds.p + ds.n * tables.lamp_offset - o
    length = dr.norm(way)
    ray = mi.Ray3f(o, way / length)
    ray.maxt = length * (1 - 8 * LAST_PLACE)
    is_sampled = ds.pdf != 0
    return is_sampled & ~scene.ray_test(ray, active & is_sampled)


def _sky(scene, ray, escaped) -> Lanes:
    """The radiance of the sky for rays that have escaped into it."""
    sky = dr.zeros(mi.SurfaceInteraction3f)
    sky.wi = -ray.d
    return scene.environment().eval(sky, escaped)


def part_colors(tables, sides, colors, meets_glass, throughput, has_all) -> tuple[Lanes, Lanes]:
    """The throughput, reduced to one channel where a path first hits dispersive glass; which paths still have all."""
    if not tables.disperses:
        return throughput, has_all
    inner, outer = (dr.gather(mi.Bool, tables.parts_colors, side, meets_glass) for side in sides)
    parts = has_all & (inner | outer)
    channel, weight = colors
    one = mi.Spectrum(*(dr.select(channel == kept, weight, 0) for kept in range(3)))
    return throughput * dr.select(parts, one, 1), has_all & ~parts


def ratio_of_indices(tables, sides, colors, is_glass) -> Lanes:
    """Index of refraction inside over that outside; in the path's own channel if glass disperses."""
    places = [3 * side + colors[0] for side in sides] if tables.disperses else sides
    inner, outer = (dr.gather(mi.Float, tables.ior, place, is_glass) for place in places)
    return inner / outer


class SurfaceOptics(NamedTuple):
    """What surfaces do to light, besides refracting it."""

    alpha: Lanes
    """GGX roughness; 0 where a surface is smooth or vanishes."""
    is_frosted: Lanes
    """Whether it is rough glass."""
    tint: Lanes
    """Transmitted share of refracted light."""
    albedo: Lanes
    """Share of light that facets keep (render/albedo.py)."""


def surface_at(tables, si, eta, is_glass, active) -> SurfaceOptics:
    """Looks up the surfaces that are hit, and how rough glass, metals and coats scatter towards the rays."""
    shape = dr.reinterpret_array(mi.UInt32, si.shape)
    alpha, tint, kept = mi.Float(0), mi.Spectrum(1), mi.Float(1)
    if tables.has_facets:
        alpha = dr.gather(mi.Float, tables.alpha, shape, active)
        cosine = mi.Frame3f.cos_theta(si.wi)
        across = dr.select(cosine > 0, eta, dr.rcp(eta))
        across = dr.select(is_glass, across, dr.gather(mi.Float, tables.coat_ior, shape, active))
        kept = albedo(tables.albedo, dr.abs(cosine), alpha, across)
    if tables.has_tint:
        # Overlapping parts of one glass have no surface between them that could tint.
        is_solid = active & is_glass
        is_one = (dr.abs(eta - 1) < SAME_INDEX) | ~is_solid
        tint = dr.select(is_one, 1, dr.gather(mi.Spectrum, tables.tint, shape, is_solid))
    return SurfaceOptics(alpha=alpha, is_frosted=is_glass & (alpha > 0), tint=tint, albedo=kept)


def _scattered_by_glass(tables, si, eta, wo, surface, otherwise) -> tuple[Lanes, Lanes]:
    """The share of light scattered from `wo` towards the ray, and the density with which the surface samples `wo`.

    Args:
        otherwise: both values for surfaces other than rough glass.
    """
    if not tables.has_rough_glass:
        return otherwise
    value, pdf = lobe_of_glass(si.wi, wo, eta, surface.alpha)
    value = dr.select(si.wi.z * wo.z < 0, surface.tint, 1) * value / surface.albedo
    is_frosted = surface.is_frosted
    return dr.select(is_frosted, value, otherwise[0]), dr.select(is_frosted, pdf, otherwise[1])


def meet_glass(tables, si, eta, surface, vanishes, samples) -> tuple[Lanes, Lanes, Lanes]:
    """Whether glass reflects, the new direction in the surface's frame, and the factor of radiance."""
    if tables.has_rough_glass:
        is_reflected, wo, share = bounce_off_facet(si.wi, eta, surface.alpha, *samples, vanishes)
        share /= surface.albedo
    else:
        reflectance, cos_t, _, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), eta)
        is_reflected = (samples[0] <= reflectance) & ~vanishes
        wo = dr.select(is_reflected, mi.reflect(si.wi), mi.refract(si.wi, cos_t, eta_ti))
        share = dr.select(is_reflected, 1, dr.square(eta_ti))
    return is_reflected, wo, dr.select(is_reflected, 1, surface.tint) * share if tables.has_tint else share


def _balance(pdf, other) -> Lanes:
    """The power heuristic; 0 where the technique cannot have produced the sample."""
    return dr.select(pdf > 0, (pdf * pdf) / dr.fma(pdf, pdf, other * other), 0)
