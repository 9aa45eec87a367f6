"""Proxies of kind `wrap`: meshes that follow the object into its hollows, by PyMeshLab's alpha wrap.

A wrap is closed and encloses its object, even if that is open, in parts or a triangle soup: a glass keeps its bowl,
panes become slabs. PyMeshLab kills its process on some inputs and never returns from others, so it runs in a child with
a time limit: `python -m proxies.kinds.wrap IN.npz OUT.npz`.
"""

# pymeshlab fills its namespace when it is imported; pyright sees none of it.
# pyright: reportAttributeAccessIssue=false

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from datagen.data.meshes import Mesh, face_corners, vertex_normals
from datagen.disk.errors import HyalineError
from datagen.machine.processes import ChildError, arrays_from_child
from datagen.terminal.plugins import install_command
from proxies.solid import Solid, Surface, principal_directions, unwrap_sound

ALPHAS = (0.04, 0.08, 0.16)
"""Diameters of the ball that carves a wrap, relative to the diagonal: it does not enter narrower hollows.

The first whose triangles all get texels is used.
"""

OFFSET_OF_THICKNESS = 0.25
"""Distance of a wrap from its object, relative to the object's thickness, limited by `OFFSETS`."""

OFFSETS = (0.001, 0.01)
"""Least and greatest distance, relative to the diagonal: close wraps of sheets need tens of thousands of faces."""

CHARTED_THICKNESS = 0.2
"""Least thickness in the atlas layout, relative to the length, so that a slab's rim has texels."""

CPU_S = 180
"""CPU seconds of one wrap; a few seconds are usual."""


def fit_wraps(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
    """Each solid's alpha wrap, farther out by its padding."""
    return unwrap_sound(
        lambda index, place: wrapped(solids[index], padding=paddings[index], alpha=ALPHAS[place]),
        count=len(solids),
        places=len(ALPHAS),
    )


def wrapped(solid: Solid, *, padding: float, alpha: float) -> Surface:
    """The solid's alpha wrap; it is thicker in the atlas where it is thin."""
    low, high = solid.hull_points.min(axis=0), solid.hull_points.max(axis=0)
    center, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    offset = float(np.clip(OFFSET_OF_THICKNESS * solid.thickness / size, *OFFSETS)) + padding / size
    # In a box of diagonal 1 around the origin, where float32 is most precise.
    corners = (face_corners(solid.mesh).astype(np.float64) - center) / size
    vertices, faces = alpha_wrap(corners, alpha=alpha, offset=offset)
    vertices = vertices * size + center
    directions = principal_directions(solid.hull_points)
    along = vertices @ directions.T
    extents = np.ptp(along, axis=0)
    stretches = np.maximum(1, CHARTED_THICKNESS * extents.max() / extents)
    return Surface(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces),
        charted=along * stretches @ directions,
    )


def alpha_wrap(
    corners: Float64[np.ndarray, "face 3 3"], *, alpha: float, offset: float
) -> tuple[Float64[np.ndarray, "vertex 3"], Int64[np.ndarray, "_ 3"]]:
    """Vertices and faces of a closed, outward surface around triangles, which may be open or a soup.

    Args:
        alpha: diameter of the ball that carves the space around the triangles, in their units.
        offset: distance of the wrap from the triangles, in the same units.

    Source: Portaneri et al. 2022, Alpha wrapping with an offset.
    """
    try:
        wrap = arrays_from_child(
            "proxies.kinds.wrap", {"corners": corners, "sizes": np.array([alpha, offset])}, cpu_s=CPU_S
        )
    except ChildError as error:
        remedy = "`apt install libgl1`" if "libGL" in str(error) else f"`{install_command('proxies')}`"
        raise HyalineError(f"a wrap needs pymeshlab ({error}); try {remedy}, or make `--kind hull`") from None
    vertices, faces = wrap["vertices"], wrap["faces"].astype(np.int64)
    if len(faces) < 4 or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise HyalineError(f"a wrap has {len(vertices)} vertices and {len(faces)} faces; make `--kind hull`")
    return vertices, faces


def _child(source: Path, target: Path) -> None:
    import pymeshlab

    with np.load(source) as arrays:
        corners, sizes = arrays["corners"].reshape(-1, 3), arrays["sizes"]
    meshes = pymeshlab.MeshSet()
    # Each triangle separately: pymeshlab 2025.7 drops some triangles that share an edge in the wrong direction.
    faces = np.arange(len(corners)).reshape(-1, 3)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=corners, face_matrix=faces))
    alpha, offset = (pymeshlab.PureValue(float(size)) for size in sizes)
    meshes.generate_alpha_wrap(alpha=alpha, offset=offset)
    wrap = meshes.current_mesh()
    np.savez(target, allow_pickle=False, vertices=wrap.vertex_matrix(), faces=wrap.face_matrix())


if __name__ == "__main__":
    _child(Path(sys.argv[1]), Path(sys.argv[2]))
