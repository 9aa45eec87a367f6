"""Tests light paths against closed formulas and against Mitsuba's own path tracer."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
from support.meshes import box, mesh_of
from support.reference import fresnel_reflectance
from support.scenes import DUSK, seen_along
from support.synthetic import quad

from datagen.data.meshes import Mesh, mesh_from
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.mitsuba_scene import radiance_of_environment
from datagen.scene.description import SceneObject
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Material, Plastic, RoughDielectric, ThinDielectric
from datagen.trace.branch_outputs import FirstVertices
from datagen.trace.light_path import LightPathTracer, TracedPaths
from datagen.trace.surface_tables import Limits

use_mitsuba()

GREY = Diffuse(color=(0.5, 0.5, 0.5))


def wide(z: float) -> Mesh:
    """A horizontal square of 40 m, so that slanted rays land on it."""
    mesh = quad(z)
    return Mesh(vertices=mesh.vertices * np.float32([20, 20, 1]), faces=mesh.faces, normals=mesh.normals, uv=mesh.uv)


def traced(
    *objects: tuple[Mesh, Material],
    origins: object,
    directions: object,
    max_branches: int = 2,
    seed: int = 0,
    **limits: int,
) -> TracedPaths:
    directions = np.atleast_2d(np.asarray(directions, np.float64))
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(np.asarray(origins, np.float64), directions.shape)
    meshes, materials = zip(*objects, strict=True)
    return LightPathTracer(meshes, materials).trace(
        origins.astype(np.float32), directions.astype(np.float32), Limits(max_branches, **limits), seed=seed
    )


@pytest.mark.parametrize("ior", [1.1, 1.5, 2.4])
@pytest.mark.parametrize("angle_deg", [0.0, 10.0, 35.0, 60.0, 80.0])
def test_a_slab_shifts_and_dims_a_ray_as_snell_fresnel_and_beer_say(ior: float, angle_deg: float) -> None:
    thickness, absorption = 0.3, np.array([1.0, 2.0, 3.0])
    slab = mesh_of(trimesh.creation.box((30, 30, thickness)))
    glass = Dielectric(ior=ior, absorption=tuple(absorption))
    slab = box((30, 30, thickness))
    angle = math.radians(angle_deg)
    direction = (math.sin(angle), 0, -math.cos(angle))
    paths = traced((slab, glass), (wide(-0.9), GREY), origins=(0, 0.1, 1), directions=direction)
    assert paths.object_id[0, :, 0].tolist() == [1, 1, 2, 0, 0, 0, 0, 0]
    inside = math.asin(math.sin(angle) / ior)
    expected_x = math.tan(angle) * (1.9 - thickness) + math.tan(inside) * thickness
    assert paths.position[0, 2, 0, 0] == pytest.approx(expected_x, abs=2e-4)
    assert paths.direction[0, 2, 0] == pytest.approx(direction, abs=1e-5)  # Parallel to what came in.
    assert paths.direction[0, 1, 0] == pytest.approx((math.sin(inside), 0, -math.cos(inside)), abs=1e-5)
    length = thickness / math.cos(inside)
    assert np.linalg.norm(paths.position[0, 1, 0] - paths.position[0, 0, 0]) == pytest.approx(length, abs=5e-5)
    r = fresnel_reflectance(math.cos(angle), ior)
    assert paths.throughput[0, 2, 0] == pytest.approx((1 - r) ** 2 * np.exp(-absorption * length), rel=1e-3)
    # The mirror branch takes what the refracted one does not: together they make one.
    assert paths.has_left[1, 0]
    assert paths.end_throughput[1, 0] == pytest.approx([r] * 3, rel=1e-3)
    assert paths.end_direction[1, 0] == pytest.approx((direction[0], 0, -direction[2]), abs=1e-5)
    unscaled = paths.throughput[0, 1, 0] * np.exp(absorption * length) * ior**2
    assert unscaled + paths.end_throughput[1, 0] == pytest.approx([1.0] * 3, rel=1e-3)


def test_beyond_the_critical_angle_light_stays_inside() -> None:
    # Into the top of a cube, out of its side: beyond 41.8 degrees (ior 1.5) the side reflects totally.
    cube = box((2, 2, 2))
    for angle_deg, leaves_at_side in ((85.0, False), (30.0, False)):
        angle = math.radians(angle_deg)
        start = np.array([0.9, 0.0, 1.0]) - 0.1 * np.array([math.sin(angle), 0, -math.cos(angle)])
        paths = traced((cube, Dielectric(ior=1.5)), origins=start, directions=(math.sin(angle), 0, -math.cos(angle)))
        inside = math.asin(math.sin(angle) / 1.5)
        side_angle = math.pi / 2 - inside
        assert (math.sin(side_angle) * 1.5 < 1) == leaves_at_side
        assert paths.direction[0, 2, 0] == pytest.approx((-math.sin(inside), 0, -math.cos(inside)), abs=1e-5)
        assert paths.throughput[0, 2, 0] == pytest.approx(paths.throughput[0, 1, 0], rel=1e-5)  # Nothing was lost.
    cube_low = traced((cube, Dielectric(ior=1.2)), origins=(0.5, 0, 1.01), directions=(0.99, 0, -0.1))
    inside = math.asin(0.99 / math.hypot(0.99, 0.1) / 1.2)
    assert math.sin(math.pi / 2 - inside) * 1.2 < 1
    assert cube_low.has_left[0, 0]  # Below the critical angle it leaves at the side.
    assert cube_low.object_id[0, :3, 0].tolist() == [1, 1, 0]


def test_a_weak_lens_focuses_where_the_lens_maker_says() -> None:
    # A biconvex lens cut from two balls of radius R: 1/f = (n - 1) (2/R - (n - 1) d / (n R^2)).
    radius, thickness, ior = 4.0, 0.08, 1.5
    rim = math.sqrt(radius**2 - (radius - thickness / 2) ** 2)
    heights = np.linspace(0, rim * 0.999, 200)
    sag = np.sqrt(radius**2 - heights**2) - (radius - thickness / 2)
    profile = np.concatenate([np.stack([heights, -sag], 1), np.stack([heights, sag], 1)[::-1]])
    lens = trimesh.creation.revolve(profile, sections=400)
    lens.fix_normals()
    vertices = np.asarray(lens.vertices)
    up = np.where(vertices[:, 2] >= 0, 1.0, -1.0)
    centers = np.stack([0 * up, 0 * up, -up * (radius - thickness / 2)], axis=1)
    normals = vertices - centers
    mesh = mesh_from(vertices, lens.faces, normals / np.linalg.norm(normals, axis=1, keepdims=True))
    focal = 1 / ((ior - 1) * (2 / radius - (ior - 1) * thickness / (ior * radius**2)))
    offsets = np.array([0.05, 0.1, 0.15])
    origins = np.stack([offsets, 0.3 * offsets, np.full(3, 1.0)], axis=1)
    paths = traced(
        (mesh, Dielectric(ior=ior)), (wide(-9.0), GREY), origins=origins, directions=np.tile([0.0, 0, -1], (3, 1))
    )
    p, d = paths.position[0, 1].astype(float), paths.direction[0, 2].astype(float)
    t = -(p[:, 0] * d[:, 0] + p[:, 1] * d[:, 1]) / (d[:, 0] ** 2 + d[:, 1] ** 2)
    crossing = -(p[:, 2] + t * d[:, 2])
    assert crossing == pytest.approx([focal] * 3, rel=0.02)


def test_nothing_is_tinted_that_is_mirrored_beyond_the_critical_angle_or_between_overlapping_parts() -> None:
    tint = (1.0, 0.5, 0.25)
    inside = traced((quad(0.0), Dielectric(ior=1.5, tint=tint)), origins=(0, 0, -1), directions=(1.2, 0, 1))
    assert inside.end_throughput[0, 0] == pytest.approx([1.0] * 3)
    above = box((3, 3, 0.5))
    slabs = (box((4, 4, 0.5)), dataclasses.replace(above, vertices=above.vertices + np.float32([0, 0, 0.3])))
    glass = Dielectric(ior=1.5, tint=tint)
    for material in (glass, RoughDielectric(**vars(glass), roughness=0.001)):
        paths = traced(*((slab, material) for slab in slabs), origins=(0, 0, 2), directions=(0, 0, -1))
        assert paths.end_throughput[0, 0] == pytest.approx(0.96**2 * np.array(glass.tint) ** 2, rel=2e-3)


def test_thin_panes_tint_and_do_not_bend_and_metals_mirror_with_their_colour() -> None:
    gold = Conductor(color=(1.0, 0.8, 0.3), roughness=0.0)
    pane = ThinDielectric(ior=1.5, tint=(1.0, 0.5, 0.25))
    paths = traced((quad(0.5), pane), (wide(0), gold), origins=(0, 0, 2), directions=(0.2, 0.1, -1))
    r = fresnel_reflectance(1 / math.hypot(0.2, 0.1, 1), 1.5)
    assert paths.direction[0, 1, 0] == pytest.approx(paths.direction[0, 0, 0], abs=1e-6)
    assert paths.throughput[0, 1, 0] == pytest.approx((1 - 2 * r / (1 + r)) * np.array(pane.tint), rel=1e-3)
    assert paths.end_throughput[1, 0] == pytest.approx([2 * r / (1 + r)] * 3, rel=1e-3)
    bare = traced((wide(0), gold), origins=(0, 0, 2), directions=(0.2, 0.1, -1))
    assert bare.end_throughput[1, 0] == pytest.approx(gold.color, rel=1e-5)
    assert not bare.has_left[0, 0]
    coated = traced((wide(0), Plastic(color=(0.5, 0.5, 0.5), ior=1.5)), origins=(0, 0, 2), directions=(0, 0.0, -1))
    assert coated.end_throughput[1, 0] == pytest.approx([0.04] * 3, rel=2e-3)
    matte = traced((wide(0), GREY), origins=(0, 0, 2), directions=(0, 0.0, -1))
    assert not matte.has_left.any()
    assert not matte.object_id[1].any()


def test_a_path_longer_than_its_places_keeps_its_end_and_one_too_deep_says_nothing_of_it() -> None:
    panes = [(quad(0.1 * index), ThinDielectric(ior=1.5)) for index in range(6)]
    wall = (wide(-1.0), GREY)
    long = traced(*panes, wall, origins=(0, 0, 2), directions=(0, 0, -1), max_vertices=4)
    assert long.object_id[0, :, 0].tolist() == [6, 5, 4, 7]
    assert long.position[0, 3, 0] == pytest.approx((0, 0, -1), abs=1e-6)
    r = 2 * 0.04 / 1.04
    assert long.throughput[0, 3, 0] == pytest.approx([(1 - r) ** 6] * 3, rel=1e-3)
    deep = traced(*panes, wall, origins=(0, 0, 2), directions=(0, 0, -1), max_vertices=4, max_depth=5)
    assert deep.object_id[0, 3, 0] == 2
    assert not deep.has_left[0, 0]
    assert (deep.end_throughput[0, 0] == 0).all()


@pytest.mark.parametrize("slope", [0.3, 2.0])
def test_a_rough_metal_mirrors_as_much_of_the_sky_as_in_mitsuba(slope: float) -> None:
    gold = Conductor(color=(1.0, 0.8, 0.3), roughness=0.3)
    direction = np.array([1.0, 0.0, -slope]) / math.hypot(1, slope)
    floor = SceneObject(name="floor", mesh=wide(0), material=gold)
    truth = seen_along(direction, floor, environment=DUSK, spp=8192)
    rays = np.tile(direction, (4096, 1))
    paths = traced((wide(0), gold), origins=-3 * direction, directions=rays)
    sky = radiance_of_environment(DUSK, paths.end_direction[1].astype(np.float64))
    assert (paths.end_throughput[1] * sky).mean(axis=0) == pytest.approx(truth, rel=0.01)
    again = traced((wide(0), gold), origins=-3 * direction, directions=rays, seed=1)
    assert (again.end_throughput[1] * sky).mean(axis=0) != pytest.approx(truth, rel=1e-6)
    # Each sixteen rays, as many as a pixel has, are a fair share of the facets.
    parts = (paths.end_throughput[1] * sky).reshape(-1, 16, 3).mean(axis=1)
    assert parts.std(axis=0) == pytest.approx(0, abs=0.05)


def test_water_and_the_glass_around_it_share_one_surface() -> None:
    outer, inner = (trimesh.creation.icosphere(5, radius) for radius in (0.5, 0.44))
    inner.invert()
    shell, water = mesh_of(outer + inner), mesh_of(trimesh.creation.icosphere(5, 0.45))
    glass, drink = (
        Dielectric(ior=1.5, absorption=(1.0, 2.0, 0.0), priority=1),
        Dielectric(ior=1.33, absorption=(0.0, 1.0, 3.0)),
    )
    # Not through a vertex of the spheres, whose faces are flat: hence the tolerances.
    direction = np.array([-0.9998, 0.0012, 0.0007])
    paths = traced((shell, glass), (water, drink), origins=-2 * direction, directions=direction, max_branches=1)
    assert paths.object_id[0, :, 0].tolist() == [1, 1, 1, 1, 0, 0, 0, 0]
    segments = np.linalg.norm(np.diff(paths.position[0, :4, 0], axis=0), axis=1)
    assert segments == pytest.approx([0.06, 0.88, 0.06], abs=2e-3)
    air_glass, glass_water = ((a - b) ** 2 / (a + b) ** 2 for a, b in ((1.5, 1.0), (1.5, 1.33)))
    dimmed = np.exp(-0.12 * np.array(glass.absorption) - 0.88 * np.array(drink.absorption))
    expected = (1 - air_glass) ** 2 * (1 - glass_water) ** 2 * dimmed
    assert paths.end_throughput[0, 0] == pytest.approx(expected, rel=5e-3)
    assert paths.end_direction[0, 0] == pytest.approx(direction, abs=2e-3)


def test_branches_come_by_their_throughput_after_the_first_mirror() -> None:
    panes = [(quad(0.1 * index), ThinDielectric(ior=1.2 + 0.1 * index)) for index in range(5)]
    paths = traced(*panes, origins=(0, 0, 2), directions=(0.0, 0.001, -1), max_branches=5)
    start = paths.end_throughput[:, 0, 0]
    assert paths.has_left[:, 0].all()
    assert paths.object_id[1, 0, 0] == 0  # From the first pane straight into the open.
    r = [((0.2 + 0.1 * index) / (2.2 + 0.1 * index)) ** 2 for index in range(5)]
    assert start[0] == pytest.approx(np.prod([(1 - x) / (1 + x) for x in r]), rel=1e-3)
    assert paths.object_id[2, 0, 0] == 5  # Mirrored at the second pane, back through the first.


@pytest.mark.parametrize("height", [1.0, -1.0])
def test_uv_slopes_lead_to_where_the_ray_meets_a_deeper_surface(height: float) -> None:
    """From above the deeper one comes later; out of what lies below the surface it comes before."""
    depth = 1e-2
    rng = np.random.default_rng(0)
    directions = np.c_[rng.uniform(-2, 2, (200, 2)), np.full(200, -height)]
    surface, deeper = (
        traced((wide(z), None), origins=(0.3, -0.2, height), directions=directions, max_branches=1)
        for z in (0.0, -depth)
    )
    expected = deeper.uv[0, 0] - surface.uv[0, 0]
    assert np.abs(expected).max() > 2e-4
    assert np.abs(depth * surface.uv_slope[0, 0] - expected).max() < 2e-6


def test_ends_and_first_vertices_are_those_of_whole_paths() -> None:
    """Of a glass ball, a pane and rough metal above a coated floor, in a kernel of their own."""
    ball, lump = (mesh_of(trimesh.creation.icosphere(3, 0.5).apply_translation((x, 0, 0.6))) for x in (0, 1.2))
    meshes = ball, lump, quad(1.5), quad(0.0)
    metal, floor = Conductor(color=(0.9, 0.8, 0.7), roughness=0.2), Plastic(color=(0.5, 0.4, 0.3))
    materials = Dielectric(ior=1.5), metal, ThinDielectric(ior=1.5), floor
    tracer = LightPathTracer(meshes, materials)
    rng = np.random.default_rng(1)
    origins = np.tile(np.float32([0.5, -2.5, 1.2]), (600, 1))
    directions = rng.uniform((-0.6, 0.6, -0.6), (0.6, 1, 0.4), (600, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    facets = rng.random((600, 2)).astype(np.float32)
    given = {"seed": 3, "facets": facets}
    found = tracer.trace_ends(origins, directions, Limits(6), stacked=(4, 2), has_details=True, **given)
    last = tracer.trace(origins, directions, Limits(6, max_vertices=1), **given)
    first = tracer.trace(origins, directions, Limits(6), **given)

    ray, branch = np.nonzero((np.isin(last.object_id[:, 0], (2, 4)) & ~last.has_left).T)
    place = branch, 0, ray
    assert np.array_equal(found.ray, ray) and len(ray) > 150
    cosine = -np.einsum("ec,ec->e", last.direction[place], last.normal[place])
    mirrored = last.direction[place] + 2 * cosine[:, None] * last.normal[place]
    assert np.array_equal(found.object_id, last.object_id[place])
    for name in ("uv", "throughput", "position", "uv_slope"):
        np.testing.assert_allclose(getattr(found, name), getattr(last, name)[place], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.cosine, cosine.clip(0, 1), atol=1e-5)
    np.testing.assert_allclose(found.reflected, mirrored, atol=1e-5)

    ray, branch = np.nonzero(last.has_left.T)
    assert np.array_equal(found.exit_ray, ray) and len(ray) > 150
    np.testing.assert_allclose(found.exit_direction, last.end_direction[branch, ray], atol=1e-5)
    np.testing.assert_allclose(found.exit_throughput, last.end_throughput[branch, ray], atol=1e-5)

    assert found.stack is not None
    for values in [*vars(found).values(), *vars(found.stack).values()]:
        while isinstance(values, np.ndarray) and values.base is not None:
            values = values.base
        assert isinstance(values, np.ndarray | FirstVertices), "Dr.Jit's memory, which only its thread may free"
    places = [(branch, vertex) for branch, number in enumerate((4, 2)) for vertex in range(number)]
    for slot, place in enumerate(places):
        is_there = first.object_id[place] > 0
        assert np.array_equal(found.stack.object_id[:, slot], first.object_id[place])
        np.testing.assert_allclose(found.stack.uv[is_there, slot], first.uv[place][is_there], atol=1e-5)
        np.testing.assert_allclose(found.stack.throughput[:, slot], first.throughput[place].mean(axis=-1), atol=1e-5)
        cosine = -np.einsum("rc,rc->r", first.direction[place], first.normal[place]).clip(-1, 0)
        np.testing.assert_allclose(found.stack.cosine[:, slot], cosine, atol=1e-5)


def test_a_changed_tracer_traces_as_a_fresh_one_does() -> None:
    def slab(thickness: float) -> Mesh:
        return mesh_of(trimesh.creation.box((3, 3, thickness)))

    floor = wide(-1.0)
    thin, thick = (slab(0.1), Dielectric(ior=1.5)), (slab(0.3), Dielectric(ior=1.7, absorption=(1.0, 2.0, 3.0)))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3)) * [0.5, 0.5, 0.1] - [0, 0, 1]
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    origins = np.broadcast_to(np.float32([0, 0, 1]), directions.shape)
    limits = Limits(4, max_vertices=2)
    tracer = LightPathTracer((floor, thin[0]), (GREY, thin[1]))
    before = tracer.trace(origins, directions, limits)
    tracer.change({1: thick})
    after = tracer.trace(origins, directions, limits)
    fresh = LightPathTracer((floor, thick[0]), (GREY, thick[1])).trace(origins, directions, limits)
    assert not np.array_equal(before.throughput, after.throughput)
    for field in dataclasses.fields(TracedPaths):
        assert np.array_equal(getattr(after, field.name), getattr(fresh, field.name)), field.name
    tracer.change({1: thin})
    again = tracer.trace(origins, directions, limits)
    assert np.array_equal(again.throughput, before.throughput)
    assert np.array_equal(again.position, before.position)
