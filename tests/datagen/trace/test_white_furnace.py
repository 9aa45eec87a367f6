"""Tests that white light from everywhere stays white: no material adds any, and none loses it."""

import dataclasses
import io

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.meshes import mesh_of
from support.scenes import camera_at, scene_of

from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.truth import Renderer, render_view
from datagen.scene.description import SceneObject
from datagen.scene.materials import (
    Conductor,
    Dielectric,
    ImageTexture,
    Material,
    Plastic,
    RoughDielectric,
    ThinDielectric,
)
from datagen.trace.light_path import LightPathTracer
from datagen.trace.surface_tables import Limits

BALL = mesh_of(trimesh.creation.icosphere(3, 0.5))
WHITE_PNG = io.BytesIO()
Image.new("RGB", (4, 4), (255, 255, 255)).save(WHITE_PNG, format="PNG")
CAMERAS = camera_at((0.3, -3.0, 0.4), fov_x=0.4, size=12)
MATERIALS: dict[str, tuple[Material, float]] = {
    "an index of 1": (Dielectric(ior=1.0), 0.9999),
    "an index of 1, with dispersion": (Dielectric(ior=1.0, dispersion=1.0), 0.9999),
    "a thin pane of index 1": (ThinDielectric(ior=1.0), 0.9999),
    "a thin pane": (ThinDielectric(ior=1.5), 0.999),
    "a thin pane of white tint": (ThinDielectric(ior=1.9, tint=(1, 1, 1)), 0.998),
    "diamond that parts colours": (Dielectric(ior="diamond", dispersion="measured"), 0.99),
    "frosted flint that parts colours": (RoughDielectric(ior="sf11", dispersion="measured", roughness=0.05), 0.975),
    "a mirror with an image": (Conductor(color=ImageTexture(path="white.png"), roughness=0.0), 0.999),
    "metal with an image": (Conductor(color=ImageTexture(path="white.png"), roughness=0.05), 0.995),
}
"""What it is made of, and the least share of the light that is left."""


@pytest.mark.parametrize("name", MATERIALS)
def test_white_light_stays_white_in_truth_and_in_light_paths(name: str) -> None:
    use_mitsuba()
    material, least = MATERIALS[name]
    item = SceneObject(name="ball", mesh=BALL, material=material)
    scene = dataclasses.replace(scene_of(item), baked={"white.png": WHITE_PNG.getvalue()})
    truth = render_view(Renderer(scene, max_depth=64), CAMERAS, 0, spp=64, view_seed=0, ceiling_db=None).radiance
    origin, directions = CAMERAS[0].rays()
    rays = directions.reshape(-1, 3)
    tracer = LightPathTracer((BALL,), (material,))
    paths = tracer.trace_ends(np.tile(origin, (len(rays), 1)), rays, Limits(max_branches=16, max_depth=32))
    for light in (truth.reshape(-1, 3).mean(axis=0), paths.exit_throughput.sum(axis=0) / len(rays)):
        assert (least < light).all() and (light < 1.005).all(), light


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.8])
@pytest.mark.parametrize("ior", [1.33, 1.5, 2.4])
def test_rough_glass_keeps_all_light(ior: float, roughness: float) -> None:
    """At a high index, light meets many facets before it leaves, so the estimate is noisy."""
    truth, paths = kept_by(RoughDielectric(ior=ior, roughness=roughness))
    off = 0.01 if ior * roughness < 1.5 else 0.06
    assert truth == pytest.approx(1, abs=off) and paths == pytest.approx(1, abs=off)


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.8])
def test_rough_metal_and_plastic_keep_all_light(roughness: float) -> None:
    assert kept_by(Conductor(color=(1, 1, 1), roughness=roughness)) == pytest.approx((1, 1), abs=0.01)
    truth, _ = kept_by(Plastic(color=(1, 1, 1), roughness=roughness))
    assert truth == pytest.approx(1, abs=0.01)
    # What the coat mirrors is all that light paths follow, and all that is left above a black base.
    truth, paths = kept_by(Plastic(color=(0, 0, 0), roughness=roughness))
    assert paths == pytest.approx(truth, rel=0.01)


def kept_by(material: Material) -> tuple[float, float]:
    """Share of light that a ball sends back to a camera that sees nothing else: in truth, and in light paths."""
    use_mitsuba()
    cameras = camera_at((0.3, -3.0, 0.4), fov_x=0.22, size=12)
    scene = scene_of(SceneObject(name="ball", mesh=BALL, material=material))
    renderer = Renderer(scene, max_depth=64)
    renderer._tracer.aims = True  # Light is aimed at and run into: both must count as much.
    truth = render_view(renderer, cameras, 0, spp=512, view_seed=0, ceiling_db=None).radiance
    origin, directions = cameras[0].rays()
    rays = np.tile(directions.reshape(-1, 3), (400, 1))
    limits = Limits(max_branches=24, max_depth=64, min_throughput=1e-4)
    paths = LightPathTracer((BALL,), (material,)).trace_ends(np.tile(origin, (len(rays), 1)), rays, limits)
    return float(truth.mean()), float(paths.exit_throughput.sum() / rays.size)


@pytest.mark.parametrize("branches", [2, 12])
def test_no_light_is_lost_with_few_branches(branches: int) -> None:
    """In a glass of water around a ball of another glass, most branches are not followed."""
    use_mitsuba()
    ball = dataclasses.replace(BALL, vertices=BALL.vertices / 2)
    tracer = LightPathTracer((BALL, ball), (Dielectric(ior=1.33), Dielectric(ior=1.7, priority=1)))
    origin, directions = CAMERAS[0].rays()
    rays = directions.reshape(-1, 3)
    paths = tracer.trace_ends(np.tile(origin, (len(rays), 1)), rays, Limits(branches, makes_up=True))
    light = np.zeros((len(rays), 3))
    np.add.at(light, paths.exit_ray, paths.exit_throughput)
    ends = np.bincount(paths.exit_ray, minlength=len(rays))
    assert (ends[ends > 0] <= branches).all() and (ends > 0).mean() > 0.7
    np.testing.assert_allclose(light[ends > 0], 1, atol=1e-4)
