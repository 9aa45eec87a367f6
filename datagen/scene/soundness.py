"""Checks that reject scenes that would silently render wrong: bad normals, overlapping solids, contact, wrong units.

They are fast (a second for a scene of 100,000 triangles), since they run whenever a scene is made or read.
"""

import re
from itertools import combinations, permutations

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import direction_of, seeing
from datagen.data.config import SPLITS
from datagen.data.meshes import (
    check_closed,
    check_mesh,
    check_solid,
    count_shared_faces,
    face_areas,
    face_corners,
    is_there,
    points_on,
    windings,
)
from datagen.disk.errors import HyalineError
from datagen.disk.storage import check_name
from datagen.scene.contact import touching_share
from datagen.scene.description import MAX_OBJECTS, OBJECT_NAME, CameraList, CameraRig, Scene, SceneObject
from datagen.scene.media import MAX_NESTED
from datagen.scene.shading_normals import MAX_OPPOSING, count_without_normal, opposing_share

MAX_TOUCHING = 0.005
"""Share of the smaller of two surfaces that may lie in the other, if one of them is glass. A ball on a floor has 0.1 %,
a tumbler 4 %."""

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
    """Rejects a scene that would crash a native library or silently render wrong.

    Args:
        is_checked: the scene was checked when it was saved, so only single numbers are checked again.
    """
    check_name(scene.name, where="scene name")
    check_names(scene)
    if not any(is_there(item.mesh) for item in scene.objects):
        raise HyalineError(f"scene {scene.name}: all of its objects were removed; expected at least one with a mesh")
    for item in scene.objects:
        where = f"scene {scene.name}: object {item.name}"
        if not is_there(item.mesh):
            continue
        check_mesh(item.mesh, where=where)
        if item.material.medium is not None:
            check_closed(item.mesh, where=where)
    _check_nesting(scene)
    if not is_checked:
        check_sound(scene)


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


def check_sound(scene: Scene) -> None:
    """The checks of `check_scene` beyond single numbers, cheapest first."""
    there = [item for item in scene.objects if is_there(item.mesh)]
    cameras = camera_places(scene.cameras)
    _check_seen(scene, there)
    _check_units(scene, there, cameras)
    for item in there:
        _check_normals(item, where=_where(scene, item))
    for item in there:
        if item.material.medium is not None:
            check_solid(item.mesh, where=_where(scene, item))
    check_cameras_outside(scene, cameras)
    _check_contact(scene, there)
    _check_overlaps(scene, there)


def _check_seen(scene: Scene, there: list[SceneObject]) -> None:
    """Refuses listed cameras none of which sees any glass: their poses are probably in another convention."""
    if not isinstance(scene.cameras, CameraList):
        return
    glass = [item for item in there if item.material.is_glass] or there
    listed = [scene.cameras.of(split) for split in SPLITS]
    if any(any(seeing(cameras, item.mesh)) for cameras in listed for item in glass):
        return
    raise HyalineError(
        f"scene {scene.name}: no camera sees {', '.join(item.name for item in glass[:NAMED])}; expected "
        "world_from_camera, looking along -z with +y up, in the meshes' axes and unit "
        "(OpenCV's poses have y and z flipped)"
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


def _where(scene: Scene, item: SceneObject) -> str:
    return f"scene {scene.name}: object {item.name}"


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
                f"{_where(scene, item)}: is {size:.3g} m large and at least {nearest:.3g} m from every camera, too "
                "small to be seen; lengths are metres, scale it or remove it"
            )
        is_around = ((low <= rig.target) & (rig.target <= high)).all()
        if float((high - low).min()) > LARGEST * rig.radius and not is_around:
            raise HyalineError(
                f"{_where(scene, item)}: is {size:.3g} m large, and the cameras are {rig.radius:.3g} m from their "
                "target; lengths are metres, scale it (by 0.001 if it was modelled in millimetres)"
            )


def _check_normals(item: SceneObject, *, where: str) -> None:
    if count := count_without_normal(item.mesh):
        raise HyalineError(f"{where}: {count} vertex normals are 0; expected unit vectors, compute its normals again")
    if (share := opposing_share(item.mesh)) > MAX_OPPOSING:
        raise HyalineError(
            f"{where}: {100 * share:.1f} % of the vertex normals point to the back of their faces; expected at most "
            f"{100 * MAX_OPPOSING:g} %, compute its normals again"
        )


def check_cameras_outside(scene: Scene, places: Float[np.ndarray, "place 3"]) -> None:
    """Rejects cameras, by their positions, that are inside glass: rays start in air."""
    for item in scene.objects:
        if not is_there(item.mesh) or item.material.medium is None:
            continue
        low, high = item.mesh.vertices.min(axis=0), item.mesh.vertices.max(axis=0)
        close = places[((places >= low) & (places <= high)).all(axis=-1)]
        if len(close) and (inside := windings(face_corners(item.mesh), close) > 0).any():
            place = ", ".join(f"{value:.3g}" for value in close[inside][0])
            raise HyalineError(
                f"{_where(scene, item)}: a camera is inside this glass, at ({place}), but rays must start in air; "
                "move it or the cameras, or scale it if it was not modelled in metres"
            )


def _check_contact(scene: Scene, there: list[SceneObject]) -> None:
    """Rejects glass whose surface coincides with another: a ray hits only one of them."""
    for small, large in combinations(sorted(there, key=surface_area), 2):
        if not (small.material.is_glass or large.material.is_glass):
            continue
        if (share := touching_share(small.mesh, large.mesh)) > MAX_TOUCHING:
            raise HyalineError(
                f"{_where(scene, small)}: {100 * share:.1f} % of its surface lies in faces of {large.name}, and one of "
                "them is glass; leave a gap of a millimetre, or extend one into the other"
            )


def surface_area(item: SceneObject) -> float:
    """Square metres."""
    return float(face_areas(item.mesh).sum())


def _check_overlaps(scene: Scene, there: list[SceneObject]) -> None:
    """Rejects more than MAX_NESTED dielectrics of which two overlap, by points on the surface of either."""
    glass = [item for item in there if item.material.medium is not None]
    if len(glass) <= MAX_NESTED:
        return
    points = {item.name: points_on(item.mesh, OVERLAP_POINTS).position for item in glass}
    for one, other in permutations(glass, 2):
        low, high = other.mesh.vertices.min(axis=0), other.mesh.vertices.max(axis=0)
        close = points[one.name]
        close = close[((close > low) & (close < high)).all(axis=-1)]
        if len(close) and (windings(face_corners(other.mesh), close) > 0).any():
            raise HyalineError(
                f"scene {scene.name}: objects {one.name} and {other.name} overlap, and there are {len(glass)} "
                f"dielectrics; where any overlap, expected at most {MAX_NESTED}"
            )


def _check_nesting(scene: Scene) -> None:
    """Rejects dielectrics whose order is undefined: too many for priorities, or with coincident faces."""
    there = [item for item in scene.objects if is_there(item.mesh)]
    glass = [(item, medium) for item in there if (medium := item.material.medium) is not None]
    if len(glass) > MAX_NESTED and len({medium.priority for _, medium in glass}) > 1:
        raise HyalineError(
            f"scene {scene.name}: has {len(glass)} dielectrics of different priority; expected at most {MAX_NESTED}, "
            "or the same priority for all and no overlaps"
        )
    for (one, _), (other, _) in combinations(glass, 2):
        if count := count_shared_faces(one.mesh, other.mesh):
            raise HyalineError(
                f"scene {scene.name}: objects {one.name} and {other.name} share {count} faces; "
                "extend one into the other and give it the lower priority, or leave a gap"
            )
