"""The quality of a proxy: whether it encloses its object, their volumes, and the distance of their surfaces.

Enclosure is tested for vertices, edges and faces, without sampling: if no edge of either surface crosses a face of the
other, each connected part of one lies completely inside or outside the other, and one point decides which.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from datagen.data.geometries import ProxyStatistics
from datagen.data.meshes import (
    PLASTIC,
    Mesh,
    component_of_faces,
    face_areas,
    face_corners,
    open_edges,
    signed_volume,
    welded,
    winding_number,
)
from datagen.data.shape_errors import nearest_points
from datagen.terminal.command import say
from proxies.meshing import meshlab
from proxies.meshing.solid import Solid, outside_by, used_positions

SAMPLES = 4096
"""Points on a proxy, besides its vertices, for which distances are measured."""

ROUNDING = 32 * 2.0**-24
"""Largest distance of a facet with float32 vertices from its plane, relative to the largest coordinate."""

ATLAS_ROOM = 1.5e-6
"""Least area of a face in uv, relative to the atlas: a tenth of a texel at 256^2."""


@dataclass(frozen=True, kw_only=True)
class Enclosure:
    """Whether a proxy is sound."""

    inside_share: float
    """Share of the object's vertices for a convex proxy, of vertices and surface points for a proxy of several convex
    parts, otherwise of the object's faces."""
    open_edges: int
    """0 for a closed mesh."""
    volume: float
    """Volume in cubic metres; positive if the faces point outward."""
    smallest_chart: float
    """Least area of a face in uv, relative to the atlas."""

    @property
    def problem(self) -> str | None:
        """The problem in a few words; None if the proxy is sound."""
        if self.open_edges:
            return f"has {self.open_edges} open edges"
        if self.volume <= 0:
            return f"encloses {self.volume:g} m^3, it is inside out"
        if self.inside_share < 1:
            return f"leaves {100 * (1 - self.inside_share):.3g} % of the object outside"
        if self.smallest_chart < ATLAS_ROOM:
            return f"has a face of {self.smallest_chart:g} of the atlas"
        return None


def enclosure(proxy: Mesh, truth: Mesh | None) -> Enclosure:
    """Checks a proxy as it is stored, in float32, against its object.

    Args:
        truth: None for a fitted surface, which need not enclose anything, and whose roundings may be finer than texels.
    """
    return Enclosure(
        inside_share=1.0 if truth is None else _inside_share(proxy, truth),
        open_edges=open_edges(proxy),
        volume=signed_volume(proxy),
        smallest_chart=1.0 if truth is None else smallest_chart(proxy),
    )


def smallest_chart(mesh: Mesh) -> float:
    """Least area of a face in uv; charts may be mirrored, because xatlas 0.0.11 rotates them by swapping u and v."""
    a, b, c = np.moveaxis(mesh.uv[mesh.faces].astype(np.float64), 1, 0)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return float((0.5 * np.abs(ux * vy - uy * vx)).min())


def _inside_share(proxy: Mesh, truth: Mesh) -> float:
    positions, corners = used_positions(truth), face_corners(proxy).astype(np.float64)
    tolerance = ROUNDING * max(np.abs(positions).max(), np.abs(proxy.vertices).max())
    component = component_of_faces(proxy)
    parts = [corners[component == part] for part in range(int(component.max()) + 1)]
    # Planes are exact for convex proxies, with a tolerance for rounding.
    if any(outside_by(part, part.reshape(-1, 3)).max() > tolerance for part in parts):
        return enclosed_share(proxy, truth)
    if len(parts) > 1:
        # Vertices are not enough where the object passes from one part to the next.
        positions = np.concatenate([positions, surface_points(truth, SAMPLES)])
    return float((np.min([outside_by(part, positions) for part in parts], axis=0) <= tolerance).mean())


def proxy_statistics(
    meshes: tuple[Mesh, ...], truths: tuple[Mesh, ...], solids: tuple[Solid, ...]
) -> tuple[ProxyStatistics, ...]:
    """The numbers of each proxy; flat objects count with the minimal thickness, so that ratios are finite.

    Args:
        meshes: an object's own mesh (the same in memory) has distance 0.
    """
    places = [place for place, (mesh, truth) in enumerate(zip(meshes, truths, strict=True)) if mesh is not truth]
    clouds = [
        np.concatenate([surface_points(meshes[place], SAMPLES), meshes[place].vertices.astype(np.float64)])
        for place in places
    ]
    distances = dict(zip(places, distances_to(clouds, tuple(truths[place] for place in places)), strict=True))
    nothing = np.zeros(SAMPLES)
    return tuple(
        ProxyStatistics(
            # pymeshlab measures in float32: more digits are meaningless.
            volume_ratio=_rounded(signed_volume(mesh) / solid.hull_volume),
            mean_distance=_rounded(distances.get(place, nothing)[:SAMPLES].mean()),
            max_distance=_rounded(distances.get(place, nothing).max()),
        )
        for place, (mesh, solid) in enumerate(zip(meshes, solids, strict=True))
    )


def surface_points(mesh: Mesh, count: int) -> Float64[np.ndarray, "count 3"]:
    """Evenly spread, deterministic points on a surface: one low-discrepancy point in each stratum of area."""
    areas = face_areas(mesh)
    chosen = np.searchsorted(np.cumsum(areas) / areas.sum(), (np.arange(count) + 0.5) / count)
    s, t = ((np.arange(1, count + 1) / PLASTIC**power) % 1 for power in (1, 2))  # The R2 sequence.
    is_beyond = s + t > 1
    s, t = np.where(is_beyond, 1 - s, s)[:, None], np.where(is_beyond, 1 - t, t)[:, None]
    a, b, c = np.moveaxis(face_corners(mesh)[np.minimum(chosen, len(areas) - 1)].astype(np.float64), 1, 0)
    return a + s * (b - a) + t * (c - a)


def distances_to(clouds: list[Float64[np.ndarray, "_ 3"]], truths: tuple[Mesh, ...]) -> list[Float[np.ndarray, "_"]]:
    """The distance in metres from each point of each cloud to the surface of the mesh at the same index.

    Uses pymeshlab, which is ten times faster, or NumPy, with a message. They agree to float32, except for slivers that
    pymeshlab 2025.7 sometimes misses: its distance to a needle is then too long.
    """
    surfaces = [welded(mesh) for mesh in truths]
    surfaces = [(positions.astype(np.float64), faces.astype(np.int64)) for positions, faces in surfaces]
    if meshlab.meshlab_problem() is None:
        try:
            return meshlab.surface_distances(
                [(points, *surface) for points, surface in zip(clouds, surfaces, strict=True)]
            )
        except meshlab.MeshlabError as error:
            say(f"distances: pymeshlab failed ({error}); using NumPy instead")
    return [
        nearest_points(points, positions[faces]).distance
        for points, (positions, faces) in zip(clouds, surfaces, strict=True)
    ]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


PAIRS_AT_ONCE = 1 << 20

FLAT = 1e-9
"""Sine of the angle between an edge and a face's plane below which the edge counts as lying in it."""


def enclosed_share(proxy: Mesh, truth: Mesh) -> float:
    """Share of the object's faces that are completely inside the proxy; 1 only if it encloses the whole object."""
    corners = face_corners(truth).astype(np.float64)
    is_inside = ~crossed_faces(proxy, truth)
    component = component_of_faces(truth)
    around = face_corners(proxy).astype(np.float64)
    for part in np.unique(component):
        mine = np.flatnonzero((component == part) & is_inside)
        if len(mine) and winding_number(corners[mine[0], 0], around) < 0.5:
            is_inside[mine] = False
    return float(is_inside.mean())


def crossed_faces(proxy: Mesh, truth: Mesh) -> np.ndarray:
    """Mask (face,) of the object's faces that intersect or touch the proxy's surface."""
    crossed = np.zeros(len(truth.faces), bool)
    edges, faces_of = _edges(truth)
    for edge, _ in _crossings(edges, face_corners(proxy).astype(np.float64)):
        crossed[faces_of[edge].reshape(-1)] = True
    for _, face in _crossings(_edges(proxy)[0], face_corners(truth).astype(np.float64)):
        crossed[face] = True
    return crossed


def _edges(mesh: Mesh) -> tuple[Float64[np.ndarray, "edge 2 3"], Int64[np.ndarray, "edge 2"]]:
    """Ends of each edge of the welded surface, and its two faces (twice the same if it has only one)."""
    positions, faces = welded(mesh)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(faces)), 3)
    edges, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    faces_of = np.stack([face[first], face[first]], axis=-1)
    faces_of[inverse.reshape(-1), 1] = face
    return positions.astype(np.float64)[edges], faces_of


def _crossings(edges: np.ndarray, corners: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs (edge, face), in pieces, where the edge intersects or touches the face."""
    found = []
    for edge, face in _near_pairs(edges, corners):
        (p, q), (a, b, c) = np.moveaxis(edges[edge], 1, 0), np.moveaxis(corners[face], 1, 0)
        normal = np.cross(b - a, c - a)
        # Edges in the face's plane are undecidable, and not needed: other edges meet where they do.
        from_p, from_q = (np.einsum("pi,pi->p", normal, end - a) for end in (p, q))
        even = FLAT * np.linalg.norm(normal, axis=-1) * np.linalg.norm(q - p, axis=-1)
        meets = (from_p * from_q <= 0) & (np.maximum(np.abs(from_p), np.abs(from_q)) > even)
        edge, face, p, q, a, b, c = (array[meets] for array in (edge, face, p, q, a, b, c))
        # The line passes all three sides of the triangle on the same side.
        signs = [np.einsum("pi,pi->p", q - p, np.cross(one - p, other - p)) for one, other in ((a, b), (b, c), (c, a))]
        within = (np.min(signs, axis=0) >= 0) | (np.max(signs, axis=0) <= 0)
        found.append((edge[within], face[within]))
    return found


def _near_pairs(edges: np.ndarray, corners: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs (edge, face), in pieces, with overlapping bounding boxes."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    face_low, face_high = corners.min(axis=1), corners.max(axis=1)
    # Sorted along the axis of their largest spread, each edge overlaps a run of faces; wide faces make runs long, so
    # faces of similar width are grouped.
    axis = int(np.ptp(corners.reshape(-1, 3), axis=0).argmax())
    widths = face_high[:, axis] - face_low[:, axis]
    sizes = np.floor(np.log2(np.maximum(widths, 1e-3 * widths.max() + 1e-30))).astype(int)
    pieces = []
    for size in np.unique(sizes):
        order = np.flatnonzero(sizes == size)
        order = order[np.argsort(face_low[order, axis], kind="stable")]
        starts = np.searchsorted(face_low[order, axis], low[:, axis] - widths[order].max(), side="left")
        stops = np.searchsorted(face_low[order, axis], high[:, axis], side="right")
        counts = np.maximum(stops - starts, 0)
        ends = np.cumsum(counts)
        first = 0
        while first < len(edges):
            last = max(first + 1, int(np.searchsorted(ends, ends[first] - counts[first] + PAIRS_AT_ONCE, side="right")))
            part = slice(first, last)
            edge = np.repeat(np.arange(first, last), counts[part])
            run = np.arange(len(edge)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
            face = order[np.repeat(starts[part], counts[part]) + run]
            meet = ((low[edge] <= face_high[face]) & (face_low[face] <= high[edge])).all(axis=1)
            pieces.append((edge[meet], face[meet]))
            first = last
    return pieces
