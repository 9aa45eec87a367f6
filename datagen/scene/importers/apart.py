"""Glass that touches or overlaps: coincident surfaces are parted, overlapping parts become objects of their own, and
where two solids overlap, the smaller one fills the space that they share."""

import dataclasses
from itertools import combinations

import numpy as np

from datagen.data.meshes import (
    Mesh,
    component_of_faces,
    face_areas,
    face_corners,
    signed_volume,
    vertex_normals,
    welded,
)
from datagen.data.surface_points import points_on
from datagen.data.windings import SAMPLES, check_solid, windings
from datagen.disk.errors import HyalineError
from datagen.scene.contact import TOLERANCE, touching_share
from datagen.scene.description import SceneObject
from datagen.scene.importers.remarks import Remarks
from datagen.scene.materials import Dielectric
from datagen.scene.materials.optics import MAX_PRIORITY
from datagen.scene.media import MAX_NESTED
from datagen.scene.soundness import MAX_TOUCHING

STEP = 2 * TOLERANCE
"""Metres by which a surface is moved in where it coincides with another."""
MAX_PARTS = 16
"""Overlapping parts of which objects are made."""


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
    """The objects, of which the smaller one is moved in by `STEP` where the surface of glass is also another's."""
    areas = {item.name: float(face_areas(item.mesh).sum()) for item in objects}
    found = {item.name: item for item in objects}
    for names in combinations(found, 2):
        small, large = sorted(names, key=lambda name: areas[name])
        if not any(found[name].material.is_glass for name in names):
            continue
        if touching_share(found[small].mesh, found[large].mesh) > MAX_TOUCHING:
            remarks.approximate(
                small,
                f"shares some of its surface with {large}; moved in by {1000 * STEP:.1f} mm, since one of two "
                "coincident faces would vanish",
            )
            found[small] = dataclasses.replace(found[small], mesh=_moved_in(found[small].mesh, STEP))
    return list(found.values())


def nested(objects: list[SceneObject], remarks: Remarks) -> list[SceneObject]:
    """The objects with priorities by which the smaller one of two solids that overlap fills the space that they share.

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
        (windings(face_corners(around), points_on(mesh, SAMPLES).position) > 0).mean() > MAX_TOUCHING
        for mesh, around in ((one, other), (other, one))
    )


def _moved_in(mesh: Mesh, distance: float) -> Mesh:
    """The mesh with each point moved against the mean normal of its faces; seams stay closed."""
    positions, faces = welded(mesh)
    _, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    inner = positions - distance * vertex_normals(positions, faces)
    return dataclasses.replace(mesh, vertices=inner.astype(np.float32)[index.reshape(-1)])


def _without_others(mesh: Mesh, is_kept: np.ndarray) -> Mesh:
    used, faces = np.unique(mesh.faces[is_kept], return_inverse=True)
    return Mesh(
        vertices=mesh.vertices[used],
        faces=faces.reshape(-1, 3).astype(np.int32),
        normals=mesh.normals[used],
        uv=mesh.uv[used],
    )
