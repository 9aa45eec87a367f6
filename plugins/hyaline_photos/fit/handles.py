"""Handles: vessels of revolution with the other parts that their masks show."""

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64, Int

from datagen.data.meshes import Mesh
from hyaline_photos.fit.hull import HullShape
from hyaline_photos.fit.lathe import revolved
from hyaline_photos.fit.shapes import Revolution
from hyaline_photos.fit.views import NearRays

if TYPE_CHECKING:
    import manifold3d

BESIDE = 0.0015
"""Metres beside the vessel from which on the hull is a handle, not an error of the hull."""

INSIDE = 0.0003
"""Metres that handles reach into the wall."""

LEAST_PART = 1e-7
"""Cubic metres (0.1 ml) below which a part is an error of the hull."""

LEAST_REACH = 0.2
"""How far a handle reaches away from the vessel, in parts of its largest radius; edges of facets reach less."""

ON_CUT = 1e-5
"""Metres within which a vertex is where a handle was cut off the hull."""

SHORT_EDGE = 3e-6
"""Metres below which edges collapse that a cut leaves."""

ATLAS = 0.8
"""Share of the atlas's height that the vessel has."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Attached:
    """Handles, and how the faces of a vessel are cut to join them."""

    positions: Float64[np.ndarray, "vertex 3"]
    """Vertices in the world; 0 for those that lie on the vessel."""
    face_of: Int[np.ndarray, " vertex"]
    """The vessel's face on which a vertex lies; -1: none."""
    shares: Float64[np.ndarray, "vertex 3"]
    """Barycentric coordinates of each vertex in that face."""
    faces: Int[np.ndarray, "face 3"]
    corner_face: Int[np.ndarray, " face"]
    """The vessel's face that contains each face; -1: none."""
    corner_shares: Float64[np.ndarray, "face 3 3"]
    """Barycentric coordinates of each corner in the vessel's face."""
    normals: Float32[np.ndarray, "face 3 3"]
    """Normals at the corners of handles."""
    uv: Float32[np.ndarray, "face 3 2"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Handled(Revolution):
    """A vessel of revolution with handles; its face count is independent of its parameters."""

    attached: Attached

    @property
    def kind(self) -> str:
        return "revolution with handles"

    def mesh(self) -> Mesh:
        base, attached = super().mesh(), self.attached
        corners = base.faces[attached.face_of]
        on_vessel = np.einsum("vk,vkc->vc", attached.shares, base.vertices[corners].astype(np.float64))
        positions = np.where(attached.face_of[:, None] >= 0, on_vessel, attached.positions).astype(np.float32)
        corners, is_vessel = base.faces[attached.corner_face], attached.corner_face[:, None, None] >= 0
        normals = np.einsum("fik,fkc->fic", attached.corner_shares, base.normals[corners].astype(np.float64))
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        uv = np.einsum("fik,fkc->fic", attached.corner_shares, base.uv[corners].astype(np.float64)) * [1, ATLAS]
        return Mesh(
            vertices=positions[attached.faces].reshape(-1, 3),
            faces=np.arange(3 * len(attached.faces), dtype=np.int32).reshape(-1, 3),
            normals=np.where(is_vessel, normals, attached.normals).astype(np.float32).reshape(-1, 3),
            uv=np.where(is_vessel, uv, attached.uv).clip(0, 1).astype(np.float32).reshape(-1, 2),
        )


def with_handles(vessel: Revolution, hull: HullShape) -> Handled | None:
    """The vessel joined with what its hull has beside it; None if that is nothing.

    Args:
        vessel: hollow, of any numbers.
    """
    import manifold3d

    parts = _beside(vessel, hull)
    if not parts:
        return None
    base = vessel.mesh()
    solid = _solid(base)
    joined = manifold3d.Manifold.batch_boolean([solid, *parts], manifold3d.OpType.Add)
    out = joined.set_tolerance(SHORT_EDGE).to_mesh()
    values, faces = np.asarray(out.vert_properties, np.float64), np.asarray(out.tri_verts).astype(np.int64)
    run = np.repeat(np.asarray(out.run_original_id), np.diff(np.asarray(out.run_index)) // 3)
    face = np.where(run == solid.to_mesh().run_original_id[0], np.asarray(out.face_id).astype(np.int64), -1)
    shares = _shares(values[faces, :3], base.vertices[base.faces[face]].astype(np.float64))
    shares[face < 0] = 0
    one = np.arange(len(values))
    one[np.asarray(out.merge_from_vert, np.int64)] = np.asarray(out.merge_to_vert, np.int64)
    welded = one[faces]
    # Where vessel and handle meet, a vertex lies on the vessel, and moves with it.
    is_vessel = face >= 0
    on_vessel, first = np.unique(welded[is_vessel], return_index=True)
    face_of, share_of = np.full(len(values), -1), np.zeros((len(values), 3))
    face_of[on_vessel], share_of[on_vessel] = (
        np.repeat(face[is_vessel], 3)[first],
        shares[is_vessel].reshape(-1, 3)[first],
    )
    normals, uv = values[faces, 3:6], values[faces, 6:]
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    attached = Attached(
        positions=values[:, :3],
        face_of=face_of,
        shares=share_of,
        faces=welded,
        corner_face=face,
        corner_shares=shares,
        normals=normals.astype(np.float32),
        uv=(uv * [1, 1 - ATLAS] + [0, ATLAS]).clip(0, 1).astype(np.float32),
    )
    fields = {field.name: getattr(vessel, field.name) for field in dataclasses.fields(vessel)}
    return Handled(**fields, attached=attached)


def without_handles(rays: NearRays, vessel: Revolution, hull: HullShape) -> NearRays:
    """The rays that pass no handle, so that they show the vessel alone."""
    from datagen.trace.peel import Peeler

    parts = _beside(vessel, hull)
    if not parts:
        return rays
    meshes = tuple(_mesh(part) for part in parts)
    hits = Peeler(meshes).trace(rays.origins.astype(np.float32), rays.directions.astype(np.float32), 1)
    return rays.only(hits.shape[0] < 0)


def _beside(vessel: Revolution, hull: HullShape) -> "list[manifold3d.Manifold]":
    """The parts of a hull beside a vessel, which reach into its wall."""
    # The side alone, from the edge of the flat bottom on.
    bottom = int(np.flatnonzero(vessel.outside[:, 1] > vessel.outside[0, 1] + ON_CUT)[0]) - 1
    radii, heights = vessel.outside[bottom:].T
    reach = float(np.ptp(hull.surface.vertices, axis=0).max())
    # Above and below the vessel is what no view sees past, not a handle.
    below, above = heights[0] - reach, heights[-1] + reach
    wide = np.concatenate(
        [
            [(0, below), (radii[0] + BESIDE, below)],
            np.stack([radii + BESIDE, heights], axis=1),
            [(radii[-1] + BESIDE, above), (0, above)],
        ]
    )
    parts = (_solid(hull.surface) - _solid(revolved(vessel.axis, wide))).decompose()

    def rooted(points: Float64[np.ndarray, "vertex 3"]) -> Float64[np.ndarray, "vertex 3"]:
        relative = points - vessel.axis.point
        along = relative @ vessel.axis.direction
        across = relative - along[:, None] * vessel.axis.direction
        away = np.linalg.norm(across, axis=1)
        radius = np.interp(along, heights, radii)
        is_cut = np.abs(away - radius - BESIDE) < ON_CUT
        return points - np.where(is_cut, (BESIDE + INSIDE) / away, 0)[:, None] * across

    def reaches(part: "manifold3d.Manifold") -> bool:
        points = np.asarray(part.to_mesh().vert_properties, np.float64)[:, :3] - vessel.axis.point
        along = points @ vessel.axis.direction
        away = np.linalg.norm(points - along[:, None] * vessel.axis.direction, axis=1)
        stands_out = float((away - np.interp(along, heights, radii)).max()) > LEAST_REACH * radii.max()
        # What is on top, over the axis, is a place that no view sees past.
        return part.volume() > LEAST_PART and stands_out and away.min() > radii.max() / 2

    return [part.warp_batch(rooted) for part in parts if reaches(part)]


def _mesh(part: "manifold3d.Manifold") -> Mesh:
    out = part.to_mesh()
    values = np.asarray(out.vert_properties, np.float32)
    faces = np.asarray(out.tri_verts).astype(np.int32)
    return Mesh(vertices=values[:, :3], faces=faces, normals=values[:, 3:6], uv=values[:, 6:8])


def _solid(mesh: Mesh) -> "manifold3d.Manifold":
    """A closed mesh with its normals and uv, ready for boolean operations."""
    import manifold3d

    _, first, place = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    one, index = first[place.reshape(-1)], np.arange(len(mesh.vertices))
    is_seam = one != index
    return manifold3d.Manifold(
        manifold3d.Mesh(
            vert_properties=np.ascontiguousarray(np.hstack([mesh.vertices, mesh.normals, mesh.uv]), np.float32),
            tri_verts=np.ascontiguousarray(mesh.faces, np.uint32),
            merge_from_vert=np.ascontiguousarray(index[is_seam], np.uint32),
            merge_to_vert=np.ascontiguousarray(one[is_seam], np.uint32),
            face_id=np.arange(len(mesh.faces), dtype=np.uint32),
        )
    )


def _shares(
    points: Float64[np.ndarray, "face 3 3"], corners: Float64[np.ndarray, "face 3 3"]
) -> Float64[np.ndarray, "face 3 3"]:
    """Barycentric coordinates of three points each in triangles."""
    a, b, c = (corners[:, None, index] for index in range(3))
    normal = np.cross(b - a, c - a)
    square = np.maximum((normal**2).sum(axis=-1), 1e-30)
    at_b = (np.cross(points - a, c - a) * normal).sum(axis=-1) / square
    at_c = (np.cross(b - a, points - a) * normal).sum(axis=-1) / square
    shares = np.stack([1 - at_b - at_c, at_b, at_c], axis=-1)
    # Corners that stay are exactly the vessel's.
    is_corner = shares.max(axis=-1, keepdims=True) > 1 - 1e-3
    return np.where(is_corner, np.eye(3)[shares.argmax(axis=-1)], shares)
