"""Tests the rasteriser against Mitsuba's tracer, brute force in float64, and counting arguments."""

import dataclasses
import math

import numba
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from support.meshes import mesh_of, random_meshes
from support.reference import brute_force_hits
from support.rigs import config
from support.synthetic import pixel_rays, quad, synthetic_scene, trace

from datagen.data.cameras import Cameras, look_at
from datagen.data.layers import Layers
from datagen.data.meshes import Mesh, no_mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.builtin import make_scene
from datagen.scene.rig import make_cameras
from datagen.trace.raster import Rasterizer

use_mitsuba(quiet=True)

from datagen.trace.peel import Peeler  # noqa: E402


def camera(position: object, target: object, width: int = 48, height: int = 48, fov_deg: float = 50) -> Cameras:
    pose = look_at(np.array(position, np.float64), np.array(target, np.float64))
    return Cameras(world_from_camera=pose[None], fov_x=math.radians(fov_deg), width=width, height=height)


def random_camera(rng: np.random.Generator, width: int = 48, height: int = 48) -> Cameras:
    """Anywhere around or within a heap of the size of 2, looking at it."""
    way = rng.normal(size=3)
    return camera(way / np.linalg.norm(way) * rng.uniform(0.2, 4), rng.uniform(-0.3, 0.3, 3), width, height)


def differing_pixels(one: Layers, other: Layers) -> np.ndarray:
    """Pixels (pixel, 2), row and column, whose objects, uv or depth differ by more than float32 rounds."""
    same = (one.object_id == other.object_id).all(axis=0)
    same &= (np.abs(one.depth - other.depth) <= 1e-4 * (1 + other.depth)).all(axis=0)
    return np.argwhere(~same)


def is_general(meshes: tuple[Mesh, ...], cameras: Cameras, row: int, column: int) -> bool:
    """Every engine must agree about this pixel: by brute force, nothing is near an edge or at one distance."""
    origin, directions = cameras[0].rays()
    there = tuple(mesh for mesh in meshes if len(mesh.faces))
    ray = directions[row, column].astype(np.float64)[None]
    return brute_force_hits(there, origin.astype(np.float64)[None], ray)[0].is_general


def assert_peels_like_mitsuba(meshes: tuple[Mesh, ...], cameras: Cameras, num_layers: int) -> Layers:
    """Same objects, distances, and share of rays with more, but where rays graze an edge; returns the layers."""
    mine, my_share = Rasterizer(meshes).peel(cameras, 0, num_layers)
    theirs, their_share = Peeler(meshes).peel(cameras, 0, num_layers)
    different = differing_pixels(mine, theirs)
    assert len(different) < 5
    assert not [pixel for pixel in different if is_general(meshes, cameras, *pixel)]
    assert abs(my_share - their_share) <= len(different) / mine.object_id[0].size
    same = mine.object_id == theirs.object_id
    assert np.quantile(np.abs(mine.uv.astype(int) - theirs.uv)[same], 0.99) <= 2
    return mine


@pytest.mark.parametrize("seed", range(10))
def test_random_scenes_rasterise_like_mitsuba_traces(seed: int) -> None:
    rng = np.random.default_rng(seed)
    meshes = random_meshes(rng, 9)
    assert_peels_like_mitsuba(meshes, random_camera(rng), 8)


@pytest.mark.parametrize("name", ["vitrine", "drinks"])
def test_the_built_in_scenes_rasterise_like_mitsuba_traces(name: str) -> None:
    scene = make_scene(name)
    cameras = make_cameras(scene.cameras, config(views=4))
    for split in ("train", "extrapolating"):
        one = dataclasses.replace(cameras[split], world_from_camera=cameras[split].world_from_camera[1:2])
        assert_peels_like_mitsuba(tuple(item.mesh for item in scene.objects), one, 8)


@pytest.mark.parametrize(("width", "height"), [(61, 33), (16, 90), (1, 1), (257, 3)])
def test_pictures_need_not_be_square_nor_fill_whole_strips(width: int, height: int) -> None:
    rng = np.random.default_rng(width)
    layers = assert_peels_like_mitsuba(random_meshes(rng, 6), random_camera(rng, width, height), 5)
    assert layers.object_id.shape == (5, height, width)


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_inside_a_room_sees_all_its_walls(seed: int) -> None:
    rng = np.random.default_rng(seed)
    room = mesh_of(trimesh.creation.box((4, 5, 3)), seed=1)
    meshes = (*random_meshes(rng, 5), room)
    cameras = camera(rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3), 40, 30, fov_deg=rng.uniform(40, 150))
    layers = assert_peels_like_mitsuba(meshes, cameras, 12)
    # The room is the last surface of every ray, and seen once.
    assert ((layers.object_id == 6).sum(axis=0) == 1).all()
    assert (np.where(layers.object_id > 0, layers.object_id, 0).max(axis=0) == 6).all()


def test_what_lies_behind_the_camera_is_not_seen() -> None:
    meshes = random_meshes(np.random.default_rng(0), 6)
    layers, share = Rasterizer(meshes).peel(camera((9, 0, 0), (20, 0.1, 0)), 0, 4)
    assert not layers.object_id.any()
    assert not layers.depth.any()
    assert not layers.uv.any()
    assert share == 0


def test_removed_meshes_leave_their_ids_unused() -> None:
    rng = np.random.default_rng(3)
    first, second, third = random_meshes(rng, 3)
    layers = assert_peels_like_mitsuba((no_mesh(), first, no_mesh(), second, third), random_camera(rng), 6)
    assert set(np.unique(layers.object_id)) == {0, 2, 4, 5}


def test_fewer_layers_are_the_first_ones_and_rays_with_more_are_marked() -> None:
    rng = np.random.default_rng(4)
    rasterizer, cameras = Rasterizer(random_meshes(rng, 9)), random_camera(rng)
    many, none_left = rasterizer.rasterize(cameras, 0, 24)
    few, has_more = rasterizer.rasterize(cameras, 0, 3)
    assert not none_left.any()
    assert np.array_equal(has_more, many.object_id[3] > 0)
    assert has_more.any()
    for name in ("uv", "object_id", "depth"):
        assert np.array_equal(getattr(few, name), getattr(many, name)[:3])


def test_every_pixel_of_closed_meshes_has_an_even_number_of_hits_of_each() -> None:
    rng = np.random.default_rng(5)
    meshes = random_meshes(rng, 8)
    rasterizer = Rasterizer(meshes)
    for _ in range(10):
        way = rng.normal(size=3)
        cameras = camera(4 * way / np.linalg.norm(way), rng.uniform(-0.3, 0.3, 3), 128, 128)
        layers, has_more = rasterizer.rasterize(cameras, 0, 40)
        assert not has_more.any()
        counts = np.stack([(layers.object_id == index + 1).sum(axis=0) for index in range(len(meshes))])
        assert (counts % 2 == 0).all()


def front_camera(size: int) -> Cameras:
    """At (0, 0, 2), looking down with no rotation, so that rays and vertices meet exactly."""
    pose = np.eye(4)
    pose[2, 3] = 2.0
    return Cameras(world_from_camera=pose[None], fov_x=2 * math.atan(0.5), width=size, height=size)


@pytest.mark.parametrize("size", [32, 33])
def test_rays_exactly_through_edges_and_corners_hit_a_closed_mesh_twice_or_not_at_all(size: int) -> None:
    # A box of 8 x 8 squares a side: pixel centres fall on edges, diagonals and corners, on the silhouette too.
    lines = np.linspace(-0.5, 0.5, 9)
    box = trimesh.creation.box((1, 1, 1))
    for _ in range(3):
        box = box.subdivide()
    assert set(np.unique(box.vertices)) <= set(lines)
    layers, _ = Rasterizer((mesh_of(box, seed=0),)).peel(front_camera(size), 0, 12)
    counts = (layers.object_id > 0).sum(axis=0)
    assert set(np.unique(counts)) <= {0, 2}
    assert (counts == 2).sum() > 0.2 * size**2


def test_a_pole_on_a_pixels_centre_is_hit_once_on_either_side() -> None:
    ball = trimesh.creation.uv_sphere(0.5, count=(12, 12))
    ball.vertices[np.abs(ball.vertices) < 1e-9] = 0  # Or its poles would be twelve points each.
    layers, _ = Rasterizer((mesh_of(ball, seed=0),)).peel(front_camera(9), 0, 8)
    assert (layers.object_id[:, 4, 4] > 0).sum() == 2
    assert ((layers.object_id > 0).sum(axis=0) % 2 == 0).all()


def test_pane_and_floor_rasterise_like_the_closed_formula() -> None:
    cameras = make_cameras(synthetic_scene().cameras, config(views=4))["train"]
    layers, _ = Rasterizer((quad(0.5), quad(0.0))).peel(cameras, 2, 4)
    expected = trace(*pixel_rays(cameras, 2), 4)
    assert np.array_equal(layers.object_id, expected.object_id)
    # Tighter than Mitsuba's float32: one step of 65,535.
    assert np.abs(layers.uv.astype(int) - expected.uv).max() <= 1
    assert np.abs(layers.depth - expected.depth).max() < 2e-6


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.floats(1e-5, 1e-2), st.floats(1.0, 20.0))
def test_surfaces_very_close_together_keep_both_layers(gap: float, distance: float) -> None:
    cameras = dataclasses.replace(front_camera(5), fov_x=0.05)
    cameras.world_from_camera[0, 2, 3] = distance
    layers, _ = Rasterizer((quad(0.0), quad(-gap))).peel(cameras, 0, 4)
    assert (layers.object_id == np.array([1, 2, 0, 0])[:, None, None]).all()


def test_the_bytes_do_not_depend_on_the_number_of_threads() -> None:
    rng = np.random.default_rng(6)
    # Coincident surfaces too: copies of one mesh.
    meshes = random_meshes(rng, 8)
    rasterizer, cameras = Rasterizer((*meshes, *meshes)), random_camera(rng, 100, 100)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in {1, before}:
            numba.set_num_threads(threads)
            results.append(rasterizer.rasterize(cameras, 0, 6))
    finally:
        numba.set_num_threads(before)
    for layers, has_more in results[1:]:
        assert np.array_equal(has_more, results[0][1])
        for name in ("uv", "object_id", "depth"):
            assert np.array_equal(getattr(layers, name), getattr(results[0][0], name))


def test_no_object_at_all_is_an_empty_view() -> None:
    layers, share = Rasterizer((no_mesh(),)).peel(front_camera(4), 0, 2)
    assert not layers.object_id.any()
    assert share == 0
