"""Owns light paths: which surfaces really shine into a pixel, through refraction and by reflection.

A straight ray looks up the wrong texels behind solid glass. Here each ray is followed as light goes, in branches.
Branch 0 is refracted: through every dielectric interface by Snell's law (total internal reflection reflects it),
straight through thin panes, until it meets something opaque or leaves the scene. Branch 1 is reflected at the first
surface, when that is glass or glossy, and then followed in the same way; where it is rough, by one of its facets, so
that several rays together see it blurred. Further branches are reflected at any later
surface of any branch, those of the largest throughput first. What the branches beyond `max_branches` carry is left to
whoever shades the layers.

Vectorised variants only. Call `use_mitsuba` first.
"""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportIndexIssue=false

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from datagen.data.meshes import Mesh, is_there
from datagen.disk.errors import HyalineError
from datagen.render.mitsuba_scene import is_scalar, load_geometry_mitsuba, to_columns
from datagen.scene.materials import Material, check_material
from datagen.scene.materials.optics import Event, Surface
from datagen.scene.media import Media, find_media, medium_of, no_solids, with_solid, without_solid

if TYPE_CHECKING:
    import mitsuba as mi

OPAQUE, DIELECTRIC, THIN, COATED, METAL = range(5)
"""What a surface does to a ray, as numbers in the kernel."""

EVENTS: dict[Event, int] = {
    "ends": OPAQUE,
    "refracts": DIELECTRIC,
    "passes": THIN,
    "coated": COATED,
    "mirrors": METAL,
}

NO_SURFACE = Surface(event="passes", ior=1.0)
"""A pane of air, for straight layers."""

OFFSET = 2e-6
"""How far, relative to 1 + its largest coordinate, a new ray starts from its surface: neighbouring faces round."""

SPARE_STEPS = 16
"""Trace steps beyond the vertices of all branches, for hits that do not count: faces met again, surfaces of solids
inside others."""

MIN_THROUGHPUT = 1 / 512
"""A branch that starts with less is not followed: less than one step of an 8-bit picture."""

MIN_COSINE = 0.2
"""Where a ray grazes a surface, the slope of its uv is that at this cosine."""

RECORDINGS = 64
"""Kernels that a tracer keeps, one for each number of rays and limits."""

PLASTIC = 1.32471795724474602596
"""The plastic number, of which the R2 sequence is made."""

FIRST_MIRROR = 16.0
"""Weight in the queue of branches beyond any throughput, so that the first surface's mirror comes next."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPaths:
    """The vertices of all branches of a bundle of rays, in the order in which the camera's ray meets them.

    A branch ends on an opaque surface (its last vertex), in the open (`has_left`), or after `max_depth` surfaces. Where
    it has more vertices than places, the last place holds the last vertex.
    """

    object_id: UInt8[np.ndarray, "branch vertex ray"]
    """0 where there is no vertex."""
    uv: Float32[np.ndarray, "branch vertex ray 2"]
    direction: Float32[np.ndarray, "branch vertex ray 3"]
    """Unit direction in which the ray arrives at the vertex."""
    position: Float32[np.ndarray, "branch vertex ray 3"]
    """World position in metres."""
    normal: Float32[np.ndarray, "branch vertex ray 3"]
    """Unit shading normal, towards the side from which the ray comes."""
    throughput: Float32[np.ndarray, "branch vertex ray 3"]
    """Share of the radiance leaving the vertex against `direction` that reaches the camera, per colour channel: the
    product of Fresnel terms, Beer and Lambert's absorption, and the change of radiance with the square of the index."""
    medium_length: Float32[np.ndarray, "branch vertex ray"]
    """Metres that the last segment ran inside glass or liquid; 0 in air."""
    has_left: Bool[np.ndarray, "branch ray"]
    end_direction: Float32[np.ndarray, "branch ray 3"]
    """Unit direction in which the branch left the scene; 0 where it did not."""
    end_throughput: Float32[np.ndarray, "branch ray 3"]
    """Share of the environment's radiance from there that reaches the camera; 0 where it did not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedPaths(LightPaths):
    """Light paths fresh from the tracer, with what is not stored."""

    uv_slope: Float32[np.ndarray, "branch vertex ray 2"]
    """Change of uv from the vertex to where the ray would meet a surface one metre below this one, to first order."""


class LightPathTracer:
    """A loaded geometry with the materials of its surfaces; follows any number of rays."""

    def __init__(self, meshes: tuple[Mesh, ...], materials: tuple[Material | None, ...]) -> None:
        """A surface whose material is None lets every ray through as it comes: its paths are straight layers."""
        import drjit as dr

        if is_scalar():
            raise HyalineError(
                "light paths: Mitsuba runs as scalar_rgb, which cannot trace them; "
                "`datagen doctor` names the libLLVM to install"
            )
        for index, material in enumerate(materials):
            if material is not None:
                check_material(material, where=f"light paths: object {index + 1}")
        # Mitsuba gets the objects that are there; the ids stay those of all.
        kept = [index for index, mesh in enumerate(meshes) if is_there(mesh)]
        self._object_id = np.array([0, *(index + 1 for index in kept)], np.uint8)
        meshes = tuple(meshes[index] for index in kept)
        kept_materials = tuple(materials[index] for index in kept)
        self._scene = load_geometry_mitsuba(meshes)
        self._media = find_media(kept_materials, meshes)
        self._tables = _make_tables(meshes, kept_materials, self._media)
        self._spread: dict[int, list[mi.Float]] = {}
        # Recording a kernel takes as long as running it for 8,192 rays: it is done once for each number of rays and
        # limits.
        self._trace = dr.freeze(_trace, limit=RECORDINGS, warn_after=1 << 30)

    def trace(self, origins: Float32[np.ndarray, "ray 3"], directions: Float32[np.ndarray, "ray 3"],
              *, max_branches: int = 4, max_vertices: int = 8, max_depth: int = 24,
              seed: int = 0, facets: Float32[np.ndarray, "ray 2"] | None = None) -> TracedPaths:  # fmt: skip
        """Follows rays that start in air.

        Args:
            directions: of unit length.
            max_branches: followed for each ray; 1 is the refracted one alone.
            max_vertices: kept of each branch. The last place holds the last vertex, however many come before it.
            max_depth: surfaces after which a branch is given up.
            seed: of the facets of rough surfaces that mirror.
            facets: where among these facets each ray starts to choose, in [0, 1)^2. None: consecutive rays share them
                out evenly.
        """
        import drjit as dr
        import mitsuba as mi

        count = len(directions)
        if facets is not None:
            rows = to_columns(facets)
        elif count in self._spread:
            rows = self._spread[count]
        else:
            rows = [mi.Float(np.arange(count) / PLASTIC ** (1 + axis) % 1) for axis in range(2)]
            self._spread[count] = rows

        outputs = self._trace(
            self._scene, tuple(self._tables), self._media,
            mi.Point3f(*to_columns(origins)), mi.Vector3f(*to_columns(directions)),
            tuple(rows), dr.opaque(mi.UInt32, seed),
            count, max_branches, max_vertices, max_depth,
        )  # fmt: skip
        dr.eval(outputs)

        def array(name: str, *shape: int) -> np.ndarray:
            return outputs[name].numpy().reshape(shape)

        places, ends = (max_branches, max_vertices, count), (max_branches, count)
        return TracedPaths(
            object_id=self._object_id[array("object_id", *places)],
            uv=array("uv", *places, 2),
            direction=array("direction", *places, 3),
            position=array("position", *places, 3),
            normal=array("normal", *places, 3),
            throughput=array("throughput", *places, 3),
            uv_slope=array("uv_slope", *places, 2),
            medium_length=array("medium_length", *places),
            has_left=array("has_left", *ends).astype(bool),
            end_direction=array("end_direction", *ends, 3),
            end_throughput=array("end_throughput", *ends, 3),
        )


class _Tables(NamedTuple):
    """What the kernel looks up: by object its optics, by face its corners' positions, normals and uv."""

    kind: "mi.UInt32"
    coat_ior: "mi.Float"
    roughness: "mi.Float"
    color: "list[mi.Float]"
    rank: "mi.Int32"
    medium_ior: "mi.Float"
    absorption: "list[mi.Float]"
    first_face: "mi.UInt32"
    positions: "mi.Float"
    normals: "mi.Float"
    uv: "mi.Float"


def _make_tables(meshes: tuple[Mesh, ...], materials: tuple[Material | None, ...], media: Media) -> _Tables:
    import mitsuba as mi

    def array(values: list[float]) -> "mi.Float":
        return mi.Float(np.array(values, np.float32))

    def corners(values: list[np.ndarray]) -> "mi.Float":
        return mi.Float(np.concatenate(values).ravel())

    surfaces = [NO_SURFACE if material is None else material.surface() for material in materials]
    first_face = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])[:-1]
    return _Tables(
        kind=mi.UInt32(np.array([EVENTS[surface.event] for surface in surfaces], np.uint32)),
        coat_ior=array([surface.ior for surface in surfaces]),
        roughness=array([surface.roughness for surface in surfaces]),
        color=[array([surface.color[c] for surface in surfaces]) for c in range(3)],
        rank=mi.Int32(media.rank),
        medium_ior=mi.Float(media.ior),
        absorption=[mi.Float(np.ascontiguousarray(media.absorption[:, c])) for c in range(3)],
        first_face=mi.UInt32(first_face.astype(np.uint32)),
        positions=corners([mesh.vertices[mesh.faces] for mesh in meshes]),
        normals=corners([mesh.normals[mesh.faces] for mesh in meshes]),
        uv=corners([mesh.uv[mesh.faces] for mesh in meshes]),
    )


def _trace(scene, tables, media, o, d, rows, shift, count, max_branches, max_vertices, max_depth):
    """One kernel for all vertices of all branches of `count` rays from `o` along `d`.

    Args:
        rows: two numbers in [0, 1) for each ray. Where those of consecutive rays, which are those of one pixel, are an
            R2 sequence, these share out the facets of a rough surface evenly.
        shift: seed of the shifts.

    Returns:
        By field of `TracedPaths`: a flat array.
    """
    import drjit as dr
    import mitsuba as mi

    tables = _Tables(*tables)
    slots = max_branches * max_vertices * count
    ids, lengths = dr.zeros(mi.UInt32, slots), dr.zeros(mi.Float, slots)
    out_uv, out_slope = (dr.zeros(mi.Float, 2 * slots) for _ in range(2))
    out_direction, out_position, out_normal, out_throughput = (dr.zeros(mi.Float, 3 * slots) for _ in range(4))
    end_direction, end_throughput = (dr.zeros(mi.Float, 3 * max_branches * count) for _ in range(2))
    left = dr.zeros(mi.UInt32, max_branches * count)
    ray_index = dr.arange(mi.UInt32, count)

    def store(target, values, index, mask):
        components = list(values)  # They lie side by side, as NumPy wants them: no copy of the whole is made.
        for component, value in enumerate(components):
            dr.scatter(target, value, index * len(components) + component, mask)

    def corners_of(table, kind, face, active):
        """What a table holds for the three corners of each face."""
        size = dr.size_v(kind)
        return [
            kind(
                *(dr.gather(mi.Float, table, face * (3 * size) + corner * size + axis, active) for axis in range(size))
            )
            for corner in range(3)
        ]

    def mix(corners, weights):
        return corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2]

    def is_tracing(*state):
        return state[-1]

    def random_point(step):
        shifts = (mi.sample_tea_float32(shift, 2 * step + axis) for axis in range(2))
        points = [row + shift for row, shift in zip(rows, shifts, strict=True)]
        return [point - dr.floor(point) for point in points]

    def choose(condition, these, others):
        return tuple(dr.select(condition, this, other) for this, other in zip(these, others, strict=True))

    # A start of a branch: weight in the queue, origin, direction, throughput, face that it leaves, solids around it.
    kinds = (mi.Float, mi.Point3f, mi.Vector3f, mi.Color3f, mi.Int32, mi.UInt32)
    values = (0, 0, 0, 0, -1, no_solids(media))
    no_start = tuple(kind(value) for kind, value in zip(kinds, values, strict=True))

    def advance(o, d, beta, solids, way, last_face, branch, vertex, step, queue, active):
        pi = scene.ray_intersect_preliminary(mi.Ray3f(o, d), coherent=False, active=active)
        found = active & pi.is_valid()
        shape = mi.UInt32(pi.shape_index)
        face = mi.Int32(dr.gather(mi.UInt32, tables.first_face, shape, found) + pi.prim_index)
        hit = found & (face != last_face)
        again = found & (face == last_face)
        missed = active & ~found

        # Where the ray is, and what is there.
        b1, b2 = pi.prim_uv.x, pi.prim_uv.y
        weights = (1 - b1 - b2, b1, b2)
        face_u = mi.UInt32(dr.maximum(face, 0))
        corners = corners_of(tables.positions, mi.Point3f, face_u, hit)
        uv_corners = corners_of(tables.uv, mi.Point2f, face_u, hit)
        p, uv = mix(corners, weights), mix(uv_corners, weights)
        n = dr.normalize(mix(corners_of(tables.normals, mi.Vector3f, face_u, hit), weights))
        edges = (corners[1] - corners[0], corners[2] - corners[0])
        n_wide = dr.cross(*edges)
        n_face = dr.normalize(n_wide)

        # The medium on the way here, and those on both sides of the surface.
        is_outside = dr.dot(d, n_face) < 0
        kind = dr.gather(mi.UInt32, tables.kind, shape, hit)
        is_glass, is_thin = hit & (kind == DIELECTRIC), hit & (kind == THIN)
        medium = medium_of(media, solids)
        rank = mi.UInt32(dr.maximum(dr.gather(mi.Int32, tables.rank, shape, is_glass), 0))
        entered, left_behind = with_solid(media, solids, rank), without_solid(media, solids, rank)
        beyond = dr.select(is_glass, dr.select(is_outside, entered, left_behind), solids)
        here = dr.select(is_glass, dr.select(is_outside, left_behind, entered), solids)
        # Where a solid of higher priority fills both sides, there is no surface.
        is_void = is_glass & (medium_of(media, here) == medium_of(media, beyond))
        real = hit & ~is_void

        # Beer and Lambert, along the segment that ends here.
        in_glass = found & (medium < mi.UInt32(len(media.ior) - 1))
        sigma = mi.Color3f(*(dr.gather(mi.Float, tables.absorption[c], medium, in_glass) for c in range(3)))
        length = dr.select(in_glass & hit, dr.norm(p - o), 0)
        beta = dr.select(in_glass, beta * dr.exp(-sigma * length), beta)
        way += length

        # What uv changes as the ray goes on in the plane of the face, whose edges are e1 and e2: d = a e1 + b e2 + c n.
        shares = [dr.dot(dr.cross(d, edges[1]), n_wide), dr.dot(dr.cross(edges[0], d), n_wide)]
        uv_edges = (uv_corners[1] - uv_corners[0], uv_corners[2] - uv_corners[0])
        # Depth counts inwards, which is back along a ray that comes out.
        cosine = dr.maximum(dr.abs(dr.dot(d, n_face)), MIN_COSINE)
        per_depth = dr.rcp(dr.maximum(dr.squared_norm(n_wide) * cosine, 1e-30))
        per_depth = dr.select(is_outside, per_depth, -per_depth)
        slope = (shares[0] * uv_edges[0] + shares[1] * uv_edges[1]) * per_depth

        # The vertex. What comes after the last place takes its place: the end of a branch is always kept.
        facing = dr.select(is_outside, n, -n)
        slot = (branch * max_vertices + dr.minimum(vertex, max_vertices - 1)) * count + ray_index
        dr.scatter(ids, shape + 1, slot, real)
        dr.scatter(lengths, way, slot, real)
        store(out_uv, uv, slot, real)
        store(out_slope, slope, slot, real)
        store(out_direction, d, slot, real)
        store(out_position, p, slot, real)
        store(out_normal, facing, slot, real)
        store(out_throughput, beta, slot, real)
        end = branch * count + ray_index
        dr.scatter(left, mi.UInt32(1), end, missed)
        store(end_direction, d, end, missed)
        store(end_throughput, beta, end, missed)

        # What the surface does to the ray.
        eta = dr.gather(mi.Float, tables.medium_ior, medium_of(media, beyond), is_glass) / dr.gather(
            mi.Float, tables.medium_ior, medium_of(media, here), is_glass
        )
        eta = dr.select(is_glass & ~is_void, eta, dr.gather(mi.Float, tables.coat_ior, shape, hit))
        cos_i = dr.clip(-dr.dot(d, facing), 0, 1)
        # The ratio is that of the two sides as the ray comes, so that it always comes from the first of them.
        reflectance, cos_t, _, eta_ti = mi.fresnel(cos_i, eta)
        cos_t = dr.abs(cos_t)
        reflectance = dr.select(is_thin, 2 * reflectance / (1 + reflectance), reflectance)
        total = is_glass & ~is_void & (reflectance >= 1)
        mirrored = dr.normalize(d + 2 * cos_i * facing)
        refracted = dr.normalize(d * eta_ti + facing * (cos_i * eta_ti - cos_t))
        passes = is_thin | is_glass
        offset = OFFSET * (1 + dr.max(dr.abs(p)))
        outward = dr.select(is_outside, n_face, -n_face)

        # A further branch, where light also comes by reflection. The queue is sorted; its last one falls out.
        color = mi.Color3f(*(dr.gather(mi.Float, tables.color[c], shape, hit) for c in range(3)))
        coated = hit & ((kind == COATED) | (kind == METAL))
        alpha = dr.gather(mi.Float, tables.roughness, shape, coated)
        facet_d, facet_cos, shadowing = _mirror_rough(d, facing, alpha, *random_point(step))
        facet_reflectance = dr.select(kind == METAL, color, mi.Color3f(mi.fresnel(facet_cos, eta)[0])) * shadowing
        mirrored = dr.select(coated, facet_d, mirrored)
        m_beta = beta * dr.select(coated, facet_reflectance, mi.Color3f(reflectance))
        weight = dr.max(m_beta)
        starts = real & (kind != OPAQUE) & ~total & (weight > MIN_THROUGHPUT)
        weight = dr.select((branch == 0) & (vertex == 0), FIRST_MIRROR, weight)
        start = (dr.select(starts, weight, 0), p + outward * offset, mirrored, m_beta, face, solids)
        sorted_queue = []
        for other in queue:
            is_better = start[0] > other[0]
            sorted_queue.append(choose(is_better, start, other))
            start = choose(is_better, other, start)
        queue = sorted_queue

        # The next segment of this branch.
        goes_through = passes & ~total
        next_d = dr.select(total, mirrored, dr.select(is_glass & ~is_void, refracted, d))
        scale = dr.select(total, 1, (1 - reflectance) * dr.select(is_glass, dr.square(eta_ti), 1))
        scale = dr.select(is_thin, scale * color, mi.Color3f(scale))
        solids = dr.select(goes_through, beyond, solids)
        way = dr.select(real, 0, way)
        beta = dr.select(passes & ~is_void, beta * scale, beta)
        o = dr.select(passes, p + dr.select(goes_through, -outward, outward) * offset, o)
        o = dr.select(again, o + d * (pi.t * (1 + 2.4e-7) + 1e-7), o)
        d = dr.select(passes, next_d, d)
        last_face = dr.select(hit, face, last_face)
        vertex = dr.select(real, vertex + 1, vertex)
        step += 1

        # The end of this branch: the next one, or none.
        is_over = missed | (hit & ~passes) | (real & (vertex == max_depth))
        turns = is_over & (branch + 1 < max_branches)
        if queue:
            turns &= queue[0][0] > 0
            now = (mi.Float(0), o, d, beta, last_face, solids)
            _, o, d, beta, last_face, solids = choose(turns, queue[0], now)
            queue = [choose(turns, after, this) for this, after in zip(queue, [*queue[1:], no_start], strict=True)]
        way = dr.select(turns, 0, way)
        vertex, branch = dr.select(turns, 0, vertex), dr.select(turns, branch + 1, branch)
        active &= (~is_over | turns) & (step < max_branches * max_depth + SPARE_STEPS)
        return o, d, beta, solids, way, last_face, branch, vertex, step, tuple(queue), active

    state = (
        o,
        d,
        dr.full(mi.Color3f, 1, count),
        dr.full(mi.UInt32, no_solids(media), count),
        dr.zeros(mi.Float, count),
        dr.full(mi.Int32, -1, count),
        dr.zeros(mi.UInt32, count),
        dr.zeros(mi.UInt32, count),
        dr.zeros(mi.UInt32, count),
        tuple(tuple(dr.full(kind, value, count) for kind, value in zip(kinds, values, strict=True))
              for _ in range(max_branches - 1)),
        dr.full(mi.Bool, True, count),
    )  # fmt: skip
    dr.while_loop(state, is_tracing, advance, label="light_path")
    return {
        "object_id": ids, "uv": out_uv, "uv_slope": out_slope, "direction": out_direction, "position": out_position,
        "normal": out_normal, "throughput": out_throughput, "medium_length": lengths, "has_left": left,
        "end_direction": end_direction, "end_throughput": end_throughput,
    }  # fmt: skip


def _mirror_rough(d, normal, alpha, u1, u2):
    """A visible facet of a rough surface mirrors a ray that arrives along `d`; with alpha = 0 the surface itself does.

    Source: GGX facets with Smith's shadowing, sampled by their visible area (Dupuy and Benyoub 2023, "Sampling Visible
    GGX Normals with Spherical Caps"). Times Fresnel's term, `shadowing` is what a sampled direction weighs.

    Returns:
        The mirrored direction, the cosine of the angle at the facet, and the shadowing (0 below the surface).
    """
    import drjit as dr
    import mitsuba as mi

    frame = mi.Frame3f(normal)
    wi = frame.to_local(-d)
    stretched = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, dr.maximum(wi.z, 1e-6)))
    z = dr.fma(1 - u2, 1 + stretched.z, -stretched.z)
    sine, azimuth = dr.safe_sqrt(1 - z * z), 2 * dr.pi * u1
    cap = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), z) + stretched
    facet = dr.normalize(mi.Vector3f(alpha * cap.x, alpha * cap.y, dr.maximum(cap.z, 1e-6)))
    cosine = dr.clip(dr.dot(wi, facet), 0, 1)
    wo = 2 * cosine * facet - wi
    tangent2 = (wo.x * wo.x + wo.y * wo.y) / dr.maximum(wo.z * wo.z, 1e-12)
    shadowing = dr.select(wo.z > 0, 2 / (1 + dr.sqrt(1 + alpha * alpha * tangent2)), 0)
    return dr.normalize(frame.to_world(wo)), cosine, shadowing
