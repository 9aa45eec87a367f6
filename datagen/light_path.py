"""Owns light paths: which surfaces really shine into a pixel, through refraction and by reflection.

A straight ray looks up the wrong texels behind solid glass. Here each ray is followed as light goes, in two branches.
Branch 0 is refracted: through every dielectric interface by Snell's law (total internal reflection reflects it),
straight through thin panes, until it meets something opaque or leaves the scene. Branch 1 is reflected at the first
surface, when that is glass or glossy, and then followed in the same way. Further branches at later interfaces are not
traced: what they carry is left to whoever shades the layers.

Vectorised variants only. Call `use_mitsuba` first.
"""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportIndexIssue=false

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from datagen.errors import HyalineError
from datagen.meshes import Mesh
from datagen.mitsuba_scene import is_scalar, load_geometry_mitsuba
from datagen.scene import Conductor, Dielectric, Material, Plastic, ThinDielectric

if TYPE_CHECKING:
    import mitsuba as mi

BRANCHES = ("refracted", "mirror")

OPAQUE, DIELECTRIC, THIN, COATED, METAL = range(5)
"""What a surface does to a ray; the tracer's own numbers for the classes of materials."""

OFFSET = 2e-6
"""How far, relative to 1 + its largest coordinate, a new ray starts from its surface: neighbouring faces round."""

SPARE_STEPS = 4
"""Trace steps beyond the vertices of both branches, for hits that do not count."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPaths:
    """The vertices of both branches of a bundle of rays, in the order in which the camera's ray meets them.

    A branch ends on an opaque surface (its last vertex), in the open (`has_left`), or after `vertex` vertices.
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
    """Metres that the last segment ran inside glass; 0 in air."""
    has_left: Bool[np.ndarray, "branch ray"]
    end_direction: Float32[np.ndarray, "branch ray 3"]
    """Unit direction in which the branch left the scene; 0 where it did not."""
    end_throughput: Float32[np.ndarray, "branch ray 3"]
    """Share of the environment's radiance from there that reaches the camera; 0 where it did not."""


class LightPathTracer:
    """A loaded geometry with the materials of its surfaces; follows any number of rays."""

    def __init__(self, meshes: tuple[Mesh, ...], materials: tuple[Material, ...]) -> None:
        if is_scalar():
            raise HyalineError(
                "light paths: Mitsuba runs as scalar_rgb, which cannot trace them; "
                "`datagen doctor` names the libLLVM to install"
            )
        self._scene = load_geometry_mitsuba(meshes)
        self._tables = _Tables(meshes, materials)

    def trace(self, origins: Float32[np.ndarray, "ray 3"], directions: Float32[np.ndarray, "ray 3"],
              max_vertices: int = 8) -> LightPaths:  # fmt: skip
        """Follows rays that start in air; unit directions."""
        return _trace(self._scene, self._tables, origins, directions, max_vertices)


class _Tables:
    """What the kernel looks up: by object its optics, by face its corners' normals and uv."""

    def __init__(self, meshes: tuple[Mesh, ...], materials: tuple[Material, ...]) -> None:
        import mitsuba as mi

        def array(values: list[float]) -> "mi.Float":
            return mi.Float(np.array(values, np.float32))

        self.kind = mi.UInt32(np.array([_kind(material) for material in materials], np.uint32))
        self.ior = array([getattr(material, "ior", 1.0) for material in materials])
        self.absorption = [
            array([material.absorption[c] if isinstance(material, Dielectric) else 0 for material in materials])
            for c in range(3)
        ]
        self.metal = [
            array([material.color[c] if isinstance(material, Conductor) else 1 for material in materials])
            for c in range(3)
        ]
        first_face = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])[:-1]
        self.first_face = mi.UInt32(first_face.astype(np.uint32))
        positions = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
        self.positions = mi.Float(positions.ravel())
        self.normals = mi.Float(np.concatenate([mesh.normals[mesh.faces] for mesh in meshes]).ravel())
        self.uv = mi.Float(np.concatenate([mesh.uv[mesh.faces] for mesh in meshes]).ravel())


def _kind(material: Material) -> int:
    match material:
        case Dielectric():
            return DIELECTRIC
        case ThinDielectric():
            return THIN
        case Plastic():
            return COATED
        case Conductor():
            return METAL
        case _:
            return OPAQUE


def _trace(scene: "mi.Scene", tables: _Tables, origins: np.ndarray, directions: np.ndarray,
           max_vertices: int) -> LightPaths:  # fmt: skip
    """One kernel for all vertices of both branches, recorded once for each number of vertices."""
    import drjit as dr
    import mitsuba as mi

    count = len(directions)
    slots = 2 * max_vertices * count
    ids, lengths = dr.zeros(mi.UInt32, slots), dr.zeros(mi.Float, slots)
    out_uv = [dr.zeros(mi.Float, slots) for _ in range(2)]
    out_direction, out_position, out_normal, out_throughput = (
        [dr.zeros(mi.Float, slots) for _ in range(3)] for _ in range(4)
    )
    end_direction, end_throughput = ([dr.zeros(mi.Float, 2 * count) for _ in range(3)] for _ in range(2))
    left = dr.zeros(mi.UInt32, 2 * count)
    ray_index = dr.arange(mi.UInt32, count)

    def store(targets, values, index, mask):
        for target, value in zip(targets, values, strict=True):
            dr.scatter(target, value, index, mask)

    def corner_mix(table, face, channels, weights, active):
        """Barycentric mix of a per-corner attribute of a face."""
        mixed = []
        for channel in range(channels):
            base = face * (3 * channels) + channel
            values = [dr.gather(mi.Float, table, base + corner * channels, active) for corner in range(3)]
            mixed.append(values[0] * weights[0] + values[1] * weights[1] + values[2] * weights[2])
        return mixed

    def is_tracing(*state):
        return state[-1]

    def advance(o, d, beta, medium, last_face, branch, vertex, step, m_o, m_d, m_beta, m_face, has_mirror, active):
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
        p = mi.Point3f(*corner_mix(tables.positions, face_u, 3, weights, hit))
        n = dr.normalize(mi.Vector3f(*corner_mix(tables.normals, face_u, 3, weights, hit)))
        uv = corner_mix(tables.uv, face_u, 2, weights, hit)
        corners = [
            mi.Vector3f(*(dr.gather(mi.Float, tables.positions, face_u * 9 + 3 * k + c, hit) for c in range(3)))
            for k in range(3)
        ]
        n_face = dr.normalize(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))

        # Beer and Lambert, along the segment that ends here.
        in_glass = hit & (medium >= 0)
        glass = mi.UInt32(dr.maximum(medium, 0))
        sigma = mi.Color3f(*(dr.gather(mi.Float, tables.absorption[c], glass, in_glass) for c in range(3)))
        length = dr.select(in_glass, dr.norm(p - o), 0)
        beta = dr.select(in_glass, beta * dr.exp(-sigma * length), beta)

        # The vertex.
        is_outside = dr.dot(d, n_face) < 0
        facing = dr.select(is_outside, n, -n)
        slot = (branch * max_vertices + vertex) * count + ray_index
        dr.scatter(ids, shape + 1, slot, hit)
        dr.scatter(lengths, length, slot, hit)
        store(out_uv, uv, slot, hit)
        store(out_direction, d, slot, hit)
        store(out_position, p, slot, hit)
        store(out_normal, facing, slot, hit)
        store(out_throughput, beta, slot, hit)
        end = branch * count + ray_index
        dr.scatter(left, mi.UInt32(1), end, missed)
        store(end_direction, d, end, missed)
        store(end_throughput, beta, end, missed)

        # What the surface does to the ray.
        kind = dr.gather(mi.UInt32, tables.kind, shape, hit)
        ior = dr.gather(mi.Float, tables.ior, shape, hit)
        is_glass, is_thin = hit & (kind == DIELECTRIC), hit & (kind == THIN)
        cos_i = dr.clip(-dr.dot(d, facing), 0, 1)
        signed = dr.select(is_outside | ~is_glass, cos_i, -cos_i)
        reflectance, cos_t, _, eta_ti = mi.fresnel(signed, ior)
        cos_t = dr.abs(cos_t)
        reflectance = dr.select(is_thin, 2 * reflectance / (1 + reflectance), reflectance)
        total = is_glass & (reflectance >= 1)
        mirrored = dr.normalize(d + 2 * cos_i * facing)
        refracted = dr.normalize(d * eta_ti + facing * (cos_i * eta_ti - cos_t))
        passes = is_thin | is_glass
        offset = OFFSET * (1 + dr.max(dr.abs(p)))
        outward = dr.select(is_outside, n_face, -n_face)

        # The mirror branch starts where the camera's ray meets glass, coated or metal surfaces first.
        metal = mi.Color3f(*(dr.gather(mi.Float, tables.metal[c], shape, hit) for c in range(3)))
        tint = dr.select(kind == METAL, metal, mi.Color3f(reflectance))
        starts = hit & (branch == 0) & (vertex == 0) & (kind != OPAQUE) & ~total
        m_o = dr.select(starts, p + outward * offset, m_o)
        m_d = dr.select(starts, mirrored, m_d)
        m_beta = dr.select(starts, beta * tint, m_beta)
        m_face = dr.select(starts, face, m_face)
        has_mirror |= starts

        # The next segment of this branch.
        goes_through = passes & ~total
        next_d = dr.select(total, mirrored, dr.select(is_glass, refracted, d))
        scale = dr.select(total, 1, (1 - reflectance) * dr.select(is_glass, dr.square(eta_ti), 1))
        medium = dr.select(is_glass & ~total, dr.select(is_outside, mi.Int32(shape), -1), medium)
        beta = dr.select(passes, beta * scale, beta)
        o = dr.select(passes, p + dr.select(goes_through, -outward, outward) * offset, o)
        o = dr.select(again, o + d * (pi.t * (1 + 2.4e-7) + 1e-7), o)
        d = dr.select(passes, next_d, d)
        last_face = dr.select(hit, face, last_face)
        vertex = dr.select(hit, vertex + 1, vertex)
        step += 1

        # The end of this branch: the other one, or none.
        is_over = missed | (hit & ~passes) | (hit & (vertex == max_vertices))
        turns = is_over & (branch == 0) & has_mirror
        o, d = dr.select(turns, m_o, o), dr.select(turns, m_d, d)
        beta, last_face = dr.select(turns, m_beta, beta), dr.select(turns, m_face, last_face)
        medium = dr.select(turns, -1, medium)
        vertex, branch = dr.select(turns, 0, vertex), dr.select(turns, 1, branch)
        active &= (~is_over | turns) & (step < 2 * max_vertices + SPARE_STEPS)
        return o, d, beta, medium, last_face, branch, vertex, step, m_o, m_d, m_beta, m_face, has_mirror, active

    def columns(values):
        return (mi.Float(np.ascontiguousarray(values[:, axis], np.float32)) for axis in range(3))

    zero, none = dr.zeros(mi.UInt32, count), dr.full(mi.Int32, -1, count)
    state = (
        mi.Point3f(*columns(origins)),
        mi.Vector3f(*columns(directions)),
        dr.full(mi.Color3f, 1, count),
        none,
        dr.full(mi.Int32, -1, count),
        zero,
        dr.zeros(mi.UInt32, count),
        dr.zeros(mi.UInt32, count),
        dr.zeros(mi.Point3f, count),
        dr.zeros(mi.Vector3f, count),
        dr.zeros(mi.Color3f, count),
        dr.full(mi.Int32, -1, count),
        dr.full(mi.Bool, False, count),
        dr.full(mi.Bool, True, count),
    )
    dr.while_loop(state, is_tracing, advance, label="light_path")
    outputs = [ids, lengths, left, *out_uv, *out_direction, *out_position, *out_normal, *out_throughput]
    dr.eval(*outputs, *end_direction, *end_throughput)

    def stacked(parts: list, *shape: int) -> np.ndarray:
        return np.stack([np.array(part) for part in parts], axis=-1).reshape(*shape, len(parts))

    shape = (2, max_vertices, count)
    return LightPaths(
        object_id=np.array(ids).astype(np.uint8).reshape(shape),
        uv=stacked(out_uv, *shape),
        direction=stacked(out_direction, *shape),
        position=stacked(out_position, *shape),
        normal=stacked(out_normal, *shape),
        throughput=stacked(out_throughput, *shape),
        medium_length=np.array(lengths).reshape(shape),
        has_left=np.array(left).astype(bool).reshape(2, count),
        end_direction=stacked(end_direction, 2, count),
        end_throughput=stacked(end_throughput, 2, count),
    )
