"""Glass that touches or overlaps: coincident surfaces are parted, overlapping parts become objects of their own or are
joined into one, and where two solids overlap, the smaller one fills the space that they share.
"""

import dataclasses
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import (
    NUM_POINTS,
    Mesh,
    check_solid,
    component_of_faces,
    face_areas,
    face_corners,
    open_edges,
    points_on,
    signed_volume,
    volume_within,
    welded,
    windings,
)
from datagen.disk.errors import HyalineError
from datagen.scene.contact import TOLERANCE, touching_faces, touching_share
from datagen.scene.description import SceneObject
from datagen.scene.materials import Dielectric
from datagen.scene.materials.optics import MAX_PRIORITY
from datagen.scene.media import MAX_NESTED
from datagen.scene.modelling import CREASE_DEG
from datagen.scene.remarks import Remarks
from datagen.scene.shading_normals import with_new_normals
from datagen.scene.soundness import MAX_TOUCHING
from datagen.scene.surfaces import MAX_CHANGE

if TYPE_CHECKING:
    import manifold3d

STEP = 2 * TOLERANCE
"""Metres by which a surface is moved where it coincides with another; twice as many each time until it is free."""
REACH = 16 * STEP
"""The most that it is moved: the surfaces of a drink and its glass cross where their facets differ."""
FILLS = 0.25
"""Share of a solid's surface that touches another from outside if it fills it, as a drink does its glass."""
FLAT = 0.01
"""Squared sine, about, of the angle up to which faces count as one plane."""
MAX_MITRE = 4.0
"""How far a point of a sharp edge moves at most, relative to its faces."""
MAX_PARTS = 16
"""The most overlapping parts of an object."""
POINTS = 1 << 15
"""Points in the box where the volume of the parts is measured; spread evenly, they give it to half a percent."""
ROOT = 1.22074408460575947536
"""The root of x^4 = x + 1, which generates the R3 sequence. Source: Roberts 2018."""
WELD = 1e-6
"""How far a boolean operation may move points, relative to the object's size, to avoid needle-thin faces."""


def parted(item: SceneObject, remarks: Remarks) -> list[SceneObject]:
    """The object; where it is glass whose closed parts overlap, an object for each part.

    Light ignores surfaces inside of a solid, so that overlapping objects of one glass render as their union.
    """
    if item.material.medium is None:
        return [item]
    try:
        check_solid(item.mesh, where=item.name)
    except HyalineError:
        part = component_of_faces(item.mesh)
        if 1 < (count := int(part.max()) + 1) <= MAX_PARTS:
            remarks.note(item.name, f"its {count} closed parts overlap; each became an object of its own")
            meshes = [_without_others(item.mesh, part == index) for index in range(count)]
            return [
                dataclasses.replace(item, name=f"{item.name}_part{index}", mesh=mesh)
                for index, mesh in enumerate(meshes)
            ]
    return [item]


def apart(objects: list[SceneObject], remarks: Remarks) -> list[SceneObject]:
    """The objects; where the surface of glass coincides with another, those faces of the smaller one are moved.

    Drinks, which fill other glass, grow into the glass that they touch: a film of air around them would mirror.
    Everything else draws back, and so do drinks among more than `MAX_NESTED` solids, which may not overlap.
    """
    found = {item.name: item for item in objects}
    areas = {item.name: float(face_areas(item.mesh).sum()) for item in objects}
    pairs = [
        (small.name, large.name)
        for small, large in combinations(sorted(objects, key=lambda item: areas[item.name]), 2)
        if (small.material.is_glass or large.material.is_glass)
        and touching_share(small.mesh, large.mesh) > MAX_TOUCHING
    ]
    solids = {item.name for item in objects if item.material.medium is not None}
    drinks = {
        small
        for small, large in pairs
        if {small, large} <= solids
        and touching_share(found[small].mesh, found[large].mesh, within=REACH, are_opposed=True) > FILLS
    }
    for small, large in pairs:
        grows = len(solids) <= MAX_NESTED and {small, large} <= solids and not drinks.isdisjoint((small, large))
        mesh = _parted_from(found[small], found[large], remarks, grows=grows)
        found[small] = dataclasses.replace(found[small], mesh=mesh)
    return list(found.values())


def _parted_from(small: SceneObject, large: SceneObject, remarks: Remarks, *, grows: bool) -> Mesh:
    """The mesh of the smaller object, whose faces that touch the other one are moved until they no longer do."""
    mesh, distance, moves = small.mesh, 0.0, np.zeros(len(small.mesh.faces), bool)
    # A label on a bottle is a sheet that looks as the glass does; it moves off the glass, as its own front shows.
    is_label = open_edges(mesh) > 0 and touching_share(mesh, large.mesh, are_opposed=True) <= MAX_TOUCHING
    way = 1 if grows or is_label else -1
    while touching_share(mesh, large.mesh) > MAX_TOUCHING and distance < REACH:
        distance = max(STEP, 2 * distance)
        moves |= touching_faces(mesh, large.mesh)
        mesh = _moved(small.mesh, way * distance * moves)
    if distance:
        remarks.approximate(
            small.name,
            f"shares some of its surface with {large.name}, which was moved {1000 * distance:.1f} mm "
            f"{'into' if grows else 'away from'} it, since one of two coincident faces would vanish",
        )
    return mesh


def nested(objects: list[SceneObject], remarks: Remarks) -> list[SceneObject]:
    """The objects with priorities: the smaller of two overlapping solids fills the space that they share.

    It is the one that lies in the other with more of its volume: ice in whiskey, a bubble in glass. Where a file gives
    priorities, these stay.
    """
    solids = [(item, item.material) for item in objects if isinstance(item.material, Dielectric)]
    solids.sort(key=lambda solid: -signed_volume(solid[0].mesh))
    priorities = {item.name: glass.priority for item, glass in solids}
    pairs = []
    for index, (small, glass) in enumerate(solids):
        for large, around in solids[:index]:
            if glass == around or not _overlap(small.mesh, large.mesh):
                continue
            pairs.append((small.name, large.name))
            if not glass.priority and not around.priority:
                priorities[small.name] = min(max(priorities[small.name], priorities[large.name] + 1), MAX_PRIORITY)
    if len(solids) > MAX_NESTED:
        for small, large in pairs:
            remarks.approximate(
                small, f"overlaps {large}; of more than {MAX_NESTED} solids, these two are drawn as if they were apart"
            )
        return objects
    places = {item.name: index for index, item in enumerate(objects)}
    for pair in pairs:
        loser, winner = sorted(pair, key=lambda name: (priorities[name], -places[name]))
        remarks.note(loser, f"overlaps {winner}, which wins: it fills the space that they share")
    return [
        dataclasses.replace(item, material=dataclasses.replace(item.material, priority=priorities[item.name]))
        if isinstance(item.material, Dielectric)
        else item
        for item in objects
    ]


def _overlap(one: Mesh, other: Mesh) -> bool:
    """True where some of the surface of one solid lies in the other."""
    (low, high), (other_low, other_high) = ((m.vertices.min(axis=0), m.vertices.max(axis=0)) for m in (one, other))
    if (low > other_high).any() or (other_low > high).any():
        return False
    return any(
        (windings(face_corners(around), points_on(mesh, NUM_POINTS).position) > 0).mean() > MAX_TOUCHING
        for mesh, around in ((one, other), (other, one))
    )


def _moved(mesh: Mesh, distance: Float[np.ndarray, " face"]) -> Mesh:
    """The mesh with each of its faces moved outwards by its distance; seams stay closed.

    A point moves to where the moved planes of its faces meet, or to the nearest place if these are too many.
    """
    positions, faces = welded(mesh)
    _, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    a, b, c = np.moveaxis(positions[faces].astype(np.float64), 1, 0)
    across = np.cross(b - a, c - a)
    has_area = (size := np.linalg.norm(across, axis=-1)) > 0
    normals, distance, faces = across[has_area] / size[has_area, None], distance[has_area], faces[has_area]
    products, sums = np.zeros((len(positions), 3, 3)), np.zeros((len(positions), 3))
    for corner in faces.T:
        np.add.at(products, corner, normals[:, :, None] * normals[:, None])
        np.add.at(sums, corner, normals * distance[:, None])
    way = np.einsum("pij,pj->pi", np.linalg.pinv(products, rcond=FLAT, hermitian=True), sums)
    longest = MAX_MITRE * np.abs(distance).max(initial=0.0)
    way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True) / longest, 1)
    return dataclasses.replace(mesh, vertices=(positions + way).astype(np.float32)[index.reshape(-1)])


def _without_others(mesh: Mesh, is_kept: np.ndarray) -> Mesh:
    used, faces = np.unique(mesh.faces[is_kept], return_inverse=True)
    return Mesh(
        vertices=mesh.vertices[used],
        faces=faces.reshape(-1, 3).astype(np.int32),
        normals=mesh.normals[used],
        uv=mesh.uv[used],
    )


# Joining the parts of one object


def joined(mesh: Mesh, remarks: Remarks, *, where: str) -> Mesh:
    """The closed mesh with overlapping parts as one; the same one where none overlap.

    Cavities stay, in the part that they are in. The volume of the result is compared with that of the space which the
    parts fill, measured by counting how often the surface goes around many points.
    """
    if open_edges(mesh) or not _is_overlapping(mesh, where=where):
        return mesh
    what = "its parts overlap, and cannot be joined"
    try:
        whole, count = _union(mesh)
    except ValueError as error:
        raise HyalineError(f"{where}: {what} ({error}); {_way_out(where)}") from None
    if count == 1 or open_edges(whole) or _is_overlapping(whole, where=where):
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
    return with_new_normals(whole, crease_deg=CREASE_DEG)


def _way_out(where: str) -> str:
    return f"join them in a modeller, or draw it as thin glass with --material '{where}=thin-glass'"


def filled_volume(mesh: Mesh) -> float:
    """Cubic metres that are inside of at least one closed part, by points spread evenly over its box."""
    corners = face_corners(mesh).astype(np.float64)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    places = (0.5 + np.arange(POINTS)[:, None] / ROOT ** np.arange(1, 4)) % 1
    inside = windings(corners, low + places * (high - low)) > 0
    return float(inside.mean() * np.prod(high - low))


def _is_overlapping(mesh: Mesh, *, where: str) -> bool:
    try:
        check_solid(mesh, where=where)
    except HyalineError:
        return True
    return False


def _union(mesh: Mesh) -> tuple[Mesh, int]:
    """The union of a mesh's parts, each less its cavities, and the number of parts.

    Raises:
        ValueError: a part is not a manifold.
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
        raise ValueError(f"a part is not a manifold: {solid.status().name}")
    return solid
