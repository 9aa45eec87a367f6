"""Glass that touches or overlaps: coincident surfaces are parted, overlapping parts become objects of their own, and
where two solids overlap, the smaller one fills the space that they share.
"""

import dataclasses
from itertools import combinations

import numpy as np
from jaxtyping import Float

from datagen.data.meshes import (
    Mesh,
    boxes_meet,
    component_of_faces,
    face_areas,
    face_corners,
    normals_of,
    open_edges,
    points_on,
    signed_volume,
    volume_within,
    welded,
)
from datagen.data.queries import NUM_POINTS, check_solid, windings
from datagen.disk.errors import HyalineError
from datagen.scene.description import SceneObject
from datagen.scene.materials import MAX_PRIORITY, Dielectric
from datagen.scene.media import MAX_NESTED
from datagen.scene.soundness import MAX_TOUCHING, TOLERANCE, touching_faces, touching_share
from hyaline_import.remarks import Remarks
from hyaline_import.surfaces import part_of

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


def parted(item: SceneObject, remarks: Remarks) -> list[SceneObject]:
    """The object; where it is glass whose closed parts overlap, an object for each part.

    Light ignores surfaces inside of a solid, so that overlapping objects of one glass render as their union. If a
    part's surface crosses itself, the check of the scene refuses the object.
    """
    if item.material.medium is None or _is_solid(item.mesh):
        return [item]
    bodies = _bodies(item.mesh)
    if not 1 < len(bodies) <= MAX_NESTED or not all(map(_is_solid, bodies)):
        return [item]
    remarks.note(item.name, f"its {len(bodies)} closed parts overlap; each became an object of its own")
    return [dataclasses.replace(item, name=f"{item.name}_part{index}", mesh=body) for index, body in enumerate(bodies)]


def _is_solid(mesh: Mesh) -> bool:
    try:
        check_solid(mesh, where="")
    except HyalineError:
        return False
    return True


def _bodies(mesh: Mesh) -> list[Mesh]:
    """The closed parts of a mesh, each with its cavities."""
    corners, part = face_corners(mesh).astype(np.float64), component_of_faces(mesh)
    parts = [corners[faces] for faces in np.split(np.argsort(part, kind="stable"), np.cumsum(np.bincount(part))[:-1])]
    volumes = [volume_within(each) for each in parts]
    body = np.arange(len(parts))
    for index in (index for index, volume in enumerate(volumes) if volume < 0):
        around = [
            other
            for other, volume in enumerate(volumes)
            if volume > 0 and windings(parts[other], parts[index][:1, 0])[0] > 0
        ]
        body[index] = min(around, key=lambda other: volumes[other], default=index)
    return [part_of(mesh, body[part] == index) for index in np.unique(body)]


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

    It is the one that lies in the other with more of its volume: ice in whiskey, a bubble in glass.
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
            priorities[small.name] = min(max(priorities[small.name], priorities[large.name] + 1), MAX_PRIORITY)
    if len(solids) > MAX_NESTED:
        for small, large in pairs:
            remarks.approximate(
                small, f"overlaps {large}; of more than {MAX_NESTED} solids, these two are drawn as if they were apart"
            )
        return objects
    for small, large in pairs:
        remarks.note(large, f"overlaps {small}, which wins: it fills the space that they share")
    return [
        dataclasses.replace(item, material=dataclasses.replace(item.material, priority=priorities[item.name]))
        if isinstance(item.material, Dielectric)
        else item
        for item in objects
    ]


def _overlap(one: Mesh, other: Mesh) -> bool:
    """True where some of the surface of one solid lies in the other."""
    return boxes_meet(one, other) and any(
        (windings(face_corners(around), points_on(mesh, NUM_POINTS).position) > 0).mean() > MAX_TOUCHING
        for mesh, around in ((one, other), (other, one))
    )


def _moved(mesh: Mesh, distance: Float[np.ndarray, " face"]) -> Mesh:
    """The mesh with each of its faces moved outwards by its distance; seams stay closed.

    A point moves to where the moved planes of its faces meet, or to the nearest place if these are too many.
    """
    positions, faces = welded(mesh)
    _, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    across = normals_of(positions[faces])
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
