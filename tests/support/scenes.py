"""Scenes of a few objects, and their rendering."""

import dataclasses

import numpy as np
from support.synthetic import synthetic_scene

from datagen.data.cameras import Cameras
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


def rendered(scene: Scene, cameras: Cameras, spp: int = 512, seed: int = 0) -> np.ndarray:
    return render_view(
        Renderer(scene, max_depth=24), cameras, 0, spp=spp, view_seed=seed, ceiling_db=None
    ).radiance.astype(np.float64)
