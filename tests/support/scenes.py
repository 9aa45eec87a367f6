"""Scenes of a few objects, and their rendering."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from support.synthetic import synthetic_scene

from datagen.data.cameras import Cameras, look_at
from datagen.render.truth import Renderer, render_view
from datagen.scene.description import Lobe, Scene, SceneObject, SoftEnvironment

WHITE = SoftEnvironment(zenith=(1, 1, 1), horizon=(1, 1, 1), ground=(1, 1, 1))
DUSK = SoftEnvironment(
    zenith=(0.1, 0.2, 0.5),
    horizon=(0.9, 0.7, 0.5),
    ground=(0.2, 0.1, 0.1),
    lobes=(Lobe(direction=(1, 1, 1), radiance=(0.5, 0.4, 0.3), sharpness=4),),
)


def scene_of(*objects: SceneObject, environment: SoftEnvironment = WHITE) -> Scene:
    return dataclasses.replace(synthetic_scene(), objects=objects, environment=environment)


def camera_at(position: Sequence[float], *, fov_x: float, size: int = 8) -> Cameras:
    """One view of the origin."""
    pose = look_at(np.array(position, np.float64), np.zeros(3))
    return Cameras(world_from_camera=pose[None], fov_x=fov_x, width=size, height=size)


def seen_along(direction: Sequence[float], *objects: SceneObject, environment: SoftEnvironment, spp: int) -> np.ndarray:
    """Mean radiance of truth along one ray to the origin, from 3 m away."""
    view = camera_at(-3 * np.array(direction) / np.linalg.norm(direction), fov_x=1e-3, size=2)
    return rendered(scene_of(*objects, environment=environment), view, spp=spp).mean(axis=(0, 1))


def rendered(scene: Scene, cameras: Cameras, spp: int = 512, seed: int = 0) -> np.ndarray:
    return render_view(
        Renderer(scene, max_depth=24), cameras, 0, spp=spp, view_seed=seed, ceiling_db=None
    ).radiance.astype(np.float64)
