"""Refuses cameras that no light can reach, before a dataset of black pictures is rendered."""

import numpy as np
from jaxtyping import Bool, Float

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.scene.description import Scene

DIRECTIONS = 1024
"""Rays from each camera; all of them end on something opaque in a room without an opening."""


def check_light(scene: Scene, cameras: dict[Split, Cameras]) -> None:
    """Raises for a split whose cameras are all shut in by opaque surfaces, without a lamp: its pictures would be black.

    Glass lets light through, wherever it bends it to.
    """
    opaque = tuple(item.mesh for item in scene.objects if not item.material.is_glass)
    if scene.lights or not opaque:
        return
    corners = np.concatenate([mesh.vertices for mesh in opaque])
    low, high = corners.min(axis=0), corners.max(axis=0)
    for split, poses in cameras.items():
        places = poses.world_from_camera[:, :3, 3]
        is_within = ((places > low) & (places < high)).all()  # Tracing rays takes a second; this nothing.
        if len(places) and is_within and _are_shut_in(places, opaque).all():
            raise HyalineError(
                f"scene {scene.name}: no light reaches the {split} cameras, which are inside closed opaque walls with "
                "only the sky for a light; add a lamp (`lights` in scene.json, or a mesh that glows in the file), or "
                "open the room"
            )


def _are_shut_in(places: Float[np.ndarray, "view 3"], opaque: tuple[Mesh, ...]) -> Bool[np.ndarray, " view"]:
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba()
    import mitsuba as mi

    from datagen.render.mitsuba_scene import load_geometry_mitsuba

    around, ways = load_geometry_mitsuba(opaque), np.random.default_rng(0).normal(size=(3, DIRECTIONS))
    ways = mi.Vector3f(*(ways / np.linalg.norm(ways, axis=0)))
    rays = (mi.Ray3f(mi.Point3f(*place.tolist()), ways) for place in places)
    return np.array([np.array(around.ray_test(ray)).all() for ray in rays])
