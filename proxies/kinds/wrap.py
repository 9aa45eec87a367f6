"""Proxies of kinds `wrap` and `lowpoly`: meshes that follow the object into its hollows, by PyMeshLab's alpha wrap.

A wrap encloses what it is made from, be that open, in parts or a soup, and it is closed: a glass has its bowl, panes
become slabs. The kinds differ in how coarse they are and in which way: a wrap stands off evenly, with even triangles; a
low-poly mesh is a finer wrap with far fewer triangles, grown until it encloses the object again.
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
"""Diameter of the ball that carves a wrap, in parts of the diagonal: it enters no hollow that is narrower."""

LOWPOLY_ALPHA = 0.02

OFFSET_OF_THICKNESS = 0.25
"""How far a wrap stands off its object, in parts of the object's thickness, within `OFFSETS`."""

OFFSETS = (0.001, 0.01)
"""Least and greatest such distance, in parts of the diagonal: close wraps of sheets take tens of thousands of faces."""

FACES = (300, 600, 1200, 2400)
"""Triangles of a low-poly mesh: the first number with which it encloses its object without growing by too much."""

CHARTED_THICKNESSES = (0.2, 1.0)
"""Where the atlas is laid out, nothing is thinner than this part of its length: a slab's rim has texels.

The second is for what finds no room with the first.
"""

MAX_GROWTH = 1.0
"""How far the vertices of a low-poly mesh may move outward, in offsets of the wrap that it is made from."""


Candidate = tuple[Float64[np.ndarray, "_ 3"], Int64[np.ndarray, "_ 3"]]


def fit_wraps(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
    """Each solid's alpha wrap, farther off by its padding; with fewer triangles where the wrap has some too small."""
    wraps = _wraps(solids, paddings, kind="wrap", alpha=WRAP_ALPHA, targets=FACES)
    return _first_sound(solids, paddings, [candidates[::-1] for candidates in wraps])


def fit_lowpolys(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
    """Each solid's decimated wrap, its vertices moved outward until it encloses the object."""
    wraps = _wraps(solids, paddings, kind="lowpoly", alpha=LOWPOLY_ALPHA, targets=FACES)
    return _first_sound(solids, paddings, wraps)


def _first_sound(
    solids: tuple[Solid, ...], paddings: tuple[float, ...], candidates: list[list[Candidate]]
) -> tuple[Mesh, ...]:
    """For each solid the first of its candidates that encloses it, when grown, and has room in the atlas."""
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
    # None does when the last ones are coarse; the finest, the wrap itself, encloses the object as it is.
    finest = max(candidates, key=lambda candidate: len(candidate[1]))
    return _surface(solid, *finest, thickness), end - 1


def _wraps(
    solids: tuple[Solid, ...], paddings: tuple[float, ...], *, kind: str, alpha: float, targets: tuple[int, ...]
) -> list[list[Candidate]]:
    """Each solid's decimated wraps and its wrap, in metres."""
    if (problem := meshlab.meshlab_problem()) is not None:
        raise HyalineError(f"a {kind} needs pymeshlab: {problem}, or make `--kind hull`")
    # In a box of diagonal 1 around the origin, where sizes are shares and float32 is finest.
    sizes = [_diagonal(solid) for solid in solids]
    centers = [0.5 * (solid.hull_points.min(axis=0) + solid.hull_points.max(axis=0)) for solid in solids]
    surfaces, offsets = [], []
    for solid, size, center, padding in zip(solids, sizes, centers, paddings, strict=True):
        # Each triangle by itself: of those that share an edge the wrong way, pymeshlab 2025.7 leaves some out.
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
    """How far a wrap stands off, in metres."""
    return float(np.clip(OFFSET_OF_THICKNESS * solid.thickness / _diagonal(solid), *OFFSETS)) * _diagonal(solid)


def _diagonal(solid: Solid) -> float:
    return float(np.linalg.norm(np.ptp(solid.hull_points, axis=0)))
