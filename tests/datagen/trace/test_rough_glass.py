"""Tests rough glass, in the truth and in light paths, against Mitsuba's own facets and against smooth glass.

Mitsuba's facets lose what ours keep (tests/datagen/trace/test_white_furnace.py).
"""

import math

import numpy as np
import pytest
import trimesh
from support.meshes import box, mesh_of
from support.scenes import DUSK, scene_of, seen_along
from support.synthetic import quad

from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.albedo import facet_shares
from datagen.render.facets import lobe_of_glass
from datagen.render.mitsuba_scene import load_scene_mitsuba, radiance_of_environment
from datagen.scene.description import SceneObject
from datagen.scene.materials import Dielectric, Material, RoughDielectric
from datagen.trace.light_path import LightPathTracer, TracedPaths
from datagen.trace.surface_tables import Limits

use_mitsuba()

BALL = mesh_of(trimesh.creation.icosphere(4, 0.5))


def rays_along(direction: tuple[float, float, float], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays to the origin, all the same, from 3 m away."""
    d = np.tile(np.array(direction) / np.linalg.norm(direction), (count, 1)).astype(np.float32)
    return -3 * d, d


def traced(mesh: Mesh, material: Material, direction: tuple[float, float, float], **limits: int) -> TracedPaths:
    return LightPathTracer((mesh,), (material,)).trace(*rays_along(direction, 4096), Limits(**limits))


@pytest.mark.parametrize("roughness", [0.05, 0.4])
@pytest.mark.parametrize("direction", [(0.3, 0.0, -1.0), (2.0, 0.0, -1.0), (0.5, 0.0, 1.0), (0.0, 1.4, 1.0)])
def test_facets_mirror_and_pass_in_the_same_directions_as_mitsubas_and_all_light(
    roughness: float, direction: tuple[float, float, float]
) -> None:
    """From both sides of one surface; 55 degrees from inside is beyond the critical angle."""
    import mitsuba as mi

    glass = RoughDielectric(ior=1.5, roughness=roughness)
    paths = traced(quad(0.0), glass, direction, max_branches=2)
    loaded = load_scene_mitsuba(scene_of(SceneObject(name="pane", mesh=quad(0.0), material=glass)))
    origins, directions = rays_along(direction, 1)
    ray = mi.Ray3f(mi.Point3f(*origins[0].tolist()), mi.Vector3f(*directions[0].tolist()))
    si, count = loaded.ray_intersect(ray), 1 << 18
    numbers = np.random.default_rng(0).random((3, count)).astype(np.float32)
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, mi.Float(numbers[0]), mi.Point2f(numbers[1:]), True)
    wo = np.array(si.to_world(sample.wo)).T
    eta = 1.5 if direction[2] < 0 else 1 / 1.5
    kept = sum(facet_shares(np.abs(np.array(si.wi.z)), roughness, eta))
    value = np.array(weight).reshape(3, -1)[0] / kept * np.ones(count)
    above = -math.copysign(1, direction[2]) * wo[:, 2] > 0
    ways, shares = paths.end_direction.astype(np.float64), paths.end_throughput[..., 0].astype(np.float64)
    for is_above in (True, False):
        expected = np.where(above == is_above, value, 0)
        up = -math.copysign(1, direction[2]) * ways[..., 2] > 0
        found = np.where((up == is_above), shares, 0)
        assert found.sum(axis=0).mean() == pytest.approx(expected.mean(), rel=0.02, abs=2e-3)
        moments = np.einsum("br,bra->a", found, ways) / ways.shape[1]
        assert moments == pytest.approx((expected[:, None] * wo).mean(axis=0), abs=0.01 * max(1, expected.mean()))


def test_glass_of_roughness_0_is_smooth_glass_to_the_last_bit_and_of_little_nearly() -> None:
    smooth, rough_0, rough = (
        traced(BALL, material, (0.3, 0.2, -1.0), max_branches=4)
        for material in (Dielectric(ior=1.4), RoughDielectric(ior=1.4, roughness=0.0), RoughDielectric(roughness=0.001))
    )
    for name in ("object_id", "position", "end_direction", "end_throughput"):
        assert np.array_equal(getattr(smooth, name), getattr(rough_0, name))
    expected = traced(BALL, Dielectric(), (0.3, 0.2, -1.0), max_branches=4)
    assert np.median(np.abs(rough.end_direction[0] - expected.end_direction[0])) < 3e-3
    assert rough.end_throughput[0].mean() == pytest.approx(expected.end_throughput[0].mean(), rel=1e-3)


@pytest.mark.parametrize("direction", [(0.3, 0.0, 1.0), (1.5, 0.2, 1.0), (0.3, 0.1, -1.0), (0.9, 0.0, -1.0)])
def test_the_lobe_of_facets_is_mitsubas(direction: tuple[float, float, float]) -> None:
    """Value and density of light from all around, for rays that meet the surface from outside and from inside."""
    import mitsuba as mi

    count, alpha, ior = 2000, 0.3, 1.6
    glass = mi.load_dict(
        {"type": "roughdielectric", "int_ior": ior, "ext_ior": 1.0, "alpha": alpha, "distribution": "ggx"}
    )
    wo = np.random.default_rng(0).normal(size=(3, count))
    wo = mi.Vector3f(*(wo / np.linalg.norm(wo, axis=0)).astype(np.float32))
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(*(np.array(direction) / np.linalg.norm(direction)).tolist())
    value, pdf = glass.eval_pdf(mi.BSDFContext(), si, wo, True)
    found_value, found_pdf = lobe_of_glass(si.wi, wo, mi.Float(ior), mi.Float(alpha))
    assert np.array(found_value) == pytest.approx(np.array(value)[0], rel=2e-3, abs=1e-5)
    assert np.array(found_pdf) == pytest.approx(np.array(pdf), rel=2e-3, abs=1e-5)


@pytest.mark.parametrize("roughness", [0.1, 0.5])
def test_light_paths_through_rough_glass_see_what_the_truth_sees(roughness: float) -> None:
    """Two facets in a row, and what absorbs between them: the second must not follow from the first."""
    glass = RoughDielectric(ior=1.5, roughness=roughness, absorption=(0.2, 1.0, 3.0), tint=(0.5, 0.8, 1.0))
    slab, direction = box((4.0, 4.0, 0.4)), (0.4, 0.1, -1.0)
    truth = seen_along(direction, SceneObject(name="slab", mesh=slab, material=glass), environment=DUSK, spp=1 << 15)
    paths = traced(slab, glass, direction, max_branches=12, max_vertices=1)
    sky = radiance_of_environment(DUSK, paths.end_direction.astype(np.float64))
    found = (paths.end_throughput * sky).sum(axis=0).mean(axis=0)
    assert found == pytest.approx(truth, rel=0.02)
