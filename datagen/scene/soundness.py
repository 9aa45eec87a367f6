"""Checks that reject scenes that would silently render wrong: bad normals, overlapping solids, contact, wrong units.

They are fast (a second for a scene of 100,000 triangles), since they run whenever a scene is made or read.
"""

import re
from collections.abc import Iterable
from itertools import combinations, compress, permutations

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.cameras import Cameras, direction_of, seeing
from datagen.data.config import SPLITS
from datagen.data.meshes import (
    Mesh,
    SurfacePoints,
    boxes_meet,
    check_mesh,
    count_shared_faces,
    face_areas,
    face_corners,
    is_there,
    normals_of,
    points_on,
)
from datagen.data.queries import check_closed, check_solid, near_pairs, windings
from datagen.disk.errors import HyalineError
from datagen.disk.storage import check_name
from datagen.scene.description import MAX_OBJECTS, OBJECT_NAME, CameraList, CameraRig, Scene, SceneObject
from datagen.scene.materials import check_material
from datagen.scene.media import MAX_NESTED
from datagen.scene.shading_normals import MAX_OPPOSING, count_without_normal, opposing_share, unit

MAX_TOUCHING = 0.005
"""Share of the smaller of two surfaces that may lie in the other, if one of them is glass. A ball on a floor has 0.1 %,
a tumbler 4 %."""

TOLERANCE = 1e-4
"""Planes closer than this count as one, in metres: a gap of a tenth of a millimetre is never intended."""

MIN_PARALLEL = 0.9
"""Cosine of the angle between two faces up to which they count as parallel."""

SAMPLES = 1024
"""Points on a surface, spread by area, with which its contact is measured."""
SAMPLES_ON_FACES = 1 << 14
"""Further points, as many on each face and at least one, where it matters which faces touch."""

MIN_DISTANCE, MAX_DISTANCE = 0.02, 1000.0
"""Allowed distance in metres from the cameras to their target. Cameras see from a millimetre to ten kilometres."""

OVERLAP_POINTS = 256
"""Points on each solid's surface that are looked for in others, where there are too many solids to overlap."""

SMALLEST = 1 / 400
"""Smallest size of an object relative to its distance from the nearest camera: two pixels of 1,024."""
LARGEST = 50.0
"""Largest size relative to the cameras' distance: objects modelled in millimetres are a thousand times too large."""

NAMED = 3
"""Objects that an error names."""


def check_scene(scene: Scene, *, is_checked: bool = False) -> None:
    """Rejects a scene that would crash a native library or silently render wrong; cheap checks come first.

    Args:
        is_checked: the scene was checked when it was saved, so only single numbers are checked again.
    """
    check_name(scene.name, where="scene name")
    check_names(scene)
    there, solids = [item for item in scene.objects if is_there(item.mesh)], _solids(scene)
    if not there:
        raise HyalineError(f"scene {scene.name}: all of its objects were removed; expected at least one with a mesh")
    places = [_place(scene, item) for item in there]
    for item, place in zip(there, places, strict=True):
        check_material(item.material, where=place)
    for item, place in zip(there, places, strict=True):
        check_mesh(item.mesh, where=place)
    for item in solids:
        check_closed(item.mesh, where=_place(scene, item))
    _check_nesting(scene, solids)
    if is_checked:
        return
    cameras = camera_places(scene.cameras)
    if isinstance(scene.cameras, CameraList):
        check_glass_is_seen(scene, [scene.cameras.of(split) for split in SPLITS])
    _check_units(scene, there, cameras)
    _check_normals(scene, there)
    for item in solids:
        check_solid(item.mesh, where=_place(scene, item))
    check_cameras_outside(scene, cameras)
    _check_contact(scene, there)
    _check_overlaps(scene, solids)


def _solids(scene: Scene) -> list[SceneObject]:
    """The objects of glass or liquid, whose meshes are closed, less those that an edit removed."""
    there = [item for item in scene.objects if is_there(item.mesh)]
    return [item for item in there if item.material.medium is not None]


def _place(scene: Scene, item: SceneObject) -> str:
    return f"scene {scene.name}: object {item.name}"


def check_names(scene: Scene) -> None:
    """Rejects too many objects, and invalid or repeated names."""
    if not 1 <= len(scene.objects) <= MAX_OBJECTS:
        raise HyalineError(f"scene {scene.name}: has {len(scene.objects)} objects; expected 1 to {MAX_OBJECTS}")
    names = [item.name for item in scene.objects]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise HyalineError(f"scene {scene.name}: two objects are called {repeated[0]!r}; expected unique names")
    for name in names:
        if not re.fullmatch(OBJECT_NAME, name):
            raise HyalineError(f"scene {scene.name}: object name {name!r}; expected letters, digits, _ and -")


def check_glass_is_seen(scene: Scene, splits: Iterable[Cameras]) -> None:
    """Refuses a scene whose cameras see no glass: listed poses are then probably in another convention."""
    there = [item for item in scene.objects if is_there(item.mesh)]
    glass = [item for item in there if item.material.is_glass] or there
    if not any(any(seeing(cameras, item.mesh)) for cameras in splits for item in glass):
        raise HyalineError(
            f"scene {scene.name}: no camera sees {', '.join(item.name for item in glass[:NAMED])}; expected "
            "world_from_camera, looking along -z with +y up, in the meshes' axes and unit (OpenCV's poses have y and z "
            "flipped), or a rig with a target near it"
        )


def camera_places(rig: CameraRig | CameraList) -> Float[np.ndarray, "place 3"]:
    """Positions all over the rig's hemisphere and along its walk, or the positions of listed cameras."""
    if isinstance(rig, CameraList):
        return np.concatenate([rig.of(split).world_from_camera[:, :3, 3] for split in SPLITS])
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(*rig.elevation_deg, 9)), np.radians(np.linspace(*rig.azimuth_deg, 25))
    )
    directions = direction_of(elevation, azimuth)
    walk = np.array([point.position for point in rig.walk])
    shares = np.linspace(0, 1, 8, endpoint=False)[:, None, None]
    between = (walk[:-1] + shares * (walk[1:] - walk[:-1])).reshape(-1, 3)
    return np.concatenate([np.array(rig.target) + rig.radius * directions.reshape(-1, 3), between, walk[-1:]])


def _check_units(scene: Scene, there: list[SceneObject], cameras: Float[np.ndarray, "place 3"]) -> None:
    """Rejects scenes that were evidently not modelled in metres."""
    rig = scene.cameras
    if not MIN_DISTANCE <= rig.radius <= MAX_DISTANCE:
        raise HyalineError(
            f"scene {scene.name}: its cameras are {rig.radius:g} m from their target; expected "
            f"{MIN_DISTANCE:g} to {MAX_DISTANCE:g}: lengths are metres, scale meshes, textures and cameras"
        )
    for item in there:
        low, high = (bound(item.mesh.vertices, axis=0).astype(np.float64) for bound in (np.min, np.max))
        size = float((high - low).max())
        nearest = float(np.linalg.norm(np.maximum(np.maximum(low - cameras, cameras - high), 0), axis=-1).min())
        if size < SMALLEST * nearest:
            raise HyalineError(
                f"{_place(scene, item)}: is {size:.3g} m large and at least {nearest:.3g} m from every camera, too "
                "small to be seen; lengths are metres, scale it or remove it"
            )
        is_around = ((low <= rig.target) & (rig.target <= high)).all()
        if float((high - low).min()) > LARGEST * rig.radius and not is_around:
            raise HyalineError(
                f"{_place(scene, item)}: is {size:.3g} m large, and the cameras are {rig.radius:.3g} m from their "
                "target; lengths are metres, scale it (by 0.001 if it was modelled in millimetres)"
            )


def _check_normals(scene: Scene, there: list[SceneObject]) -> None:
    for item in there:
        if count := count_without_normal(item.mesh):
            raise HyalineError(
                f"{_place(scene, item)}: {count} vertex normals are 0; expected unit vectors, compute its normals again"
            )
        if (share := opposing_share(item.mesh)) > MAX_OPPOSING:
            raise HyalineError(
                f"{_place(scene, item)}: {100 * share:.1f} % of the vertex normals point to the back of their faces; "
                f"expected at most {100 * MAX_OPPOSING:g} %, compute its normals again"
            )


def check_cameras_outside(scene: Scene, places: Float[np.ndarray, "place 3"]) -> None:
    """Rejects cameras, by their positions, that are inside glass: rays start in air."""
    for item in _solids(scene):
        if (place := _inside(item.mesh, places)) is not None:
            raise HyalineError(
                f"{_place(scene, item)}: a camera is inside this glass, at "
                f"({', '.join(f'{value:.3g}' for value in place)}), but rays must start in air; move it or the "
                "cameras, or scale it if it was not modelled in metres"
            )


def _inside(mesh: Mesh, places: Float[np.ndarray, "place 3"]) -> Float[np.ndarray, "3"] | None:
    """The first of some places that is inside a closed mesh."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    close = places[((places > low) & (places < high)).all(axis=-1)]
    return next(iter(close[windings(face_corners(mesh), close) > 0]), None)


def _check_overlaps(scene: Scene, solids: list[SceneObject]) -> None:
    """Rejects more than MAX_NESTED dielectrics of which two overlap, by points on the surface of either."""
    if len(solids) <= MAX_NESTED:
        return
    points = [points_on(item.mesh, OVERLAP_POINTS).position for item in solids]
    for (one, on_one), (other, _) in permutations(zip(solids, points, strict=True), 2):
        if _inside(other.mesh, on_one) is not None:
            raise HyalineError(
                f"scene {scene.name}: objects {one.name} and {other.name} overlap, and there are {len(solids)} "
                f"dielectrics; where any overlap, expected at most {MAX_NESTED}"
            )


def _check_nesting(scene: Scene, solids: list[SceneObject]) -> None:
    """Rejects dielectrics whose order is undefined: too many for priorities, or with coincident faces."""
    priorities = {medium.priority for item in solids if (medium := item.material.medium)}
    if len(solids) > MAX_NESTED and len(priorities) > 1:
        raise HyalineError(
            f"scene {scene.name}: has {len(solids)} dielectrics of different priority; expected at most {MAX_NESTED}, "
            "or the same priority for all and no overlaps"
        )
    for one, other in combinations(solids, 2):
        if count := count_shared_faces(one.mesh, other.mesh):
            raise HyalineError(
                f"scene {scene.name}: objects {one.name} and {other.name} share {count} faces; "
                "extend one into the other and give it the lower priority, or leave a gap"
            )


# Coincident surfaces lose layers, and glass vanishes there


def _check_contact(scene: Scene, there: list[SceneObject]) -> None:
    """Rejects glass whose surface coincides with another: a ray hits only one of them."""
    order = [there[place] for place in np.argsort([face_areas(item.mesh).sum() for item in there], kind="stable")]
    sampled = [points_on(item.mesh, SAMPLES) for item in order]
    pairs = [pair for pair in combinations(range(len(order)), 2) if any(order[item].material.is_glass for item in pair)]
    near = [boxes_meet(order[small].mesh, order[large].mesh, TOLERANCE) for small, large in pairs]
    for one, other in compress(pairs, near):
        small, large, points = order[one], order[other], sampled[one]
        share = float(_touches(small.mesh, large.mesh, TOLERANCE, points).mean())
        if share > MAX_TOUCHING:
            raise HyalineError(
                f"{_place(scene, small)}: {100 * share:.1f} % of its surface lies in faces of "
                f"{large.name}, and one of them is glass; leave a gap of a millimetre, or extend one into the other"
            )


def touching_share(mesh: Mesh, other: Mesh, *, within: float = TOLERANCE, are_opposed: bool = False) -> float:
    """The share of a mesh's surface that lies in faces of another, by `_touches` at `SAMPLES` points."""
    return float(_touches(mesh, other, within, points_on(mesh, SAMPLES), are_opposed=are_opposed).mean())


def touching_faces(mesh: Mesh, other: Mesh) -> Bool[np.ndarray, " face"]:
    """Which faces of a mesh lie in faces of another, at least in part."""
    every = np.arange(len(mesh.faces))
    sampled = points_on(mesh, SAMPLES, part=every, count_a_part=max(1, SAMPLES_ON_FACES // len(every)))
    return np.isin(every, sampled.face[_touches(mesh, other, TOLERANCE, sampled)])


def _touches(
    mesh: Mesh, other: Mesh, within: float, sampled: SurfacePoints, *, are_opposed: bool = False
) -> Bool[np.ndarray, " sample"]:
    """Which points of a mesh lie at most `within` metres from a parallel face of another, with opposite normals if
    `are_opposed`: the meshes touch from outside."""
    from trimesh.triangles import closest_point

    touches = np.zeros(len(sampled.position), bool)
    if not boxes_meet(mesh, other, within):
        return touches
    corners = face_corners(other).astype(np.float64)
    low, high = sampled.position.min(axis=0) - within, sampled.position.max(axis=0) + within
    corners = corners[((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=-1)]
    mine, normals = unit(normals_of(face_corners(mesh)[sampled.face])), unit(normals_of(corners))
    for face, point in near_pairs(corners, sampled.position, within):
        cosine = np.einsum("pc,pc->p", mine[point], normals[face])
        is_parallel = (-cosine if are_opposed else np.abs(cosine)) > MIN_PARALLEL
        face, point = face[is_parallel], point[is_parallel]
        away = closest_point(corners[face], sampled.position[point]) - sampled.position[point]
        touches[point[np.linalg.norm(away, axis=-1) <= within]] = True
    return touches
