"""How good a proxy is: what it encloses, how much larger it is than its object, how far apart their surfaces are."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

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
)
from datagen.terminal.command import say
from proxies.meshing import meshlab
from proxies.meshing.inside import enclosed_share
from proxies.meshing.solid import Solid, outside_by, used_positions

SAMPLES = 4096
"""Points on a proxy from which distances are taken, besides its vertices."""

ROUNDING = 32 * 2.0**-24
"""Parts of the largest coordinate by which a facet of float32 vertices may miss its plane."""

ATLAS_ROOM = 1.5e-6
"""Least area in uv, in parts of the atlas, that a face must have: a tenth of a texel at 256^2."""


@dataclass(frozen=True, kw_only=True)
class Enclosure:
    """Whether a proxy may stand for its object."""

    inside_share: float
    """Of the object's vertices, for a convex proxy; of vertices and points on the surface, for one of several convex
    parts; else of the object's faces."""
    open_edges: int
    """0 for a closed mesh."""
    volume: float
    """Positive when the faces look outward. Cubic metres."""
    smallest_chart: float
    """Least area of a face in uv, in parts of the atlas."""

    @property
    def problem(self) -> str | None:
        """What is wrong, in a few words; None when the proxy is sound."""
        if self.open_edges:
            return f"has {self.open_edges} open edges"
        if self.volume <= 0:
            return f"encloses {self.volume:g} m^3, it is inside out"
        if self.inside_share < 1:
            return f"leaves {100 * (1 - self.inside_share):.3g} % of the object outside"
        if self.smallest_chart < ATLAS_ROOM:
            return f"has a face of {self.smallest_chart:g} of the atlas"
        return None


def enclosure(proxy: Mesh, truth: Mesh) -> Enclosure:
    """Checks a proxy as it is stored, in float32, against its object."""
    return Enclosure(
        inside_share=_inside_share(proxy, truth),
        open_edges=open_edges(proxy),
        volume=signed_volume(proxy),
        smallest_chart=smallest_chart(proxy),
    )


def smallest_chart(mesh: Mesh) -> float:
    """Least area of a face in uv; charts may be mirrored, xatlas 0.0.11 turns them by exchanging u and v."""
    a, b, c = np.moveaxis(mesh.uv[mesh.faces].astype(np.float64), 1, 0)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return float((0.5 * np.abs(ux * vy - uy * vx)).min())


def _inside_share(proxy: Mesh, truth: Mesh) -> float:
    positions, corners = used_positions(truth), face_corners(proxy).astype(np.float64)
    tolerance = ROUNDING * max(np.abs(positions).max(), np.abs(proxy.vertices).max())
    component = component_of_faces(proxy)
    parts = [corners[component == part] for part in range(int(component.max()) + 1)]
    # Planes are exact for what is convex, and leave room for rounding.
    if any(outside_by(part, part.reshape(-1, 3)).max() > tolerance for part in parts):
        return enclosed_share(proxy, truth)
    if len(parts) > 1:
        # Where the object passes from one part to the next, its vertices do not tell all.
        positions = np.concatenate([positions, surface_points(truth, SAMPLES)])
    return float((np.min([outside_by(part, positions) for part in parts], axis=0) <= tolerance).mean())


def proxy_statistics(
    meshes: tuple[Mesh, ...], truths: tuple[Mesh, ...], solids: tuple[Solid, ...]
) -> tuple[ProxyStatistics, ...]:
    """The numbers of each proxy; flat objects count with the minimal thickness, so that ratios are finite.

    Args:
        meshes: those that are the object's own mesh (the same in memory) are at no distance from it.
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
            # pymeshlab measures in float32: more digits mean nothing.
            volume_ratio=_rounded(signed_volume(mesh) / solid.hull_volume),
            mean_distance=_rounded(distances.get(place, nothing)[:SAMPLES].mean()),
            max_distance=_rounded(distances.get(place, nothing).max()),
        )
        for place, (mesh, solid) in enumerate(zip(meshes, solids, strict=True))
    )


def surface_points(mesh: Mesh, count: int) -> Float64[np.ndarray, "count 3"]:
    """Points spread evenly over a surface, always the same ones: strata of area, a low-discrepancy place in each."""
    areas = face_areas(mesh)
    chosen = np.searchsorted(np.cumsum(areas) / areas.sum(), (np.arange(count) + 0.5) / count)
    s, t = ((np.arange(1, count + 1) / PLASTIC**power) % 1 for power in (1, 2))  # The R2 sequence.
    is_beyond = s + t > 1
    s, t = np.where(is_beyond, 1 - s, s)[:, None], np.where(is_beyond, 1 - t, t)[:, None]
    a, b, c = np.moveaxis(face_corners(mesh)[np.minimum(chosen, len(areas) - 1)].astype(np.float64), 1, 0)
    return a + s * (b - a) + t * (c - a)


def distances_to(clouds: list[Float64[np.ndarray, "_ 3"]], truths: tuple[Mesh, ...]) -> list[Float[np.ndarray, "_"]]:
    """The distance in metres from each point of each cloud to the surface of the mesh of the same place.

    By pymeshlab, ten times faster; where that is not to be had by NumPy, and a line says so. They agree to float32,
    but for slivers, which pymeshlab 2025.7 sometimes misses: its distance to a needle is then too long.
    """
    surfaces = [welded(mesh) for mesh in truths]
    surfaces = [(positions.astype(np.float64), faces.astype(np.int64)) for positions, faces in surfaces]
    if meshlab.meshlab_problem() is None:
        try:
            return meshlab.surface_distances(
                [(points, *surface) for points, surface in zip(clouds, surfaces, strict=True)]
            )
        except meshlab.MeshlabError as error:
            say(f"distances: pymeshlab failed ({error}); NumPy measures them")
    return [
        point_distances(points, positions[faces]) for points, (positions, faces) in zip(clouds, surfaces, strict=True)
    ]


def point_distances(
    points: Float64[np.ndarray, "point 3"], corners: Float64[np.ndarray, "face 3 3"]
) -> Float64[np.ndarray, "point"]:
    """Exact distances from points to triangles, without pymeshlab."""
    from scipy.spatial import KDTree
    from trimesh.triangles import closest_point

    # No triangle is farther than its nearest corner; only triangles whose ball reaches closer need a look.
    best = KDTree(corners.reshape(-1, 3)).query(points)[0]
    centers = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centers[:, None], axis=-1).max(axis=1)
    # Trees of triangles of like size, or one large triangle would make every search large.
    sizes = np.floor(np.log2(np.maximum(radii, 1e-30))).astype(int)
    for size in np.unique(sizes)[::-1]:
        index = np.flatnonzero(sizes == size)
        tree, reach = KDTree(centers[index]), radii[index].max()
        for start in range(0, len(points), 512):
            rows = np.arange(start, min(start + 512, len(points)))
            near = tree.query_ball_point(points[rows], best[rows] + reach)
            row = np.repeat(rows, [len(found) for found in near])
            face = index[np.concatenate([np.asarray(found, np.int64) for found in near])]
            if len(row):
                distances = np.linalg.norm(closest_point(corners[face], points[row]) - points[row], axis=-1)
                np.minimum.at(best, row, distances)
    return best


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
