"""Proxies of kinds `wrap` and `lowpoly`: meshes that follow the object into its hollows, by PyMeshLab's alpha wrap.

A wrap is closed and encloses its object, even if that is open, in parts or a triangle soup: a glass keeps its bowl,
panes become slabs. The kinds differ in their coarseness: a wrap has an even distance and even triangles; a low-poly
mesh is a finer wrap with far fewer triangles, grown until it encloses the object again.
"""

import numpy as np
from jaxtyping import Float64, Int64

from datagen.data.meshes import Mesh, face_corners, vertex_normals
from datagen.disk.errors import HyalineError
from proxies.meshing import meshlab
from proxies.meshing.measure import enclosed_share
from proxies.meshing.solid import Solid, principal_directions
from proxies.meshing.surface import Surface, unwrap_sound

WRAP_ALPHA = 0.04
"""Diameter of the ball that carves a wrap, relative to the diagonal: it does not enter narrower hollows."""

LOWPOLY_ALPHA = 0.02

OFFSET_OF_THICKNESS = 0.25
"""Distance of a wrap from its object, relative to the object's thickness, limited by `OFFSETS`."""

OFFSETS = (0.001, 0.01)
"""Least and greatest distance, relative to the diagonal: close wraps of sheets need tens of thousands of faces."""

FACES = (300, 600, 1200, 2400)
"""Triangles of a low-poly mesh: the first number that encloses its object without growing too much is used."""

CHARTED_THICKNESSES = (0.2, 1.0)
"""Least thickness in the atlas layout, relative to the length, so that a slab's rim has texels.

The second is for meshes that do not fit with the first.
"""

MAX_GROWTH = 1.0
"""Largest outward movement of the vertices of a low-poly mesh, in offsets of its wrap."""


Candidate = tuple[Float64[np.ndarray, "_ 3"], Int64[np.ndarray, "_ 3"]]


def fit_wraps(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
    """Each solid's alpha wrap, moved outward by its padding; with fewer triangles if some are too small."""
    wraps = _wraps(solids, paddings, kind="wrap", alpha=WRAP_ALPHA, targets=FACES)
    return _first_sound(solids, paddings, [candidates[::-1] for candidates in wraps])


def fit_lowpolys(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
    """Each solid's decimated wrap, its vertices moved outward until it encloses the object."""
    wraps = _wraps(solids, paddings, kind="lowpoly", alpha=LOWPOLY_ALPHA, targets=FACES)
    return _first_sound(solids, paddings, wraps)


def _first_sound(
    solids: tuple[Solid, ...], paddings: tuple[float, ...], candidates: list[list[Candidate]]
) -> tuple[Mesh, ...]:
    """For each solid the first of its candidates that encloses it, when grown, and fits into the atlas."""
    return unwrap_sound(
        lambda index, first: _first_enclosing(solids[index], candidates[index], first, padding=paddings[index]),
        count=len(solids),
        places=len(CHARTED_THICKNESSES) * (len(FACES) + 1),
    )


def _first_enclosing(solid: Solid, candidates: list[Candidate], first: int, *, padding: float) -> tuple[Surface, int]:
    """The first of the candidates, from `first` on, that encloses the object when it has grown, and its place.

    Places go through the candidates once for each charted thickness.
    """
    count = len(candidates)
    thickness = CHARTED_THICKNESSES[first // count]
    end = (first // count + 1) * count
    for place in range(first, end):
        vertices, faces = candidates[place % count]
        normals = vertex_normals(vertices, faces)
        for growth in MAX_GROWTH * _offset(solid) * np.array([0, 1 / 8, 1 / 4, 1 / 2, 1]):
            grown = vertices + (growth + padding) * normals
            if enclosed_share(_bare(grown, faces), solid.mesh) == 1:
                return _surface(solid, grown, faces, thickness), place
    # If none does, because the last ones are coarse: the finest, the wrap itself, encloses the object as it is.
    finest = max(candidates, key=lambda candidate: len(candidate[1]))
    return _surface(solid, *finest, thickness), end - 1


def _wraps(
    solids: tuple[Solid, ...], paddings: tuple[float, ...], *, kind: str, alpha: float, targets: tuple[int, ...]
) -> list[list[Candidate]]:
    """Each solid's decimated wraps and its wrap, in metres."""
    if (problem := meshlab.meshlab_problem()) is not None:
        raise HyalineError(f"a {kind} needs pymeshlab: {problem}, or make `--kind hull`")
    # In a box of diagonal 1 around the origin, where float32 is most precise.
    sizes = [_diagonal(solid) for solid in solids]
    centers = [0.5 * (solid.hull_points.min(axis=0) + solid.hull_points.max(axis=0)) for solid in solids]
    surfaces, offsets = [], []
    for solid, size, center, padding in zip(solids, sizes, centers, paddings, strict=True):
        # Each triangle separately: pymeshlab 2025.7 drops some triangles that share an edge in the wrong direction.
        corners = face_corners(solid.mesh).reshape(-1, 3).astype(np.float64)
        surfaces.append(((corners - center) / size, np.arange(len(corners)).reshape(-1, 3)))
        offsets.append((_offset(solid) + padding) / size)
    try:
        found = meshlab.alpha_wraps(surfaces, alpha=alpha, offsets=offsets, targets=targets)
    except meshlab.MeshlabError as error:
        raise HyalineError(f"a {kind} needs pymeshlab, which failed ({error}); make `--kind hull`") from None
    return [
        [(vertices * size + center, faces) for vertices, faces in wraps]
        for wraps, size, center in zip(found, sizes, centers, strict=True)
    ]


def _surface(solid: Solid, vertices: np.ndarray, faces: np.ndarray, thickness: float) -> Surface:
    directions = principal_directions(solid.hull_points)
    along = vertices @ directions.T
    extents = np.ptp(along, axis=0)
    stretches = np.maximum(1, thickness * extents.max() / extents)
    return Surface(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces),
        charted=along * stretches @ directions,
    )


def _bare(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """The surface as a mesh without uv, rounded as it will be stored."""
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=faces.astype(np.int32),
        normals=np.zeros(vertices.shape, np.float32),
        uv=np.zeros((len(vertices), 2), np.float32),
    )


def _offset(solid: Solid) -> float:
    """A wrap's distance from its object in metres."""
    return float(np.clip(OFFSET_OF_THICKNESS * solid.thickness / _diagonal(solid), *OFFSETS)) * _diagonal(solid)


def _diagonal(solid: Solid) -> float:
    return float(np.linalg.norm(np.ptp(solid.hull_points, axis=0)))
