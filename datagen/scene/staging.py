"""Light and cameras for objects that bring none: softboxes all around, and a rig that frames the glass."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from datagen.scene.description import CameraRig, Card, SceneObject, SoftEnvironment, WalkPoint
from datagen.scene.materials import Vector, as_vector

FOV_DEG = 40.0
MARGIN = 1.1
"""How much wider a picture is than its content."""
WALK = ((-0.9, 40.0, 1.0), (-0.45, 20.0, 0.72), (0.0, 4.0, 0.85), (0.4, 12.0, 1.4), (0.7, 45.0, 1.9), (0.95, 25.0, 1.2))
"""Turn in half arcs, elevation in degrees and distance in radii of the points of an extrapolating walk."""
FRONT_DEG = -90.0
"""Azimuth from which files are meant to be seen: glTF's +z, ours -y."""
ALL_AROUND = (FRONT_DEG - 180.0, FRONT_DEG + 180.0)
"""First and last azimuth of a full circle."""


def subject_box(objects: Sequence[SceneObject]) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of the glass; of everything if there is no glass."""
    glass = [item for item in objects if item.material.is_glass] or list(objects)
    corners = np.concatenate([item.mesh.vertices for item in glass]).astype(np.float64)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def rig_around(
    objects: Sequence[SceneObject],
    *,
    target: Vector | None = None,
    radius: float | None = None,
    azimuth_deg: tuple[float, float] = ALL_AROUND,
    fov_deg: float = FOV_DEG,
) -> CameraRig:
    """Cameras around `target`, by default the middle of the glass, as near as shows all of it."""
    low, high = subject_box(objects)
    centre, reach = (low + high) / 2 if target is None else np.array(target), float(np.linalg.norm(high - low)) / 2
    distance = MARGIN * reach / math.sin(math.radians(fov_deg / 2)) if radius is None else radius
    first, last = azimuth_deg
    middle, half = (first + last) / 2, min((last - first) / 2, 100.0)
    places = [centre + radii * distance * np.array(towards(middle + turn * half, up)) for turn, up, radii in WALK]
    return CameraRig(
        target=as_vector(centre),
        radius=distance,
        elevation_deg=(5.0, 65.0),
        azimuth_deg=azimuth_deg,
        fov_deg=fov_deg,
        target_jitter=0.08,
        walk=tuple(WalkPoint(position=as_vector(place), target=as_vector(centre)) for place in places),
    )


def towards(azimuth_deg: float, elevation_deg: float) -> Vector:
    """The unit direction at an azimuth and an elevation."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    across = math.cos(elevation)
    return across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation)


LIGHT = SoftEnvironment(
    zenith=(0.34, 0.38, 0.45),
    horizon=(0.50, 0.47, 0.44),
    ground=(0.20, 0.18, 0.17),
    cards=(
        # Low flags between the softboxes draw the dark outline of glass from every direction.
        Card(direction=towards(-55, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        Card(direction=towards(65, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        Card(direction=towards(185, 12), size_deg=(26.0, 64.0), radiance=(0.06, 0.06, 0.07), softness_deg=10.0),
        # The key, warm; a cool one across, and one behind that looks like a window.
        Card(direction=towards(-20, 42), size_deg=(23.0, 64.0), radiance=(6.0, 5.3, 4.4), softness_deg=3.0),
        Card(direction=towards(-140, 26), size_deg=(26.0, 52.0), radiance=(1.7, 2.1, 2.7), softness_deg=3.0),
        Card(direction=towards(110, 30), size_deg=(40.0, 40.0), radiance=(2.5, 2.5, 2.5), softness_deg=3.0),
        Card(direction=towards(0, 90), size_deg=(50.0, 30.0), radiance=(2.2, 2.2, 2.2), softness_deg=6.0),
    ),
)
"""Softboxes and flags all around, as photographers show glass: bright cards draw highlights on it and caustics below
it, dark ones its outline. All are wide enough to be found by chance, so that pictures need few samples."""
