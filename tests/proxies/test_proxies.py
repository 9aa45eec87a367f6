"""Tests of proxies: what they enclose, how tight they are, and their atlas."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from support.meshes import mesh_of
from support.reference import winding_numbers

from datagen.data.meshes import Mesh, check_mesh, face_corners, points_on, signed_volume
from datagen.data.paths import ProxyKind
from datagen.data.queries import check_closed
from proxies import solid
from proxies.kinds import box, ellipsoid, hull
from proxies.make import FITTERS, paddings
from proxies.solid import Solid, make_solid, outside_by

KINDS = list(FITTERS)
CONVEX_KINDS: list[ProxyKind] = ["box", "ellipsoid", "hull"]


def fit(kind: ProxyKind, own: Solid, *, padding: float) -> Mesh:
    return FITTERS[kind]((own,), (padding,))[0]


def surface(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    return mesh_of(trimesh.Trimesh(vertices, faces, process=False))


def cloud_mesh(points: np.ndarray) -> Mesh:
    """Triangles between points in their order: a soup that is neither closed nor convex."""
    index = np.arange(len(points))
    return surface(points, np.stack([index, np.roll(index, -1), np.roll(index, -2)], axis=-1))


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def shapes(seed: int) -> list[Mesh]:
    """A soup, a rotated slab, a far needle, a quad in a slanted plane, one triangle."""
    rng = np.random.default_rng(seed)
    turn = random_rotation(rng)
    return [
        cloud_mesh(rng.normal(size=(200, 3))),
        cloud_mesh(rng.uniform(-1, 1, (60, 3)) * [2, 1, 0.01] @ turn.T + [3, -2, 1]),
        cloud_mesh(rng.uniform(-1, 1, (40, 3)) * [1, 2e-3, 1e-3] @ turn.T + 5),
        surface(np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ turn.T, np.array([[0, 1, 2], [0, 2, 3]])),
        surface(rng.normal(size=(3, 3)), np.array([[0, 1, 2]])),
    ]


@pytest.mark.parametrize("kind", CONVEX_KINDS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2))])
def test_proxies_are_closed_outward_and_enclose_every_vertex_as_stored(kind: ProxyKind, seed: int) -> None:
    truths = shapes(seed)
    for truth in truths:
        own = make_solid(truth)
        padding = paddings((own,))[0]
        proxy = fit(kind, own, padding=padding)
        check_mesh(proxy, where=kind)
        check_closed(proxy, where=kind)
        # Strictly inside, without any tolerance: the padding is larger than what float32 moves a facet.
        beyond = outside_by(face_corners(proxy).astype(np.float64), truth.vertices.astype(np.float64))
        assert beyond.max() < 0
        # And no larger than needed: a point of the solid comes within the padding and rounding of a facet.
        reach = outside_by(face_corners(proxy).astype(np.float64), own.points).max()
        assert reach > -2 * padding - 8 * 2.0**-24 * np.abs(truth.vertices).max()
        normals = np.einsum("vi,vi->v", proxy.normals, proxy.normals)
        np.testing.assert_allclose(normals, 1, atol=1e-5)
        assert solid.enclosure(proxy, truth).problem is None


@settings(max_examples=3, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 30), flatness=st.floats(-8, 0), distance=st.floats(-30, 30))
def test_any_points_get_a_sound_proxy(seed: int, count: int, flatness: float, distance: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * [1, 1, 10**flatness] @ random_rotation(rng).T + distance
    truth = cloud_mesh(points)
    own = make_solid(truth)
    for kind in CONVEX_KINDS:
        proxy = fit(kind, own, padding=paddings((own,))[0])
        assert solid.enclosure(proxy, truth).problem is None
        assert signed_volume(proxy) >= own.hull_volume * (1 - 1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_the_box_of_a_turned_box_has_its_volume_and_its_sides(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = np.sort(rng.uniform(0.1, 1, 3))[::-1]
    inside = rng.uniform(-1, 1, (100, 3))
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    points = np.concatenate([corners, inside]) * half @ random_rotation(rng).T + rng.normal(size=3)
    found = box.smallest_box(make_solid(cloud_mesh(points)))
    np.testing.assert_allclose(found.half, half, rtol=1e-5)
    assert np.linalg.det(found.axes) == pytest.approx(1)


def test_a_tetrahedron_gets_the_box_that_no_face_of_it_lies_flush_with() -> None:
    # The least box of a regular tetrahedron is the cube around it, which touches its edges only (volume ratio 3).
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    own = make_solid(cloud_mesh(corners @ random_rotation(np.random.default_rng(0)).T))
    assert np.prod(2 * box.smallest_box(own).half) == pytest.approx(8, rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_ellipsoid_of_an_ellipsoids_points_has_its_radii_and_centre(seed: int) -> None:
    rng = np.random.default_rng(seed)
    radii, center, turn = np.sort(rng.uniform(0.05, 2, 3)), rng.normal(size=3), random_rotation(rng)
    unit = rng.normal(size=(4000, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    unit = np.concatenate([unit, -unit])
    found = ellipsoid.smallest_ellipsoid(unit * radii @ turn.T + center)
    np.testing.assert_allclose(np.linalg.eigvalsh(found.root), radii, rtol=2e-3)
    np.testing.assert_allclose(found.center, center, atol=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_ellipsoid_meets_johns_condition(seed: int) -> None:
    """Source: John 1948: weights on contact points, of zero mean and with the identity as scatter, prove optimality."""
    rng = np.random.default_rng(seed)
    points = rng.standard_t(3, size=(300, 3)) * rng.uniform(0.01, 3, 3) @ random_rotation(rng).T + 2
    found = ellipsoid.smallest_ellipsoid(points)
    local = np.linalg.solve(found.root, (points - found.center).T).T
    radii = np.linalg.norm(local, axis=-1)
    assert radii.max() <= 1 + 1e-4
    assert radii[found.weights > 0].min() >= 1 - 1e-4
    assert found.weights.min() >= 0
    np.testing.assert_allclose(found.weights @ local, 0, atol=1e-8)
    np.testing.assert_allclose(3 * local.T @ (found.weights[:, None] * local), np.eye(3), atol=1e-8)


@pytest.mark.parametrize("cells", [4, 8, ellipsoid.CELLS])
def test_the_tessellated_sphere_is_convex_and_no_facet_cuts_deep(cells: int) -> None:
    grid = ellipsoid.sphere_grid(cells)
    np.testing.assert_allclose(np.linalg.norm(grid.positions, axis=-1), 1, rtol=1e-12)
    corners = grid.positions[grid.position_of][grid.faces]
    assert outside_by(corners, grid.positions).max() < 1e-12
    assert outside_by(corners, np.zeros((1, 3))).max() < -(1 - 0.8 / cells**2)


def test_the_polyhedron_costs_less_than_half_a_percent_over_the_ellipsoid() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points *= [1, 0.5, 0.2] / np.linalg.norm(points, axis=-1, keepdims=True)
    own = make_solid(cloud_mesh(points))
    smooth = 4 / 3 * np.pi * np.linalg.det(ellipsoid.smallest_ellipsoid(own.hull_points).root)
    assert signed_volume(ellipsoid.fit_ellipsoid(own, padding=0)) == pytest.approx(smooth, rel=5e-3)


@pytest.mark.parametrize("seed", range(3))
def test_a_rounded_hull_is_convex_and_its_normals_are_those_of_its_facets(seed: int) -> None:
    own = make_solid(shapes(seed)[0])
    surface = hull.rounded_hull(own, padding=1e-5, min_face=1e-5)
    corners = surface.vertices[surface.faces]
    assert outside_by(corners, surface.vertices).max() < 1e-9
    a, b, c = np.moveaxis(corners, 1, 0)
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    # Each normal is the direction in which its vertex is the farthest, so it leans outward on all its facets.
    assert np.einsum("fi,fki->fk", across, surface.normals[surface.faces]).min() > 0
    farthest = (surface.normals @ surface.vertices.T).argmax(axis=1)
    np.testing.assert_array_equal(farthest, np.arange(len(surface.vertices)))


@pytest.mark.parametrize("flatness", [1, 1e-2])
def test_the_rounded_hull_of_a_box_is_a_fifth_larger_and_the_hull_of_a_ball_a_thirtieth(flatness: float) -> None:
    cube = (2 * np.indices((2, 2, 2)).reshape(3, 8).T - 1) * [1, 1, flatness]
    own = make_solid(cloud_mesh(cube))
    assert signed_volume(fit("hull", own, padding=1e-6)) == pytest.approx(1.19 * own.hull_volume, rel=0.01)
    ball = np.random.default_rng(0).normal(size=(2000, 3))
    ball *= [1, 1, flatness] / np.linalg.norm(ball, axis=-1, keepdims=True)
    own = make_solid(cloud_mesh(ball))
    assert signed_volume(fit("hull", own, padding=1e-6)) == pytest.approx(1.03 * own.hull_volume, rel=0.02)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("piece", [0, *(pytest.param(piece, marks=pytest.mark.full) for piece in (1, 2, 3, 4))])
def test_every_point_of_the_atlas_belongs_to_one_face_at_most(kind: ProxyKind, piece: int) -> None:
    proxy = wrap_of(piece)[1] if kind == "wrap" else fit(kind, make_solid(shapes(0)[piece]), padding=1e-5)
    corners = proxy.uv[proxy.faces].astype(np.float64)
    if kind not in CELLS_OF_A_CHART:
        # xatlas may mirror a chart.
        turned = np.linalg.det(np.concatenate([corners, np.ones((len(corners), 3, 1))], axis=-1)) < 0
        corners = np.where(turned[:, None, None], corners[:, ::-1], corners)
    a, b, c = np.moveaxis(corners, 1, 0)
    # Random points and, for the gutter, how many faces each lies in, by barycentric signs.
    points = np.random.default_rng(0).uniform(size=(2000, 2))
    counts = np.concatenate([faces_around(part, a, b, c) for part in np.split(points, 50)])
    assert counts.max() == 1
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert areas.min() > solid.ATLAS_ROOM
    assert counts.mean() == pytest.approx(areas.sum(), abs=0.04)
    assert areas.sum() > {"box": 0.8, "ellipsoid": 0.999}.get(kind, 0.3)
    if kind in CELLS_OF_A_CHART:
        # No face spans the atlas.
        assert np.ptp(corners, axis=1).max() <= 0.51 / (CELLS_OF_A_CHART[kind] / 2)


def faces_around(points: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """How many triangles with these corners each point lies in; few points at once, whose arrays fit into a cache."""
    inside = np.ones((len(points), len(a)), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        (ex, ey), (px, py) = (end - start).T, np.moveaxis(points[:, None] - start, -1, 0)
        inside &= ex * py - ey * px > 0  # Left of each edge: a mirrored face would hold no point at all.
    return inside.sum(axis=1)


CELLS_OF_A_CHART = {"box": 2, "ellipsoid": 32}
"""Of the kinds that lay out their own atlas; xatlas unwraps the others."""


def test_boxes_of_objects_on_one_floor_have_no_two_sides_in_one_plane() -> None:
    cube = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    truths = tuple(cloud_mesh(cube * 0.5 + [x, 0, z]) for x in (0, 0.5, 1.0) for z in (0, 0.5))
    solids = tuple(make_solid(truth) for truth in truths)
    meshes = FITTERS["box"](solids, paddings(solids))
    for axis in range(3):
        sides = np.sort(
            [side for mesh in meshes for side in (mesh.vertices[:, axis].min(), mesh.vertices[:, axis].max())]
        )
        assert np.diff(sides).min() > 1e-6  # A step is 3e-6 here, and float32 resolves 1e-7.


def test_statistics_of_a_box_in_a_box_are_the_analytic_ones() -> None:
    cube = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3).astype(float)
    truth = box.fit_box(make_solid(cloud_mesh(cube)), padding=0)
    proxy = box.fit_box(make_solid(cloud_mesh(cube)), padding=0.1)
    numbers = solid.proxy_statistics(proxy, truth, make_solid(truth))
    assert numbers.volume_ratio == pytest.approx(1.1**3, rel=1e-5)
    assert numbers.max_distance == pytest.approx(0.1 * np.sqrt(3), rel=1e-5)
    # On a side: 0.1 over the middle 2 x 2, the distance to an edge or a corner over the rim.
    grid = (np.arange(400) + 0.5) / 400 * 2.2 - 1.1
    beyond = np.maximum(np.abs(np.stack(np.meshgrid(grid, grid), axis=-1)) - 1, 0)
    assert numbers.mean_distance == pytest.approx(np.sqrt((beyond**2).sum(axis=-1) + 0.01).mean(), rel=1e-2)


def cup() -> Mesh:
    """An open glass: closed, hollow, its wall a tenth as thick as it is wide."""
    profile = np.array([[0, 0], [1, 0], [1, 2], [0.8, 2], [0.8, 0.2], [0, 0.2]])
    turned = trimesh.creation.revolve(profile, sections=24)
    return surface(turned.vertices, turned.faces)


@functools.cache
def wrap_of(piece: int) -> tuple[Mesh, Mesh]:
    """One of the shapes, or (5) a cup, and its wrap; this takes seconds."""
    pytest.importorskip("pymeshlab", exc_type=ImportError)
    truth = [*shapes(0), cup()][piece]
    own = make_solid(truth)
    return truth, fit("wrap", own, padding=paddings((own,))[0])


@pytest.mark.parametrize("piece", [0, 5, *(pytest.param(piece, marks=pytest.mark.full) for piece in (1, 2, 3, 4))])
def test_wraps_are_closed_outward_and_enclose_all_of_the_surface(piece: int) -> None:
    truth, proxy = wrap_of(piece)
    check_mesh(proxy, where="wrap")
    check_closed(proxy, where="wrap")
    assert solid.enclosure(proxy, truth).problem is None
    np.testing.assert_allclose(np.linalg.norm(proxy.normals, axis=-1), 1, atol=1e-5)
    # By another way than the check goes: vertices and points on the surface, by their winding numbers.
    points = np.concatenate([truth.vertices[np.unique(truth.faces)], points_on(truth, 200).position])
    assert winding_numbers(proxy, points).min() > 0.5


def test_a_wrap_leaves_the_hollow_of_a_cup_open() -> None:
    truth, proxy = wrap_of(5)
    assert winding_numbers(proxy, np.array([[0, 0, 1.0]])) < 0.5
    assert signed_volume(truth) < signed_volume(proxy) < 0.6 * make_solid(truth).hull_volume


@pytest.mark.parametrize("seed", range(2))
def test_crossed_faces_are_those_that_a_loop_finds(seed: int) -> None:
    """Oracle: an edge crosses a face where the tetrahedra it spans with the face's sides have volumes of one sign."""
    rng = np.random.default_rng(seed)
    truth, other = (cloud_mesh(rng.normal(size=(30, 3)) * rng.uniform(0.2, 1)) for _ in range(2))
    expected = np.zeros(30, bool)

    def volume(*points: np.ndarray) -> float:
        return np.linalg.det(np.stack(points[1:]) - points[0])

    def crosses(p: np.ndarray, q: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> bool:
        if volume(p, a, b, c) * volume(q, a, b, c) > 0:
            return False
        sides = np.sign([volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)])
        return abs(sides.sum()) == 3

    ours, theirs = face_corners(truth).astype(float), face_corners(other).astype(float)
    for index, one in enumerate(ours):
        for face in theirs:
            for side in range(3):
                expected[index] |= crosses(one[side], one[side - 1], *face) or crosses(face[side], face[side - 1], *one)
    np.testing.assert_array_equal(solid.crossed_faces(other, truth), expected)


def test_a_part_outside_is_missed_though_nothing_crosses() -> None:
    proxy = fit("box", make_solid(shapes(0)[0]), padding=1e-5)
    near, far = shapes(0)[0], cloud_mesh(shapes(0)[0].vertices + 50)
    assert solid.enclosed_share(proxy, near) == 1
    assert solid.enclosed_share(proxy, far) == 0


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        (lambda proxy: {"faces": proxy.faces[1:]}, "3 open edges"),
        (lambda proxy: {"faces": proxy.faces[:, ::-1]}, "inside out"),
        (lambda proxy: {"vertices": proxy.vertices * np.float32(0.9)}, "of the object outside"),
        (lambda proxy: {"uv": 1 - proxy.uv * np.array([1, 0], np.float32)}, "of the atlas"),
    ],
)
def test_an_enclosure_names_what_is_wrong(changed: Callable[[Mesh], dict[str, np.ndarray]], problem: str) -> None:
    truth = shapes(0)[0]
    proxy = fit("box", make_solid(truth), padding=1e-5)
    assert solid.enclosure(proxy, truth).problem is None
    assert problem in str(solid.enclosure(dataclasses.replace(proxy, **changed(proxy)), truth).problem)
