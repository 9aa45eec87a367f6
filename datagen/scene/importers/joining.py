"""Overlapping closed parts of one glass object, joined into the solid that they fill together."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import Mesh, component_of_faces, face_corners, open_edges, signed_volume, volume_within, welded
from datagen.data.windings import check_solid, windings
from datagen.disk.errors import HyalineError
from datagen.scene.importers.remarks import Remarks
from datagen.scene.importers.repair import MAX_CHANGE
from datagen.scene.modelling import CREASE_DEG
from datagen.scene.shading_normals import shaded_anew

if TYPE_CHECKING:
    import manifold3d

POINTS = 1 << 15
"""In the box in which the space that parts fill is measured; spread evenly, they tell it to half a percent."""
ROOT = 1.22074408460575947536
"""Of x^4 = x + 1, from which the R3 sequence is made. Source: Roberts 2018."""
WELD = 1e-6
"""Of the object's size: what a boolean operation may move, so that no face is thinner than floats can tell."""


def joined(mesh: Mesh, remarks: Remarks, *, where: str) -> Mesh:
    """The closed mesh with overlapping parts as one; the same one where none overlap.

    Cavities stay, in the part that they are in. The volume of the result is compared with that of the space which the
    parts fill, measured by counting how often the surface goes around many points.

    Raises:
        HyalineError: the parts are no solids that can be joined, or the volume differs too much.
    """
    if open_edges(mesh) or not _overlaps(mesh, where=where):
        return mesh
    what = "its parts overlap, and cannot be joined"
    try:
        whole, count = _union(mesh)
    except ValueError as error:
        raise HyalineError(f"{where}: {what} ({error}); {_way_out(where)}") from None
    if count == 1 or open_edges(whole) or _overlaps(whole, where=where):
        raise HyalineError(f"{where}: {what}, since its surface crosses itself; {_way_out(where)}")
    before, after = filled_volume(mesh), signed_volume(whole)
    told = (
        f"{count} overlapping parts joined: the space that they fill was {1e6 * before:.4g} cm^3, "
        f"and is {1e6 * after:.4g} cm^3"
    )
    if abs(after - before) > MAX_CHANGE * before:
        share = 100 * abs(after - before) / before
        raise HyalineError(f"{where}: {told}, {share:.1f} % off; expected at most {100 * MAX_CHANGE:g} %")
    remarks.approximate(where, told)
    return shaded_anew(whole, crease_deg=CREASE_DEG)


def _way_out(where: str) -> str:
    return f"join them in a modeller, or draw it as thin glass with --material '{where}=thin-glass'"


def filled_volume(mesh: Mesh) -> float:
    """Cubic metres that are inside of at least one closed part, by points spread evenly over its box."""
    corners = face_corners(mesh).astype(np.float64)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    places = (0.5 + np.arange(POINTS)[:, None] / ROOT ** np.arange(1, 4)) % 1
    inside = windings(corners, low + places * (high - low)) > 0
    return float(inside.mean() * np.prod(high - low))


def _overlaps(mesh: Mesh, *, where: str) -> bool:
    try:
        check_solid(mesh, where=where)
    except HyalineError:
        return True
    return False


def _union(mesh: Mesh) -> tuple[Mesh, int]:
    """The union of a mesh's parts, each less its cavities, and the number of parts.

    Raises:
        ValueError: a part is no manifold.
    """
    import manifold3d

    positions, faces = welded(mesh)
    part = component_of_faces(mesh)
    size = float(np.ptp(positions, axis=0).max())
    solids: list[manifold3d.Manifold] = []
    outlines: list[Float[np.ndarray, "face 3 3"]] = []
    cavities = []
    for index in range(int(part.max()) + 1):
        own = faces[part == index]
        corners = positions[own].astype(np.float64)
        if volume_within(corners) < 0:
            cavities.append((corners, _manifold(positions, own[:, ::-1], size)))
        else:
            solids.append(_manifold(positions, own, size))
            outlines.append(corners)
    for corners, cavity in cavities:
        around = [index for index, outline in enumerate(outlines) if windings(outline, corners[:1, 0])[0] > 0]
        if not around:
            raise ValueError("a part is inside out")
        innermost = min(around, key=lambda index: solids[index].volume())
        solids[innermost] = solids[innermost] - cavity
    whole = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).simplify(WELD)
    out = whole.to_mesh()
    vertices = (np.asarray(out.vert_properties, np.float64)[:, :3] * size).astype(np.float32)
    if not len(vertices):
        raise ValueError("nothing is left")
    return (
        Mesh(
            vertices=vertices,
            faces=np.asarray(out.tri_verts).astype(np.int32),
            normals=np.zeros_like(vertices),
            uv=np.zeros((len(vertices), 2), np.float32),
        ),
        len(solids),
    )


def _manifold(positions: np.ndarray, faces: np.ndarray, size: float) -> "manifold3d.Manifold":
    """A closed part, in units of the object's size."""
    import manifold3d

    used, faces = np.unique(faces, return_inverse=True)
    solid = manifold3d.Manifold(
        manifold3d.Mesh(
            vert_properties=np.ascontiguousarray(positions[used] / size, np.float32),
            tri_verts=np.ascontiguousarray(faces.reshape(-1, 3), np.uint32),
        )
    )
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"a part is no manifold: {solid.status().name}")
    return solid
