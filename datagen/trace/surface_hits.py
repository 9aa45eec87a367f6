"""A ray's hit on a surface, and the surface's effect on the ray: the steps of datagen/trace/branches.py."""

from typing import TYPE_CHECKING, NamedTuple

from datagen.render.facets import albedo, facet_towards, mirrored_by, refracted_by
from datagen.render.mitsuba_scene import id_of_shape
from datagen.scene.media import SAME_INDEX, Media, medium_of, with_solid, without_solid
from datagen.trace.surface_tables import (
    COATED,
    DIELECTRIC,
    METAL,
    THIN,
    Limits,
    SurfaceTables,
    TintTables,
    look_up_tint,
)

if TYPE_CHECKING:
    import mitsuba as mi

MIN_COSINE = 0.2
"""Cosines below this count as this for the slope of uv, which grazing rays would make infinite."""


class Kernel(NamedTuple):
    """Inputs that are the same in all steps."""

    scene: "mi.Scene"
    tables: SurfaceTables
    media: Media
    limits: Limits
    rows: "tuple[mi.Float, ...]"
    """Two numbers in [0, 1) for each ray."""
    shift: "mi.UInt32"
    """Seed of the shifts of `rows` from step to step."""


class Hit(NamedTuple):
    """Where a segment hits a surface."""

    found: "mi.Bool"
    """Whether it hits anything at all."""
    counts: "mi.Bool"
    """Whether it hits another face than the one that it left."""
    t: "mi.Float"
    shape: "mi.UInt32"
    face: "mi.Int32"
    p: "mi.Point3f"
    uv: "mi.Point2f"
    edges: "tuple[mi.Vector3f, mi.Vector3f]"
    uv_edges: "tuple[mi.Vector2f, mi.Vector2f]"
    n_wide: "mi.Vector3f"
    """Normal of the face with a length of twice its area."""
    n_face: "mi.Vector3f"
    """Unit normal of the face."""
    facing: "mi.Vector3f"
    """Unit shading normal on the side from which the ray comes."""
    is_outside: "mi.Bool"
    """Whether the ray comes from the side to which the face's normal points."""
    outward: "mi.Vector3f"
    """Unit normal of the face on the side from which the ray comes."""
    offset: "mi.Float"
    """Distance off the surface at which a new ray starts (datagen/scene/media.py)."""


class Sides(NamedTuple):
    """The kind of surface, and the solids on its two sides."""

    kind: "mi.UInt32"
    is_glass: "mi.Bool"
    """Whether it borders a medium."""
    is_thin: "mi.Bool"
    """Whether it is a thin pane."""
    is_void: "mi.Bool"
    """Whether a solid of higher priority fills both sides, so that there is no surface."""
    here: "mi.UInt32"
    beyond: "mi.UInt32"


class Bounce(NamedTuple):
    """The directions in which light continues from a surface, and the share of light in each."""

    mirrored: "mi.Vector3f"
    mirror_share: "mi.Color3f"
    next_d: "mi.Vector3f"
    next_share: "mi.Color3f"
    total: "mi.Bool"
    """Whether all light is reflected: the branch itself is mirrored."""


def meet(kernel: Kernel, o, d, last_face, active) -> Hit:
    """The nearest face, and where the segment hits it."""
    import drjit as dr
    import mitsuba as mi

    tables = kernel.tables
    pi = kernel.scene.ray_intersect_preliminary(mi.Ray3f(o, d), coherent=False, active=active)
    found = active & pi.is_valid()
    shape = dr.gather(mi.UInt32, tables.shape, id_of_shape(pi), found)
    face = mi.Int32(dr.gather(mi.UInt32, tables.first_face, shape, found) + pi.prim_index)
    counts = found & (face != last_face)

    b1, b2 = pi.prim_uv.x, pi.prim_uv.y
    weights = (1 - b1 - b2, b1, b2)
    place = mi.UInt32(dr.maximum(face, 0))
    corners = _corners_of(tables.positions, mi.Point3f, place, counts)
    uv_corners = _corners_of(tables.uv, mi.Point2f, place, counts)
    n = dr.normalize(_mix(_corners_of(tables.normals, mi.Vector3f, place, counts), weights))
    edges = (corners[1] - corners[0], corners[2] - corners[0])
    n_wide = dr.cross(*edges)
    n_face = dr.normalize(n_wide)
    p = _mix(corners, weights)
    is_outside = dr.dot(d, n_face) < 0
    return Hit(
        found=found,
        counts=counts,
        t=pi.t,
        shape=shape,
        face=face,
        p=p,
        uv=_mix(uv_corners, weights),
        edges=edges,
        uv_edges=(uv_corners[1] - uv_corners[0], uv_corners[2] - uv_corners[0]),
        n_wide=n_wide,
        n_face=n_face,
        facing=dr.select(is_outside, n, -n),
        is_outside=is_outside,
        outward=dr.select(is_outside, n_face, -n_face),
        offset=dr.gather(mi.Float, tables.offset, shape, counts),
    )


def _corners_of(table, kind, face, active):
    """A table's values at the three corners of each face."""
    import drjit as dr
    import mitsuba as mi

    size = dr.size_v(kind)
    return [
        kind(*(dr.gather(mi.Float, table, face * (3 * size) + corner * size + axis, active) for axis in range(size)))
        for corner in range(3)
    ]


def _mix(corners, weights):
    return corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2]


def sides_of(kernel: Kernel, hit: Hit, solids) -> Sides:
    """The solids on both sides of the surface."""
    import drjit as dr
    import mitsuba as mi

    tables, media = kernel.tables, kernel.media
    kind = dr.gather(mi.UInt32, tables.kind, hit.shape, hit.counts)
    is_glass, is_thin = hit.counts & (kind == DIELECTRIC), hit.counts & (kind == THIN)
    rank = mi.UInt32(dr.maximum(dr.gather(mi.Int32, tables.rank, hit.shape, is_glass), 0))
    entered, left_behind = with_solid(media, solids, rank), without_solid(media, solids, rank)
    beyond = dr.select(is_glass, dr.select(hit.is_outside, entered, left_behind), solids)
    here = dr.select(is_glass, dr.select(hit.is_outside, left_behind, entered), solids)
    return Sides(
        kind=kind,
        is_glass=is_glass,
        is_thin=is_thin,
        is_void=is_glass & (medium_of(media, here) == medium_of(media, beyond)),
        here=here,
        beyond=beyond,
    )


def uv_slope(hit: Hit, d):
    """Change of uv per depth as the ray's direction d = a e1 + b e2 + c n moves in the plane of the edges e1 and e2."""
    import drjit as dr

    shares = [dr.dot(dr.cross(d, hit.edges[1]), hit.n_wide), dr.dot(dr.cross(hit.edges[0], d), hit.n_wide)]
    # Depth counts inwards, which is backwards along a ray that exits.
    cosine = dr.maximum(dr.abs(dr.dot(d, hit.n_face)), MIN_COSINE)
    per_depth = dr.rcp(dr.maximum(dr.squared_norm(hit.n_wide) * cosine, 1e-30))
    per_depth = dr.select(hit.is_outside, per_depth, -per_depth)
    return (shares[0] * hit.uv_edges[0] + shares[1] * hit.uv_edges[1]) * per_depth


def bounce_of(kernel: Kernel, hit: Hit, sides: Sides, d, step) -> Bounce:
    """How the surface reflects and transmits the ray."""
    import drjit as dr
    import mitsuba as mi

    tables, facing = kernel.tables, hit.facing
    iors = [
        dr.gather(mi.Float, tables.medium_ior, medium_of(kernel.media, side), sides.is_glass)
        for side in (sides.beyond, sides.here)
    ]
    borders = sides.is_glass & ~sides.is_void
    eta = dr.select(borders, iors[0] / iors[1], dr.gather(mi.Float, tables.coat_ior, hit.shape, hit.counts))
    tints = borders & (dr.abs(eta - 1) > SAME_INDEX)
    cos_i = dr.clip(-dr.dot(d, facing), 0, 1)
    # eta is the far side's index over the near side's, so for `fresnel` the ray always comes from outside.
    reflectance, cos_t, _, eta_ti = mi.fresnel(cos_i, eta)
    cos_t = dr.abs(cos_t)
    reflectance = dr.select(sides.is_thin, 2 * reflectance / (1 + reflectance), reflectance)
    total = borders & _is_total(reflectance, cos_t)
    mirrored = dr.normalize(d + 2 * cos_i * facing)
    refracted = dr.normalize(d * eta_ti + facing * (cos_i * eta_ti - cos_t))

    color = mi.Color3f(*(dr.gather(mi.Float, table, hit.shape, hit.counts) for table in tables.color))
    is_metal = sides.kind == METAL
    if tables.tints is not None:
        color *= look_up_tint(TintTables(*tables.tints), hit.shape, hit.uv, hit.counts)
    coated = hit.counts & ((sides.kind == COATED) | is_metal)
    has_facets = coated | borders if tables.has_rough_glass else coated
    alpha = dr.gather(mi.Float, tables.roughness, hit.shape, has_facets)
    facet = facet_towards(d, facing, alpha, *_random_point(kernel, step))
    facet_d, shadowing = mirrored_by(facet)
    facet_reflectance, facet_cos_t, _, _ = mi.fresnel(facet.cosine, eta)
    # Light that goes from facet to facet makes the lobes brighter; metal tints it at each.
    gain = dr.rcp(1 - dr.select(is_metal, color, 1) * (1 - albedo(tables.albedo, cos_i, alpha, eta)))
    facet_share = dr.select(is_metal, color, mi.Color3f(facet_reflectance)) * shadowing * gain
    mirrored = dr.select(coated, facet_d, mirrored)

    share = dr.select(total, 1, (1 - reflectance) * dr.select(sides.is_glass, dr.square(eta_ti), 1))
    bounce = Bounce(
        mirrored=mirrored,
        mirror_share=dr.select(coated, facet_share, mi.Color3f(reflectance)),
        next_d=dr.select(total, mirrored, dr.select(borders, refracted, d)),
        next_share=dr.select(sides.is_thin | (tints & ~total), share * color, mi.Color3f(share)),
        total=total,
    )
    if not tables.has_rough_glass:
        return bounce
    total = _is_total(facet_reflectance, facet_cos_t)
    refracted, passed = refracted_by(facet, dr.abs(facet_cos_t), eta_ti)
    by_facet = Bounce(
        mirrored=facet_d,
        mirror_share=facet_share,
        next_d=dr.select(total, facet_d, refracted),
        next_share=dr.select(tints & ~total, color, 1)
        * gain
        * dr.select(total, shadowing, (1 - facet_reflectance) * passed * dr.square(eta_ti)),
        total=total,
    )
    is_rough = borders & (alpha > 0)
    return Bounce(*(dr.select(is_rough, rough, smooth) for rough, smooth in zip(by_facet, bounce, strict=True)))


def _is_total(reflectance, cos_t):
    """Whether all light is reflected. Rounding may leave a reflectance below 1 then, and does on CUDA."""
    return (reflectance >= 1) | (cos_t == 0)


def _random_point(kernel: Kernel, step):
    """Two numbers in [0, 1) with which each ray chooses a facet of a rough surface."""
    import drjit as dr
    import mitsuba as mi

    shifts = (mi.sample_tea_float32(kernel.shift, 2 * step + axis) for axis in range(2))
    points = [row + shift for row, shift in zip(kernel.rows, shifts, strict=True)]
    points = [point - dr.floor(point) for point in points]
    if not kernel.tables.has_rough_glass:
        return points
    # Light that leaves rough glass has hit a facet before: with one sequence for both, a ray's second facet would
    # depend on its first. From the second surface on, each ray has its own random numbers.
    ray = dr.arange(mi.UInt32, dr.width(kernel.rows[0]))
    dice = (mi.sample_tea_32(kernel.shift, 2 * step + axis)[0] for axis in range(2))
    own = (mi.sample_tea_float32(ray, die) for die in dice)
    return [dr.select(step == 0, point, die) for point, die in zip(points, own, strict=True)]
