"""Tests glass that parts colours, in the truth and in light paths, against Snell's law and against three glasses."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
from support.meshes import box, mesh_of
from support.reference import fresnel_reflectance
from support.scenes import DUSK, WHITE, camera_at, rendered, scene_of, seen_along
from support.synthetic import quad

from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.mitsuba_scene import radiance_of_environment
from datagen.scene.description import Lobe, SceneObject, SoftEnvironment
from datagen.scene.materials import Dielectric, Diffuse, Material, RoughDielectric
from datagen.trace.branch_outputs import PathEnds
from datagen.trace.light_path import LightPathTracer
from datagen.trace.surface_tables import Limits

use_mitsuba()

FLINT = Dielectric(ior="sf11", dispersion="measured")
BLACK = SoftEnvironment(zenith=(0, 0, 0), horizon=(0, 0, 0), ground=(0, 0, 0))
APEX = math.radians(30)
"""Between the two faces of the prism that light crosses."""


def prism() -> Mesh:
    """A wedge whose first face, x = 0, looks along -x; its second one leans by the apex angle about y."""
    corners = np.array([(0, -1), (math.tan(APEX) * 2, -1), (0, 1)])
    shape = trimesh.creation.extrude_triangulation(corners, [[0, 1, 2]], 4.0).apply_translation((0, 0, -2))
    shape.unmerge_vertices()
    return mesh_of(shape)


def through_the_prism(ior: float, angle: float) -> tuple[np.ndarray, float]:
    """Where light that arrives in the plane z = 0, `angle` above the first face's normal, leaves, and its share."""
    inside = math.asin(math.sin(angle) / ior)
    second = APEX - inside  # The second face's normal points up by the apex angle.
    out = math.asin(ior * math.sin(second))
    share = (1 - fresnel_reflectance(math.cos(angle), ior)) * (1 - fresnel_reflectance(math.cos(second), 1 / ior))
    heading = APEX - out
    return np.array([math.cos(heading), math.sin(heading), 0]), share


def traced(mesh: Mesh, material: Material, direction: tuple[float, float, float], **limits: int) -> PathEnds:
    d = np.tile(np.array(direction) / np.linalg.norm(direction), (256, 1)).astype(np.float32)
    return LightPathTracer((mesh,), (material,)).trace_ends(-3 * d, d, Limits(**limits))


@pytest.mark.parametrize("angle_deg", [0.0, 12.0, 30.0])
def test_a_prism_sends_each_colour_where_snells_law_says(angle_deg: float) -> None:
    """In light paths; and the truth sees, in each colour, the light that lies in that colour's direction."""
    angle = math.radians(angle_deg)
    direction = (math.cos(angle), math.sin(angle), 0.0)
    paths = traced(prism(), FLINT, direction, max_branches=4)
    assert (np.count_nonzero(paths.exit_throughput, axis=1) == 1).all()
    ends, shares = [], []
    for channel in range(3):
        assert FLINT.medium is not None
        way, share = through_the_prism(FLINT.medium.iors[channel], angle)
        own = np.flatnonzero(paths.exit_throughput[:, channel])
        # Each ray's first branch of a colour is the refracted one.
        rays, first = np.unique(paths.exit_ray[own], return_index=True)
        assert np.array_equal(rays, np.arange(256))
        np.testing.assert_allclose(paths.exit_direction[own[first]], np.tile(way, (256, 1)), atol=1e-5)
        np.testing.assert_allclose(
            paths.exit_throughput[own[first]], np.tile(share * np.eye(3)[channel], (256, 1)), rtol=1e-4
        )
        ends.append(way)
        shares.append(share)
    spread = math.degrees(math.acos(ends[0] @ ends[2]))
    assert spread > 0.9
    # A lamp two degrees wide in the direction of blue light.
    sky = dataclasses.replace(BLACK, lobes=(Lobe(direction=tuple(ends[2]), radiance=(5, 5, 5), sharpness=4000.0),))
    expected = [share * radiance_of_environment(sky, way)[c] for c, (way, share) in enumerate(zip(ends, shares))]
    assert expected[0] < 0.6 * expected[2]
    found = seen_along(direction, SceneObject(name="prism", mesh=prism(), material=FLINT), environment=sky, spp=1 << 13)
    # The rows of the sky's map are a sixth as wide as the lamp.
    assert found == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize("roughness", [pytest.param(0.0, marks=pytest.mark.full), 0.2])
def test_truth_and_light_paths_of_each_colour_are_those_of_glass_with_that_colours_index(roughness: float) -> None:
    """Behind a diffuse floor's bounce and with a lamp that is aimed at."""
    glass = RoughDielectric(ior=1.6, dispersion=8.0, absorption=(0.1, 0.3, 0.6), roughness=roughness)
    ball = mesh_of(trimesh.creation.icosphere(4, 0.5))
    floor = SceneObject(name="floor", mesh=quad(-0.6), material=Diffuse(color=(0.7, 0.5, 0.4)))
    sky = dataclasses.replace(DUSK, lobes=(Lobe(direction=(1, 1, 1), radiance=(9, 7, 5), sharpness=60),))
    view = camera_at((1.2, 0.6, 0.7), fov_x=0.5)

    def picture(material: Material, spp: int) -> np.ndarray:
        scene = scene_of(SceneObject(name="ball", mesh=ball, material=material), floor, environment=sky)
        return rendered(scene, view, spp=spp)

    found = picture(glass, 8192)  # Each path has one of three colours; 1,024 of them leave 1.2 % of noise.
    for channel, ior in enumerate(glass.medium.iors):
        single = dataclasses.replace(glass, ior=ior, dispersion=0.0)
        expected = picture(single, 2048)[..., channel]
        assert found[..., channel].mean() == pytest.approx(expected.mean(), rel=0.01)
        assert np.abs(found[..., channel] - expected).mean() < 0.06 * expected.mean()
        one, three = (
            (paths.exit_throughput[:, channel] * radiance_of_environment(DUSK, paths.exit_direction)[:, channel]).sum()
            for paths in (traced(ball, material, (0.2, 0.1, -1.0), max_branches=6) for material in (single, glass))
        )
        assert three == pytest.approx(one, rel=1e-5 if not roughness else 0.03)


@pytest.mark.parametrize("spp", [1, 2, 7, 64])
def test_colours_are_shared_out_without_changing_their_mean(spp: int) -> None:
    """However few samples a pixel has: a white furnace stays white in the mean over pixels."""
    slab = SceneObject(name="slab", mesh=box((40.0, 40.0, 0.2)), material=dataclasses.replace(FLINT, ior="diamond"))
    found = rendered(scene_of(slab, environment=WHITE), camera_at((0.0, 0.5, 3.0), fov_x=0.6, size=96), spp=2 * spp)
    assert found.mean(axis=(0, 1)) == pytest.approx(np.ones(3), abs=2e-4 if spp > 2 else 0.03)


def test_rays_that_meet_no_dispersing_glass_keep_all_colours_and_are_traced_once() -> None:
    left, right = (mesh_of(trimesh.creation.icosphere(3, 0.5).apply_translation((x, 0, 0))) for x in (-1, 1))
    origins = np.array([(-1.1, 0.1, 3.0), (1.1, 0.1, 3.0), (1.1, 0.1, -3.0), (0, 0, 3.0)], np.float32)
    directions = np.array([(0, 0, -1.0), (0, 0, -1.0), (0, 0, 1.0), (0, 0, -1.0)], np.float32)
    plain = Dielectric(ior=1.5)
    single = LightPathTracer((left, right), (plain, plain))
    expected = single.trace_ends(origins, directions, Limits(max_branches=3))
    tracer = LightPathTracer((left, right), (plain, dataclasses.replace(plain, dispersion=1.0)))
    found = tracer.trace_ends(origins, directions, Limits(max_branches=3))
    num_colors = np.count_nonzero(found.exit_throughput, axis=1)
    assert sorted(set(found.exit_ray[num_colors == 1])) == [1, 2]
    assert sorted(set(found.exit_ray[num_colors == 3])) == [0, 3]
    assert (np.diff(found.exit_ray) >= 0).all()
    for name in ("exit_ray", "exit_direction", "exit_throughput"):
        kept = [getattr(paths, name)[np.isin(paths.exit_ray, (0, 3))] for paths in (found, expected)]
        assert np.array_equal(*kept), name
