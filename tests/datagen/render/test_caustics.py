"""Tests that the map of caustics changes the noise of truth and nothing else."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
from support.meshes import box, mesh_of
from support.scenes import DUSK, scene_of
from support.synthetic import look_at, quad

from datagen.data.cameras import Cameras
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import RectangleLight, SceneObject
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Plastic, RoughDielectric, ThinDielectric
from datagen.scene.modelling import moved

use_mitsuba()

from datagen.render.truth import Renderer  # noqa: E402

LAMP = RectangleLight(corner=(-0.1, -0.6, 1.5), edge_u=(0, 0.1, 0), edge_v=(0.1, 0, 0), radiance=(160, 180, 200))
BALL = mesh_of(trimesh.creation.icosphere(4, 0.3))
GREY, PLASTIC = Diffuse(color=(0.7, 0.6, 0.5)), Plastic(color=(0.5, 0.6, 0.7), roughness=0.2)
RUNS = 12


def pictures(renderer: Renderer, cameras: Cameras, first_seed: int) -> np.ndarray:
    return np.stack([renderer.radiance(cameras, 0, spp=512, seed=first_seed + run) for run in range(RUNS)])


@pytest.mark.parametrize(
    ("glass", "floor"),
    [
        pytest.param(Dielectric(ior=1.5, absorption=(2.0, 0.5, 0.1)), GREY, id="absorbing", marks=pytest.mark.full),
        pytest.param(Dielectric(ior=1.5, dispersion=0.8), PLASTIC, id="dispersive on plastic", marks=pytest.mark.full),
        pytest.param(RoughDielectric(ior=1.4, roughness=0.1, tint=(0.9, 0.8, 1.0)), GREY, id="frosted"),
        pytest.param(Conductor(color=(0.9, 0.8, 0.4), roughness=0.0), GREY, id="mirror", marks=pytest.mark.full),
    ],
)
def test_following_caustics_changes_no_mean_and_less_noise(
    glass: Dielectric | Conductor, floor: Diffuse | Plastic
) -> None:
    """Each of 16 regions, and the whole, against the same path tracer without a map; below the pane, all is caustic."""
    objects = (
        SceneObject(name="ball", mesh=BALL, material=glass),
        SceneObject(name="pane", mesh=moved(box((0.7, 0.7, 0.02)), (0.75, 0, 0.1)), material=Dielectric(ior=1.5)),
        SceneObject(name="film", mesh=quad(0.6), material=ThinDielectric(ior=1.3, tint=(0.9, 0.9, 1.0))),
        SceneObject(name="floor", mesh=quad(-0.35), material=floor),
    )
    scene = dataclasses.replace(scene_of(*objects, environment=DUSK), lights=(LAMP,))
    pose = look_at(np.array((1.8, 1.2, 0.5)), np.array((0.2, 0, -0.2)))[None]
    cameras = Cameras(world_from_camera=pose, fov_x=0.6, width=16, height=16)
    renderer = Renderer(scene, max_depth=16)
    assert renderer._tracer.caustics is not None
    guided = pictures(renderer, cameras, 0)
    renderer._tracer.caustics = None
    plain = pictures(renderer, cameras, 1000)
    regions = [runs.reshape(RUNS, 4, 4, 4, 4, 3).mean(axis=(2, 4)) for runs in (guided, plain)]
    error = np.sqrt(sum(run.var(axis=0, ddof=1) / RUNS for run in regions))
    z = (regions[0].mean(axis=0) - regions[1].mean(axis=0)) / error
    # With 11 + 11 degrees of freedom, 48 values of |z| have a mean near 0.83; colours move together.
    assert np.abs(z).mean() < 1.3 and np.abs(z).max() < 5.5
    whole = [runs.mean(axis=(1, 2, 3)) for runs in (guided, plain)]
    spread = math.sqrt(sum(run.var(ddof=1) / RUNS for run in whole))
    assert abs(whole[0].mean() - whole[1].mean()) < 4 * spread
    assert spread < 0.01 * whole[1].mean(), "the test is sharp enough to see a percent"
    gain = plain.var(axis=0).mean() / guided.var(axis=0).mean()
    assert gain > 1.3


def test_a_map_draws_the_directions_of_its_photons_with_the_density_that_it_states() -> None:
    import drjit as dr
    import mitsuba as mi

    from datagen.render.caustics import CausticMap

    # Photons arrive at one place, most from above, a quarter of the power from the side; and at a far brighter one.
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, 1010)
    is_far = dr.arange(mi.UInt32, 1010) >= 1000
    from_side = dr.arange(mi.UInt32, 1010) < 500
    d = mi.Vector3f(dr.select(from_side, 1, 0), 0, dr.select(from_side, 0, 1))
    moves = mi.Vector3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
    p = mi.Point3f(dr.select(is_far, 5, 0.5)) + 1e-3 * moves
    caustics = CausticMap(p, d, dr.select(is_far, mi.Float(1e25), dr.select(from_side, 1, 3)), sampler)
    count = 1 << 20
    sampler.seed(2, count)
    spot = caustics.find(mi.Point3f(np.array(p)[:, np.arange(count) % 1000]), mi.Bool(True))
    drawn = caustics.sample(spot, sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
    pdf, found = np.array(caustics.pdf(spot, drawn, mi.Bool(True))), np.array(drawn).T
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert (pdf > 0).mean() > 0.9999, "but for directions rounded across the edge of a bin"
    assert (found[:, 0] > 0.9).mean() == pytest.approx(0.25, abs=0.05)
    # The mean of 1 / pdf is the solid angle of the bins with photons.
    bins = np.mean(1 / pdf[pdf > 0]) * caustics._num_bins / (4 * math.pi)
    assert bins == pytest.approx(np.mean(np.array(spot.end - spot.first)), rel=0.01)
    elsewhere = caustics.find(mi.Point3f(7, 7, 7), mi.Bool(True))
    assert elsewhere.first[0] == elsewhere.end[0]
