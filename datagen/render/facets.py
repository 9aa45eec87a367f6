"""Microfacets of rough surfaces (GGX), sampled by visible area. Call `use_mitsuba` first.

Source: Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps"; Smith's shadowing. A sampled
direction has the weight Fresnel's term times shadowing. render/albedo.py makes up for light from facet to facet.
"""

from typing import TYPE_CHECKING, NamedTuple

from datagen.render.albedo import SHAPE

if TYPE_CHECKING:
    import mitsuba as mi


def sample_facet(wi, alpha, u1, u2):
    """The unit normal of a facet that a ray hits, in the surface's frame; with alpha = 0 the surface's own.

    Args:
        wi: unit direction from which the ray came, in the surface's frame (z > 0).
        alpha: GGX roughness.
        u1, u2: numbers in [0, 1).
    """
    import drjit as dr
    import mitsuba as mi

    stretched = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, dr.maximum(wi.z, 1e-6)))
    z = dr.fma(1 - u2, 1 + stretched.z, -stretched.z)
    sine, azimuth = dr.safe_sqrt(1 - z * z), 2 * dr.pi * u1
    cap = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), z) + stretched
    return dr.normalize(mi.Vector3f(alpha * cap.x, alpha * cap.y, dr.maximum(cap.z, 1e-6)))


def unshadowed(wo, alpha):
    """Share of the facets facing `wo`, a unit vector in the surface's frame, that other facets do not hide."""
    import drjit as dr

    tangent2 = (wo.x * wo.x + wo.y * wo.y) / dr.maximum(wo.z * wo.z, 1e-12)
    return 2 / (1 + dr.sqrt(1 + alpha * alpha * tangent2))


def albedo(table, cosine, alpha, eta):
    """Share of light that facets keep, by `albedo_table`, flat; arguments as of `facet_shares`, alpha may be 0."""
    import drjit as dr
    import mitsuba as mi

    contrast = (eta - 1) / (eta + 1)
    places = dr.mulsign(dr.sqrt(dr.abs(contrast)), contrast) / 2 + 0.5, alpha, dr.sqrt(cosine)
    corners = [(mi.Float(1), mi.UInt32(0))]
    for place, size in zip(places, SHAPE, strict=True):
        scaled = place * (size - 1)
        low = dr.minimum(mi.UInt32(scaled), size - 2)
        share = scaled - mi.Float(low)
        corners = [
            (weight * part, size * index + low + step)
            for weight, index in corners
            for step, part in enumerate((1 - share, share))
        ]
    return sum(weight * dr.gather(mi.Float, table, index) for weight, index in corners)


def gain_of_facets(is_coat, surface, wo, share):
    """The factor by which coats and metals scatter more than single facets do; metal tints light at each facet.

    Args:
        surface: its `alpha` and `albedo`.
        share: scattered light over the density of `wo`. Of metal, that is its colour times the shadowing.
    """
    import drjit as dr

    return dr.rcp(1 - dr.select(is_coat, 1, share / unshadowed(wo, surface.alpha)) * (1 - surface.albedo))


def lobe_of_glass(wi, wo, eta, alpha):
    """How much rough glass scatters from `wo` to `wi`, and the density with which sampled facets give `wo`.

    The first is the scattering function times the cosine at `wo`, the second is over solid angle.

    Args:
        wi, wo: unit directions, in the surface's frame, from which the ray came and to light; on either side.
        eta: index of refraction inside over that outside.
        alpha: GGX roughness, more than 0.

    Source: Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces", Eqs. 20 and 21.
    """
    import drjit as dr
    import mitsuba as mi

    is_reflected = wi.z * wo.z > 0
    across = dr.select(wi.z > 0, eta, dr.rcp(eta))  # Index of the far side over that of the ray's side.
    m = dr.normalize(wi + wo * dr.select(is_reflected, 1, across))
    m = dr.select(m.z < 0, -m, m)
    wi_m, wo_m = dr.dot(wi, m), dr.dot(wo, m)
    is_seen = (wi_m * wi.z > 0) & (wo_m * wo.z > 0)
    alpha2 = alpha * alpha
    density = alpha2 / (dr.pi * dr.square((alpha2 - 1) * dr.square(m.z) + 1))
    reflectance, _, _, _ = mi.fresnel(wi_m, eta)
    seen = unshadowed(wi, alpha) * density / dr.maximum(dr.abs(wi.z), 1e-6)
    squeeze = dr.square(wi_m + across * wo_m)
    mirrored = reflectance * seen / 4
    refracted = (1 - reflectance) * seen * dr.abs(wi_m * wo_m) / dr.maximum(squeeze, 1e-12)
    # Refracted radiance and solid angle change by the square of the index in opposite ways, which cancels here.
    value = dr.select(is_reflected, mirrored, refracted) * unshadowed(wo, alpha)
    pdf = dr.select(is_reflected, mirrored, refracted * dr.square(across))
    return dr.select(is_seen, value, 0), dr.select(is_seen, pdf, 0)


def bounce_off_facet(wi, eta, alpha, sample1, sample2, vanishes):
    """Whether a facet reflects, the new direction in the surface's frame, and the factor of radiance; of rough glass.

    Args:
        wi, eta, alpha: as of `lobe_of_glass`; alpha = 0 is smooth.
        sample1, sample2: a number and a point in [0, 1).
        vanishes: where nothing is reflected, since both sides are the same.
    """
    import drjit as dr
    import mitsuba as mi

    side = dr.sign(wi.z)
    facet = sample_facet(wi * side, alpha, sample2.x, sample2.y)
    reflectance, cos_t, _, eta_ti = mi.fresnel(dr.dot(wi, facet), eta)
    is_reflected = (sample1 <= reflectance) & ~vanishes
    wo = dr.select(is_reflected, mi.reflect(wi, facet), mi.refract(wi, facet, cos_t, eta_ti))
    # Light that leaves on the wrong side is lost.
    is_lost = ((wo.z * side > 0) != is_reflected) & ~vanishes
    share = dr.select(is_reflected, 1, dr.square(eta_ti)) * dr.select(vanishes, 1, unshadowed(wo, alpha))
    return is_reflected, wo, dr.select(is_lost, 0, share)


class Facet(NamedTuple):
    """A facet that a ray hits."""

    frame: "mi.Frame3f"
    """The surface's frame, its normal on the ray's side."""
    wi: "mi.Vector3f"
    """Unit direction back along the ray, in the frame."""
    m: "mi.Vector3f"
    """Unit normal of the facet, in the frame."""
    cosine: "mi.Float"
    """Cosine of the angle between the ray and the facet's normal."""
    alpha: "mi.Float"


def facet_towards(d, normal, alpha, u1, u2) -> Facet:
    """A visible facet of a rough surface for a ray that arrives along `d`; with alpha = 0 the surface itself."""
    import drjit as dr
    import mitsuba as mi

    frame = mi.Frame3f(normal)
    wi = frame.to_local(-d)
    m = sample_facet(wi, alpha, u1, u2)
    return Facet(frame=frame, wi=wi, m=m, cosine=dr.clip(dr.dot(wi, m), 0, 1), alpha=alpha)


def mirrored_by(facet: Facet):
    """The direction mirrored by a facet, and the shadowing (0 below the surface)."""
    import drjit as dr

    wo = 2 * facet.cosine * facet.m - facet.wi
    shadowing = dr.select(wo.z > 0, unshadowed(wo, facet.alpha), 0)
    return dr.normalize(facet.frame.to_world(wo)), shadowing


def refracted_by(facet: Facet, cos_t, eta_ti):
    """The direction refracted by a facet, and the shadowing (0 above the surface).

    Args:
        cos_t: cosine of the angle behind the facet.
        eta_ti: index of refraction on the ray's side over that behind the facet.
    """
    import drjit as dr

    wo = facet.m * (facet.cosine * eta_ti - cos_t) - facet.wi * eta_ti
    shadowing = dr.select(wo.z < 0, unshadowed(wo, facet.alpha), 0)
    return dr.normalize(facet.frame.to_world(wo)), shadowing
