"""The quality of a proxy: whether it encloses its object, their volumes, and the distance of their surfaces.

Enclosure is tested for vertices, edges and faces, without sampling: if no edge of either surface crosses a face of the
other, each connected part of one lies completely inside or outside the other, and one point decides which.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from datagen.data.geometries import ProxyStatistics
from datagen.data.meshes import Mesh, component_of_faces, face_corners, open_edges, points_on, signed_volume
from datagen.data.queries import crossings, nearest_points, windings
from proxies.solid import ATLAS_ROOM, Solid, outside_by, smallest_chart, used_positions

SAMPLES = 4096
"""Points on a proxy, besides its vertices, for which distances are measured."""

ROUNDING = 32 * 2.0**-24
"""Largest distance of a facet with float32 vertices from its plane, relative to the largest coordinate."""

TOUCH = 1e-9
"""Share of an edge's length up to which it touches what it does not reach."""

EDGES_AT_ONCE = 512


@dataclass(frozen=True, kw_only=True)
class Enclosure:
    """Whether a proxy is sound."""

    inside_share: float
    """Share of the object's vertices for a convex proxy, otherwise of the object's faces."""
    problem: str | None
    """The problem in a few words; None if the proxy is sound."""


def enclosure(proxy: Mesh, truth: Mesh | None) -> Enclosure:
    """Checks a proxy as it is stored, in float32, against its object.

    Args:
        truth: None for a fitted surface, which need not enclose anything, and whose roundings may be finer than texels.
    """
    inside_share = 1.0 if truth is None else _inside_share(proxy, truth)
    chart = 1.0 if truth is None else smallest_chart(proxy)
    problem = None
    if count := open_edges(proxy):
        problem = f"has {count} open edges"
    elif (volume := signed_volume(proxy)) <= 0:
        problem = f"encloses {volume:g} m^3, it is inside out"
    elif inside_share < 1:
        problem = f"leaves {100 * (1 - inside_share):.3g} % of the object outside"
    elif chart < ATLAS_ROOM:
        problem = f"has a face of {chart:g} of the atlas"
    return Enclosure(inside_share=inside_share, problem=problem)


def proxy_statistics(mesh: Mesh, truth: Mesh, solid: Solid) -> ProxyStatistics:
    """The numbers of a proxy; a flat object counts with the minimal thickness, so that ratios are finite."""
    # Digits beyond float32's are meaningless.
    ratio = float(f"{signed_volume(mesh) / solid.hull_volume:.6g}")
    if mesh is truth:
        return ProxyStatistics(volume_ratio=ratio, mean_distance=0.0, max_distance=0.0)
    points = np.concatenate([points_on(mesh, SAMPLES).position, mesh.vertices.astype(np.float64)])
    distances, _ = nearest_points(points, face_corners(truth).astype(np.float64))
    mean, farthest = (float(f"{value:.6g}") for value in (distances[:SAMPLES].mean(), distances.max()))
    return ProxyStatistics(volume_ratio=ratio, mean_distance=mean, max_distance=farthest)


def _inside_share(proxy: Mesh, truth: Mesh) -> float:
    positions, corners = used_positions(truth), face_corners(proxy).astype(np.float64)
    tolerance = ROUNDING * max(np.abs(positions).max(), np.abs(proxy.vertices).max())
    # Planes are exact for a convex proxy, with a tolerance for rounding.
    if outside_by(corners, corners.reshape(-1, 3)).max() <= tolerance:
        return float((outside_by(corners, positions) <= tolerance).mean())
    return enclosed_share(proxy, truth)


def enclosed_share(proxy: Mesh, truth: Mesh) -> float:
    """Share of the object's faces that are completely inside the proxy; 1 only if it encloses the whole object."""
    corners = face_corners(truth).astype(np.float64)
    is_inside = ~crossed_faces(proxy, truth)
    component = component_of_faces(truth)
    around = face_corners(proxy).astype(np.float64)
    for part in np.unique(component):
        mine = np.flatnonzero((component == part) & is_inside)
        if len(mine) and windings(around, corners[mine[:1], 0])[0] < 1:
            is_inside[mine] = False
    return float(is_inside.mean())


def crossed_faces(proxy: Mesh, truth: Mesh) -> Bool[np.ndarray, " face"]:
    """Mask of the object's faces that intersect or touch the proxy's surface."""
    ours, around = (face_corners(mesh).astype(np.float64) for mesh in (truth, proxy))
    crossed = np.zeros(len(ours), bool)
    for edge, _ in _crossings(_edges(ours), around):
        crossed[edge // 3] = True
    for _, face in _crossings(_edges(around), ours):
        crossed[face] = True
    return crossed


def _edges(corners: Float64[np.ndarray, "face 3 3"]) -> Float64[np.ndarray, "edge 2 3"]:
    """Both ends of each face's three edges."""
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)


def _crossings(
    edges: Float64[np.ndarray, "edge 2 3"], corners: Float64[np.ndarray, "face 3 3"]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs (edge, face), in pieces, where the edge intersects or touches the face.

    Edges in a face's plane are undecidable, and not needed: other edges meet where they do.
    """
    low, high = edges.min(axis=1), edges.max(axis=1)
    face_low, face_high = corners.min(axis=1), corners.max(axis=1)
    order = np.argsort(low[:, int(np.ptp(low, axis=0).argmax())])
    for start in range(0, len(order), EDGES_AT_ONCE):
        part = order[start : start + EDGES_AT_ONCE]
        is_near = (face_low <= high[part].max(axis=0)) & (face_high >= low[part].min(axis=0))
        near = np.flatnonzero(is_near.all(axis=1))
        for edge, face, share in crossings(corners[near], edges[part, 0], edges[part, 1] - edges[part, 0]):
            within = np.abs(share - 0.5) <= 0.5 + TOUCH
            yield part[edge[within]], near[face[within]]
