"""Proxies of kind `hull`: the convex hull with rounded edges and corners, a smooth convex mesh around the object.

Everything is computed in the space where the hull's smallest ellipsoid is the unit sphere. There, a hull is at least a
third as thick as the sphere (John 1948), so a slab's rim gets a rounding in proportion, and texels.
"""

import numpy as np

from datagen.data.meshes import Mesh, normals_of
from proxies.kinds.ellipsoid import smallest_ellipsoid, sphere_grid
from proxies.solid import Solid, Surface, convex_hull, gauge, outside_by, planes_of, unwrap_sound

CELLS = 12
"""Grid cells along an edge of the octahedron: 4 * 12^2 + 2 = 578 normals, and a hull vertex for each."""

ROUNDING = 0.1
"""Radius of the rounding, relative to the ellipsoid's radii: 19 % more volume around a cube, 3 % around a ball."""

MIN_FACES = (1e-5, 1e-4, 1e-3, 1e-2)
"""Least areas of a face, relative to the whole surface; the first that fits into the atlas, which stretches charts."""


def fit_hulls(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
    """Each solid's rounded convex hull, with all points inside each facet's plane by the padding in metres."""
    return unwrap_sound(
        lambda index, place: rounded_hull(solids[index], padding=paddings[index], min_face=MIN_FACES[place]),
        count=len(solids),
        places=len(MIN_FACES),
    )


def rounded_hull(solid: Solid, *, padding: float, min_face: float) -> Surface:
    """The sum of the shrunken hull and a ball, just large enough to enclose the hull with the padding.

    The farthest point of a sum of two convex bodies along a normal is the sum of their farthest points. So evenly
    spread normals give vertices that are dense where the hull is rounded and sparse where it is flat.
    """
    ellipsoid = smallest_ellipsoid(solid.hull_points)
    root, center = ellipsoid.root, ellipsoid.center
    local = np.linalg.solve(root, (solid.hull_points - center).T).T
    normals = sphere_grid(CELLS).positions
    body = local[(normals @ local.T).argmax(axis=1)] + ROUNDING * normals
    kept = _without_slivers(body, min_face)
    body, normals = body[kept], normals[kept]
    # The ball also moves the flat sides outward: the body shrinks until one of its facets touches the hull.
    body *= gauge(planes_of(body[convex_hull(body)[1]]), local)
    normals_world = np.linalg.solve(root, normals.T).T
    normals_world /= np.linalg.norm(normals_world, axis=-1, keepdims=True)
    outward = np.linalg.solve(root, normals_world.T).T
    offset = padding
    while True:  # Two or three times: a tilted facet moves by less than the offset.
        grown = body + offset * outward
        used, faces = convex_hull(grown)
        assert len(used) == len(grown), "each point is the farthest along its normal"
        vertices = center + grown @ root
        missing = float(outside_by(vertices[faces], solid.hull_points).max()) + padding
        if missing <= 0.1 * padding:
            return Surface(vertices=vertices, faces=faces, normals=normals_world, charted=grown)
        offset += missing


def _without_slivers(points: np.ndarray, min_face: float) -> np.ndarray:
    """Indices of points whose convex hull has no tiny faces: the flattest corner of each such face is removed."""
    kept = np.arange(len(points))
    while True:
        _, faces = convex_hull(points[kept])
        corners = points[kept][faces]
        opposite = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=-1)
        areas = np.linalg.norm(normals_of(corners), axis=-1)
        tiny = np.flatnonzero(areas < min_face * areas.sum())
        if len(tiny) == 0:
            return kept
        is_kept = np.ones(len(kept), bool)
        for face in tiny[np.argsort(areas[tiny], kind="stable")]:
            # Removing a corner also removes its other faces.
            if is_kept[faces[face]].all():
                is_kept[faces[face, opposite[face].argmax()]] = False
        kept = kept[is_kept]
