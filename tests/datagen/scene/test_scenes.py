import dataclasses
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from support.meshes import chart_map
from support.reference import winding_numbers

from datagen.data.meshes import Mesh, component_of_faces, face_areas, face_corners, open_edges, signed_volume
from datagen.disk.errors import HyalineError
from datagen.scene.atlas import coverage
from datagen.scene.builtin import SCENES, make_scene
from datagen.scene.description import Scene, SceneObject
from datagen.scene.folder import load_scene, save_scene, scene_files
from datagen.scene.soundness import check_scene

GAP = 0.0005
"""Metres that any two objects must keep between them."""

_made: dict[str, Scene] = {}


@pytest.fixture(params=SCENES)
def scene(request: pytest.FixtureRequest) -> Scene:
    """Each built-in scene, made once a session."""
    if request.param not in _made:
        _made[request.param] = make_scene(request.param)
    return _made[request.param]


def test_scene_is_valid_and_within_its_budget(scene: Scene) -> None:
    check_scene(scene)
    assert 30_000 <= sum(len(item.mesh.faces) for item in scene.objects) <= 120_000
    assert all(item.name == item.name.lower() for item in scene.objects)
    assert any(item.material.is_glass for item in scene.objects)


def test_every_piece_of_solid_glass_is_closed_and_outward(scene: Scene) -> None:
    for item in scene.objects:
        if item.material.medium is not None:
            assert open_edges(item.mesh) == 0, item.name
            assert signed_volume(item.mesh) > 0, item.name
            assert component_of_faces(item.mesh).max() == 0, item.name


def test_shading_normals_stand_on_the_side_that_faces_show(scene: Scene) -> None:
    for item in scene.objects:
        a, b, c = np.moveaxis(face_corners(item.mesh).astype(np.float64), 1, 0)
        flat = np.cross(b - a, c - a)
        flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
        cosines = np.einsum("fi,fki->fk", flat, item.mesh.normals[item.mesh.faces])
        assert cosines.min() > 0.3, (item.name, cosines.min())
        if item.material.is_glass:
            assert cosines.min() > 0.7, (item.name, cosines.min())


def test_atlases_do_not_overlap(scene: Scene) -> None:
    for item in scene.objects:
        counts = coverage(item.mesh, 512)
        assert counts.max() == 1, (item.name, int((counts > 1).sum()))
        assert (counts > 0).mean() > 0.12, item.name


def test_every_face_has_texels_that_are_about_square(scene: Scene) -> None:
    for item in scene.objects:
        corners = face_corners(item.mesh).astype(np.float64)
        uv = item.mesh.uv[item.mesh.faces].astype(np.float64)
        edges, uv_edges = (np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) for x in (corners, uv))
        assert np.abs(np.linalg.det(uv_edges)).min() > 1e-12, item.name
        stretch = np.linalg.svd(edges @ np.linalg.inv(uv_edges), compute_uv=False)
        ratio, areas = stretch[:, 0] / stretch[:, 1], face_areas(item.mesh)
        assert areas[ratio < 2].sum() > 0.5 * areas.sum(), item.name


def test_charts_keep_a_gutter_at_512(scene: Scene) -> None:
    for item in scene.objects:
        charts = chart_map(item.mesh, 512)
        for one, other in (
            (charts[1:], charts[:-1]),
            (charts[:, 1:], charts[:, :-1]),
            (charts[1:, 1:], charts[:-1, :-1]),
            (charts[1:, :-1], charts[:-1, 1:]),
        ):
            assert not ((one >= 0) & (other >= 0) & (one != other)).any(), item.name


def test_no_two_faces_of_an_object_coincide(scene: Scene) -> None:
    for item in scene.objects:
        middles = np.rint(face_corners(item.mesh).astype(np.float64).mean(axis=1) * 1e6).astype(np.int64)
        assert len(np.unique(middles, axis=0)) == len(middles), item.name


def test_nothing_touches_anything_but_drinks_and_ice(scene: Scene) -> None:
    for one, other in combinations(scene.objects, 2):
        if priority(one) != priority(other) or min(priority(one), priority(other)) < 0:
            continue  # They may overlap: a drink its glass and its straw, ice its drink.
        near = min(distance_below(one.mesh, other.mesh, GAP), distance_below(other.mesh, one.mesh, GAP))
        assert near >= GAP, f"{one.name} and {other.name}: {1000 * near:.3f} mm"


def priority(item: SceneObject) -> int:
    return item.material.medium.priority if item.material.medium is not None else 0


def distance_below(points_of: Mesh, surface_of: Mesh, limit: float) -> float:
    """Distance from one surface's vertices, edge middles and random points to the other's faces, if below `limit`."""
    low, high = surface_of.vertices.min(axis=0) - limit, surface_of.vertices.max(axis=0) + limit
    if (points_of.vertices.max(axis=0) < low).any() or (points_of.vertices.min(axis=0) > high).any():
        return np.inf
    points = surface_points(points_of)
    points = points[((points >= low) & (points <= high)).all(axis=-1)]
    corners = face_corners(surface_of).astype(np.float64)
    if len(points) == 0:
        return np.inf
    low, high = points.min(axis=0) - limit, points.max(axis=0) + limit
    corners = corners[((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=-1)]
    if len(corners) == 0:
        return np.inf
    from scipy.spatial import cKDTree

    # Candidates: faces whose bounding ball a point is in. Faces are grouped by size, so that small ones stay cheap.
    middle = corners.mean(axis=1)
    radius = np.linalg.norm(corners - middle[:, None], axis=-1).max(axis=1) + limit
    tree, nearest = cKDTree(points), np.inf
    for start in range(0, len(corners), 4096):
        part = slice(start, start + 4096)
        found = tree.query_ball_point(middle[part], radius[part])
        counts = np.array([len(indices) for indices in found])
        if counts.sum() == 0:
            continue
        chosen = np.concatenate([np.asarray(indices, np.int64) for indices in found])
        face = np.repeat(np.arange(len(counts)), counts)
        nearest = min(nearest, float(point_triangle_distance(points[chosen], corners[part][face]).min()))
    return nearest


def surface_points(mesh: Mesh, count: int = 4000) -> np.ndarray:
    corners = face_corners(mesh).astype(np.float64)
    rng = np.random.default_rng(0)
    areas = face_areas(mesh)
    face = rng.choice(len(corners), size=count, p=areas / areas.sum())
    weights = rng.dirichlet([1, 1, 1], size=count)
    middles = (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2
    return np.concatenate([mesh.vertices, middles, np.einsum("pk,pkc->pc", weights, corners[face])])


def point_triangle_distance(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Exact distance from points (n, 3) to their triangles (n, 3, 3): to the plane if above it, else to an edge."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    distance = np.full(len(p), np.inf)
    is_above = np.ones(len(p), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        t = np.clip(np.einsum("ni,ni->n", p - start, edge) / np.einsum("ni,ni->n", edge, edge), 0, 1)
        distance = np.minimum(distance, np.linalg.norm(p - start - t[:, None] * edge, axis=-1))
        is_above &= np.einsum("ni,ni->n", np.cross(normal, edge), p - start) >= 0
    return np.where(is_above, np.abs(np.einsum("ni,ni->n", p - a, normal)), distance)


def test_point_triangle_distance_is_that_of_a_dense_sample() -> None:
    rng = np.random.default_rng(1)
    corners, p = rng.normal(size=(20, 3, 3)), rng.normal(size=(20, 3))
    weights = rng.dirichlet([0.5, 0.5, 0.5], size=20_000)
    sampled = np.linalg.norm(np.einsum("wk,nkc->nwc", weights, corners) - p[:, None], axis=-1).min(axis=1)
    exact = point_triangle_distance(p, corners)
    assert (exact <= sampled + 1e-9).all()
    np.testing.assert_allclose(exact, sampled, atol=0.05)


def test_cameras_stand_above_the_floor_in_the_room_and_outside_all_objects(scene: Scene) -> None:
    rig = scene.cameras
    azimuth, elevation = np.meshgrid(
        np.radians(np.linspace(*rig.azimuth_deg, 9)), np.radians(np.linspace(*rig.elevation_deg, 5))
    )
    directions = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    )
    walk = np.array([point.position for point in rig.walk])
    between = np.concatenate([walk[:-1] + share * (walk[1:] - walk[:-1]) for share in np.linspace(0, 1, 8)])
    cameras = np.concatenate([np.asarray(rig.target) + rig.radius * directions.reshape(-1, 3), between])
    by_name = {item.name: item.mesh for item in scene.objects}
    assert cameras[:, 2].min() > 0.2
    for name, axis, side in (("wall", 1, -1), ("back_wall", 1, -1), ("left_wall", 0, 1)):
        if name in by_name:
            front = by_name[name].vertices[:, axis].min() if side < 0 else by_name[name].vertices[:, axis].max()
            assert (side * (cameras[:, axis] - front)).min() > 0.1, name
    for item in scene.objects:
        low, high = item.mesh.vertices.min(axis=0) - 0.05, item.mesh.vertices.max(axis=0) + 0.05
        close = cameras[((cameras > low) & (cameras < high)).all(axis=-1)]
        if item.name == "case_panes":
            assert len(close) == 0  # Open sheets have no inside; no camera is in the case.
        if len(close):
            assert np.abs(winding_numbers(item.mesh, close)).max() < 0.5, item.name
            assert point_distance(item.mesh, close) > 0.03, item.name


def point_distance(mesh: Mesh, points: np.ndarray) -> float:
    corners = face_corners(mesh).astype(np.float64)
    pairs = np.repeat(points, len(corners), axis=0), np.tile(corners, (len(points), 1, 1))
    return float(point_triangle_distance(*pairs).min())


def test_winding_numbers_tell_inside_from_outside() -> None:
    from datagen.scene.modelling import ball

    inside, outside = winding_numbers(ball(1.0, subdivisions=2), np.array([[0.1, 0.2, 0.3], [1.2, 0, 0]]))
    assert inside == pytest.approx(1)
    assert outside == pytest.approx(0, abs=1e-9)


def test_the_walk_leaves_the_hemisphere_both_ways(scene: Scene) -> None:
    rig = scene.cameras
    distances = [np.linalg.norm(np.subtract(point.position, rig.target)) / rig.radius for point in rig.walk]
    assert 0.35 <= min(distances) < 0.75
    assert 1.4 < max(distances) < 2.6


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "glass_table" else pytest.mark.full) for name in SCENES]
)
def test_makers_give_the_same_bytes_every_time(name: str) -> None:
    assert scene_files(SCENES[name]()) == scene_files(SCENES[name]())


def test_a_scene_is_made_again_byte_for_byte() -> None:
    if "vitrine" not in _made:
        _made["vitrine"] = make_scene("vitrine")
    assert scene_files(make_scene("vitrine")) == scene_files(_made["vitrine"])


@pytest.mark.parametrize(
    "scene",
    # These two have all kinds of materials; the others only have more faces.
    [pytest.param(name, marks=() if name in ("prism_bench", "vitrine") else pytest.mark.full) for name in SCENES],
    indirect=True,
)
def test_saving_and_loading_gives_the_same_scene(scene: Scene, tmp_path: Path) -> None:
    save_scene(scene, tmp_path)
    loaded = load_scene(tmp_path)
    for field in ("name", "description", "environment", "lights", "cameras"):
        assert getattr(loaded, field) == getattr(scene, field)
    for before, after in zip(scene.objects, loaded.objects, strict=True):
        assert (before.name, before.material) == (after.name, after.material)
        for array in dataclasses.fields(Mesh):
            np.testing.assert_array_equal(getattr(before.mesh, array.name), getattr(after.mesh, array.name))


def test_an_unknown_scene_is_answered_with_the_nearest() -> None:
    with pytest.raises(HyalineError, match="did you mean 'vitrine'"):
        make_scene("vitrin")
