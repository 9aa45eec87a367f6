"""Tests path-traced truth against closed formulas, and its own account of its noise."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
from support.meshes import box, inside_out, mesh_of
from support.reference import fresnel_reflectance
from support.scenes import DUSK, camera_at, rendered, scene_of
from support.synthetic import look_at, quad

from datagen.data.cameras import Cameras
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Lobe, RectangleLight, Scene, SceneObject, SoftEnvironment
from datagen.scene.materials import Dielectric, Diffuse, Plastic, RoughDielectric, ThinDielectric
from datagen.scene.modelling import ball, merged, moved
from datagen.scene.soundness import check_scene

use_mitsuba()


from datagen.render.albedo import SHAPE  # noqa: E402
from datagen.render.mitsuba_scene import radiance_of_environment  # noqa: E402
from datagen.render.truth import Renderer, render_view  # noqa: E402

BALL = SceneObject(name="ball", mesh=mesh_of(trimesh.creation.icosphere(3, 0.4)), material=Dielectric(ior=1.5))
FLOOR = SceneObject(name="floor", mesh=quad(-0.5), material=Diffuse(color=(0.7, 0.3, 0.2)))


def test_overlapping_parts_of_one_tinted_glass_look_as_one() -> None:
    glass = Dielectric(ior=1.5, tint=(1.0, 0.7, 0.4))
    parts = [
        SceneObject(name=name, mesh=moved(box((0.3, size, size)), (x, 0, 0)), material=glass)
        for name, size, x in (("left", 8, -0.1), ("right", 7, 0.1))
    ]
    whole = SceneObject(name="whole", mesh=box((0.5, 8, 8)), material=glass)
    two, one = (rendered(scene_of(*items), camera_at((9, 0, 0.0), fov_x=0.02), spp=1024) for items in (parts, [whole]))
    assert two.mean(axis=(0, 1)) == pytest.approx(one.mean(axis=(0, 1)), rel=0.01)


@pytest.mark.parametrize("tint", [(1.0, 1.0, 1.0), (0.9, 0.5, 0.1)])
def test_light_goes_straight_through_a_thin_pane_and_takes_its_tint(tint: tuple[float, float, float]) -> None:
    pane = SceneObject(name="pane", mesh=quad(0.0), material=ThinDielectric(ior=1.5, tint=tint))
    cameras = camera_at((0.9, 0.4, 1.5), fov_x=0.05)
    image = rendered(scene_of(pane, environment=DUSK), cameras, spp=4096)
    direction = -cameras.world_from_camera[0, :3, 2]
    r = fresnel_reflectance(abs(direction[2]), 1.5)
    reflected = 2 * r / (1 + r)  # Both faces and all reflections between them.
    through = (1 - reflected) * np.array(tint) * radiance_of_environment(DUSK, direction)
    expected = through + reflected * radiance_of_environment(DUSK, direction * [1, 1, -1])
    assert image.mean(axis=(0, 1)) == pytest.approx(expected, rel=0.01)


SPARK = dataclasses.replace(DUSK, lobes=(Lobe(direction=(1, 1, 1), radiance=(9, 7, 5), sharpness=60),))
PANEL = RectangleLight(corner=(-0.5, -1.5, 2), edge_u=(0, 1, 0), edge_v=(1, 0, 0), radiance=(4, 5, 6))


@pytest.mark.parametrize(
    ("environment", "lights", "roughness"),
    [
        pytest.param(DUSK, (), 0.0, marks=pytest.mark.full),
        pytest.param(DUSK, (), 0.25, marks=pytest.mark.full),
        (SPARK, (), 0.25),
        pytest.param(DUSK, (PANEL,), 0.0, marks=pytest.mark.full),
        (SPARK, (PANEL,), 0.0),
    ],
    ids=["soft sky", "soft sky, rough", "small light in it, rough", "lamp", "both"],
)
def test_the_path_tracer_is_unbiased_against_mitsubas_own(
    environment: SoftEnvironment, lights: tuple[RectangleLight, ...], roughness: float
) -> None:
    """Whether light is aimed at or only run into."""
    import mitsuba as mi

    glass = RoughDielectric(tint=(1, 0.8, 0.5), roughness=roughness)
    objects = (
        SceneObject(name="ball", mesh=mesh_of(trimesh.creation.icosphere(4, 0.4)), material=glass),
        FLOOR,
        SceneObject(
            name="pot", mesh=moved(ball(0.3), (0, 0.9, 0)), material=Plastic(color=(0.2, 0.4, 0.6), roughness=0.2)
        ),
    )
    scene = dataclasses.replace(scene_of(*objects, environment=environment), lights=lights)
    cameras = camera_at((2, 1, 1), fov_x=0.7, size=32)
    renderer = Renderer(scene, max_depth=24)
    renderer._tracer.albedo = mi.Float(np.ones(SHAPE).ravel())  # Mitsuba's facets lose what ours keep.
    ours = np.stack([renderer.radiance(cameras, 0, spp=256, seed=100 + seed) for seed in range(8)])
    assert_same_estimate(mitsubas_own(scene, cameras), ours)


def mitsubas_own(scene: Scene, cameras: Cameras) -> np.ndarray:
    """Eight pictures (8, h, w, 3) by Mitsuba's `path`, as it comes but for Russian roulette."""
    import mitsuba as mi

    from datagen.render.mitsuba_scene import load_scene_mitsuba, load_sensor

    loaded = load_scene_mitsuba(scene)
    sensor = load_sensor(cameras[0])
    path = mi.load_dict({"type": "path", "max_depth": 24, "rr_depth": 50})
    return np.stack([np.array(mi.render(loaded, sensor=sensor, integrator=path, spp=256, seed=s)) for s in range(8)])


def test_a_pixel_and_its_ray_meet_the_same_point_wherever_the_principal_point_is() -> None:
    """The middle of a rendered quad is where the middle of its projected outline is, to a twentieth of a pixel."""
    pose = look_at(np.array([1.0, -0.8, 2.0]), np.array([0.2, 0.1, 0.0]))[None]
    lens = Cameras(world_from_camera=pose, fov_x=1.1, width=40, height=24, center=(13.0, 17.5))
    patch = dataclasses.replace(quad(0.0), vertices=np.float32(0.2) * quad(0.0).vertices)
    scene = scene_of(SceneObject(name="patch", mesh=patch, material=Diffuse(color=(0.25, 0.25, 0.25))))
    darkness = 1 - rendered(scene, lens, spp=256)[..., 0]
    rows, columns = np.mgrid[:24, :40] + 0.5
    found = [float((darkness * place).sum() / darkness.sum()) for place in (columns, rows)]
    corners, _ = lens[0].project(patch.vertices.astype(np.float64))
    following = np.roll(corners, -1, axis=0)
    area = corners[:, 0] * following[:, 1] - following[:, 0] * corners[:, 1]
    expected = ((corners + following) * area[:, None]).sum(axis=0) / (3 * area.sum())
    assert found == pytest.approx(expected, abs=0.05)


def assert_same_estimate(one: np.ndarray, other: np.ndarray) -> None:
    """Two-sided: pictures (8, h, w, 3) of eight seeds each differ by no more than their own noise."""
    error = np.sqrt(sum(run.var(axis=0, ddof=1) / len(run) for run in (one, other))) + 1e-4
    z = (one.mean(axis=0) - other.mean(axis=0)) / error
    # With 7 + 7 degrees of freedom |z| has a mean near 0.83 and hardly ever reaches 10.
    assert np.abs(z).mean() < 1.0
    assert np.abs(z).max() < 10
    assert one.mean() == pytest.approx(other.mean(), rel=1e-3)


@pytest.mark.parametrize(
    ("glass_first", "priorities"), [(True, (1, 0)), (True, (0, 1)), (True, (0, 0)), (False, (0, 0)), (False, (-1, 3))]
)
def test_glass_and_water_that_overlap_pass_what_fresnel_and_beer_say(
    glass_first: bool, priorities: tuple[int, int]
) -> None:
    """Air, glass, water, air at normal incidence; whose medium the 0.1 m of overlap are depends on the priorities."""
    iors, absorptions = (1.5, 1.33) if glass_first else (1.33, 1.5), (2.0, 5.0)
    slabs = [
        SceneObject(
            name=name,
            mesh=moved(box((0.3, size, size)), (x, 0, 0)),
            material=Dielectric(ior=ior, absorption=(absorption,) * 3, priority=priority),
        )
        for name, x, size, ior, absorption, priority in zip(
            ("right", "left"), (0.1, -0.1), (8, 7), iors, absorptions, priorities
        )
    ]
    image = rendered(scene_of(*slabs), camera_at((9, 0, 0.0), fov_x=0.02), spp=4096)
    lengths = (0.3, 0.2) if priorities[0] >= priorities[1] else (0.2, 0.3)
    taus = [math.exp(-absorption * length) for absorption, length in zip(absorptions, lengths)]
    faces = [fresnel_reflectance(1.0, ratio) for ratio in (iors[0], iors[1] / iors[0], 1 / iors[1])]
    through, back = 1 - faces[-1], faces[-1]  # Of what stands to the left, of light that comes from the right.
    for face, tau in zip(faces[-2::-1], taus[::-1]):
        passes = (1 - face) * tau / (1 - face * back * tau**2)
        through, back = passes * through, face + (1 - face) * passes * tau * back
    assert image.mean() == pytest.approx(through + back, rel=0.01)


def test_nested_media_vanish_in_a_white_furnace_however_they_overlap() -> None:
    tilted = trimesh.creation.box((0.4, 0.4, 0.4)).apply_transform(
        trimesh.transformations.rotation_matrix(0.7, (1, 2, 3), (0, 0, 0))
    )
    tilted.unmerge_vertices()
    objects = (
        SceneObject(name="water", mesh=ball(0.5), material=Dielectric(ior=1.33)),
        SceneObject(name="ice", mesh=moved(mesh_of(tilted), (0.1, 0, 0.35)), material=Dielectric(ior=1.31, priority=2)),
        SceneObject(name="glass", mesh=moved(ball(0.5), (0, 0.4, -0.1)), material=Dielectric(ior=1.5, priority=1)),
        SceneObject(name="floor", mesh=quad(-0.7), material=Diffuse(color=(1, 1, 1))),
    )
    cameras = camera_at((2, 1, 1), fov_x=0.6, size=16)
    image = render_view(Renderer(scene_of(*objects), max_depth=64), cameras, 0, spp=64, view_seed=0, ceiling_db=None)
    assert image.radiance.mean() == pytest.approx(1, abs=5e-3)
    assert np.abs(image.radiance - 1).max() < 0.1


def test_water_in_a_glass_shell_is_mitsubas_own_picture_of_its_two_interfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ball of water that reaches into the wall of a hollow shell."""
    from datagen.render import mitsuba_scene

    outer, inner, larger = ball(0.5), ball(0.4), ball(0.43)
    cavity = inside_out(inner)
    opaque = (
        SceneObject(name="floor", mesh=quad(-0.6), material=Diffuse(color=(0.7, 0.3, 0.2))),
        SceneObject(name="pearl", mesh=moved(ball(0.12), (0, 0.1, 0)), material=Diffuse(color=(0.8, 0.8, 0.7))),
    )
    glass, water = Dielectric(ior=1.6), Dielectric(ior=1.2)
    explicit = scene_of(
        SceneObject(name="glass", mesh=outer, material=glass),
        SceneObject(name="water", mesh=inner, material=water),
        *opaque,
        environment=DUSK,
    )
    nested = scene_of(
        SceneObject(name="glass", mesh=merged([outer, cavity]), material=glass),
        SceneObject(name="water", mesh=larger, material=dataclasses.replace(water, priority=-1)),
        *opaque,
        environment=DUSK,
    )
    check_scene(nested)
    cameras = camera_at((2, 1, 0.6), fov_x=0.6, size=32)
    renderer = Renderer(nested, max_depth=24)
    ours = np.stack([renderer.radiance(cameras, 0, spp=256, seed=100 + seed) for seed in range(8)])

    plain = mitsuba_scene._bsdf
    in_glass = {"type": "dielectric", "int_ior": 1.2, "ext_ior": 1.6}
    monkeypatch.setattr(
        mitsuba_scene, "_bsdf", lambda scene, item: in_glass if item.name == "water" else plain(scene, item)
    )
    assert_same_estimate(mitsubas_own(explicit, cameras), ours)


def test_surfaces_that_are_none_are_no_bounces() -> None:
    block = SceneObject(name="block", mesh=box((2, 8, 8)), material=Dielectric(ior=1.5, priority=1))
    sheets = [moved(box((0.04, 7, 7)), (0.06 * index - 0.5, 0, 0)) for index in range(15)]
    hidden = [SceneObject(name=f"hidden{i}", mesh=mesh, material=Dielectric()) for i, mesh in enumerate(sheets)]
    cameras = camera_at((9, 0, 0.0), fov_x=0.02)
    bare, full = (
        render_view(Renderer(scene_of(*objects), max_depth=6), cameras, 0, spp=4096, view_seed=0, ceiling_db=None)
        for objects in ((block,), (block, *hidden))
    )
    assert full.radiance.mean() == pytest.approx(bare.radiance.mean(), rel=2e-3)
    assert bare.radiance.mean() > 0.99  # What lacks was reflected more than four times.


def test_the_noise_estimate_is_the_real_error() -> None:
    drop = mesh_of(trimesh.creation.icosphere(3, 0.3).apply_translation((0.3, 0, 0)))
    water = SceneObject(name="water", mesh=drop, material=Dielectric(ior=1.33, absorption=(3, 1, 0), priority=-1))
    scene = scene_of(BALL, water, FLOOR, environment=DUSK)
    cameras = camera_at((2, 1, 1), fov_x=0.7, size=32)
    renderer = Renderer(scene, max_depth=24)
    from datagen.data.images import srgb_from_linear

    radiance = render_view(renderer, cameras, 0, spp=4096, view_seed=99, ceiling_db=None).radiance
    reference = srgb_from_linear(radiance)
    few = [render_view(renderer, cameras, 0, spp=32, view_seed=seed, ceiling_db=None) for seed in range(8)]
    real = np.mean([np.mean((srgb_from_linear(truth.radiance) - reference) ** 2) for truth in few])
    assert np.mean([truth.noise_mse for truth in few]) == pytest.approx(real, rel=0.15)
    real = np.mean([(truth.radiance - radiance) ** 2 for truth in few])
    assert np.mean([truth.half_difference**2 for truth in few]) == pytest.approx(real, rel=0.15)


def test_a_ceiling_is_reached_and_costs_more_samples() -> None:
    renderer = Renderer(scene_of(BALL, environment=DUSK), max_depth=24)
    cameras = camera_at((2, 1, 1), fov_x=0.7, size=16)
    low = render_view(renderer, cameras, 0, spp=8, view_seed=0, ceiling_db=None)
    high = render_view(renderer, cameras, 0, spp=8, view_seed=0, ceiling_db=50)
    assert -10 * math.log10(low.noise_mse) < 50 <= -10 * math.log10(high.noise_mse)
    assert high.spp > low.spp


@pytest.mark.promise("R8")
def test_a_picture_repeats_to_the_last_bit_however_many_threads_share_its_pixels() -> None:
    """At this size threads meet within pixels; Mitsuba's own film then differs from run to run."""
    import drjit as dr

    from datagen.machine.processes import num_cores

    renderer = Renderer(scene_of(BALL, FLOOR, environment=DUSK), max_depth=16)
    cameras = camera_at((2, 1, 1), fov_x=0.7, size=96)
    pictures = []
    for threads in (2, 2, 3, 5):
        dr.set_thread_count(threads)
        pictures.append(renderer.radiance(cameras, 0, spp=144, seed=3))
    dr.set_thread_count(max(2, num_cores()))
    assert all(np.array_equal(pictures[0], other) for other in pictures[1:])


@pytest.mark.promise("R10")
def test_radiance_that_is_no_number_stops_the_view(monkeypatch: pytest.MonkeyPatch) -> None:
    pane = SceneObject(name="pane", mesh=quad(0.0), material=Diffuse(color=(0.5, 0.4, 0.3)))
    renderer = Renderer(scene_of(pane), max_depth=8)
    bad = np.ones((16, 16, 3), np.float32)
    bad[3, 5] = np.nan
    monkeypatch.setattr(renderer, "radiance", lambda cameras, view, spp, seed: bad)
    with pytest.raises(HyalineError, match=r"pixel \(column 5, row 3\): radiance is not finite"):
        render_view(renderer, camera_at((2, 1, 1), fov_x=0.7, size=16), 0, spp=18, view_seed=0, ceiling_db=None)
