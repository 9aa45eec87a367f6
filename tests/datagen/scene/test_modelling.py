import dataclasses
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.meshes import corner_cosines
from support.reference import winding_numbers
from support.synthetic import synthetic_scene

from datagen.data.meshes import check_mesh, open_edges, signed_volume
from datagen.data.queries import check_closed
from datagen.render.mitsuba_scene import bake_texture, linear_texels
from datagen.scene.materials import SolidTexture
from datagen.scene.modelling import (
    ball,
    cylinder,
    deformed,
    filled,
    filleted,
    lathe,
    rounded_box,
    shaded,
    sheet,
    transformed,
    tube,
    walled,
)
from datagen.scene.textures import PATTERNS, evaluate_texture, fractal_noise, value_noise

CIRCLE = np.linspace(0, 2 * np.pi, 60, endpoint=False)
HELIX = np.stack([np.cos(CIRCLE), np.sin(CIRCLE), CIRCLE], axis=-1)
RING = np.stack([np.cos(CIRCLE), np.sin(CIRCLE), 0.3 * np.sin(2 * CIRCLE)], axis=-1)
TUMBLER = [(0, 0, 0), (0.033, 0, 0.006), (0.035, 0.05, 0), (0.0385, 0.105, 0)]

SOLIDS = {
    "box": rounded_box((1.0, 0.7, 0.02), bevel=0.004),
    "ball": ball(0.1),
    "cylinder": cylinder(0.1, 0.3, top_radius=0.05),
    "tumbler": lathe(walled(filleted(TUMBLER), wall=0.003, floor=0.011)),
    "ring": lathe([(2 + 0.3 * np.cos(a), 0.3 * np.sin(a)) for a in CIRCLE[::4]]),
    "tube": tube(HELIX, np.linspace(0.1, 0.02, 60)),
    "loop": tube(RING, 0.1, is_loop=True),
    "egg": deformed(ball(1.0), lambda p: p * (1 - 0.3 * p[:, 2:])),
    "mirrored": transformed(rounded_box((1, 2, 3), bevel=0.1), np.diag([-1.0, 2.0, 1.0]), (1, 2, 3)),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_outward_valid_and_shaded_on_the_side_they_face(name: str) -> None:
    mesh = SOLIDS[name]
    check_mesh(mesh, where=name)
    assert open_edges(mesh) == 0
    assert signed_volume(mesh) > 0
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-5)
    assert (corner_cosines(mesh) > 0.5).all()


@given(st.floats(0.05, 3), st.floats(0.05, 3), st.floats(0.05, 3), st.integers(3, 80), st.booleans())
@settings(max_examples=30, deadline=None, derandomize=True)
def test_lathe_encloses_the_volume_of_its_stack_of_pyramid_frusta(
    r: float, s: float, h: float, n: int, is_reversed: bool
) -> None:
    profile = [(0, 0), (r, 0), (s, h), (0, h)]
    mesh = lathe(profile[::-1] if is_reversed else profile, segments=n)
    polygon = n / 2 * np.sin(2 * np.pi / n)  # Area of the n-gon in the unit circle.
    assert signed_volume(mesh) == pytest.approx(polygon * h * (r * r + r * s + s * s) / 3, rel=1e-4)


def test_ball_and_rounded_box_have_the_volume_and_the_normals_of_geometry() -> None:
    assert signed_volume(ball(2.0, subdivisions=5)) == pytest.approx(4 / 3 * np.pi * 8, rel=2e-3)
    np.testing.assert_allclose(ball(2.0).vertices, 2 * ball(2.0).normals, atol=1e-6)
    a, b, c, r = 1.0, 0.8, 0.6, 0.1
    inner = np.array([a, b, c]) - 2 * r
    area = 2 * (inner[0] * inner[1] + inner[1] * inner[2] + inner[2] * inner[0])
    steiner = inner.prod() + area * r + np.pi * r**2 * inner.sum() + 4 / 3 * np.pi * r**3
    assert signed_volume(rounded_box((a, b, c), bevel=r, segments=12)) == pytest.approx(steiner, rel=2e-4)


@pytest.mark.parametrize("wall", [0.002, 0.004])
def test_walled_vessel_has_the_wall_that_was_asked_for_and_a_floor(wall: float) -> None:
    outer = filleted(TUMBLER)
    outline = np.array(walled(outer, wall=wall, floor=0.011))
    turn = int(outline[:, 1].argmax())
    inner = outline[turn + 4 :]
    line = np.array(outer)
    fine = np.concatenate([np.linspace(p, q, 400) for p, q in pairwise(line)])
    distance = np.linalg.norm(inner[:, None] - fine[None], axis=-1).min(axis=1)
    assert distance.min() > 0.85 * wall
    assert inner[:, 1].min() == pytest.approx(0.011)
    np.testing.assert_array_equal(outline[[0, -1], 0], 0)


def test_a_long_wall_between_round_corners_has_the_normals_of_a_straight_one() -> None:
    mesh = lathe(walled(filleted([(0, 0, 0), (0.033, 0, 0.006), (0.038, 0.1, 0)]), wall=0.003, floor=0.011))
    low, high = (bound(mesh.vertices[mesh.faces][..., 2], axis=1) for bound in (np.min, np.max))
    rise = np.abs(mesh.normals[mesh.faces[(low < 0.08) & (high > 0.035)]][..., 2])
    assert rise.shape == (384, 3) and rise == pytest.approx(np.sin(np.arctan(0.05)), abs=3e-4)


@pytest.mark.parametrize(("level", "reach"), [(0.03, 0.001), (0.08, 0.0015)])
def test_a_drink_reaches_into_the_wall_and_no_farther(level: float, reach: float) -> None:
    outer, wall, floor = filleted(TUMBLER), 0.003, 0.011
    glass = lathe(walled(outer, wall=wall, floor=floor))
    drink = lathe(filled(outer, wall=wall, floor=floor, level=level, reach=reach))
    check_closed(drink, where="drink")
    assert drink.vertices[:, 2].max() == np.float32(level)
    assert drink.vertices[:, 2].min() == pytest.approx(floor - reach)
    points = np.unique(drink.vertices, axis=0)[::7].astype(np.float64)
    is_top = (points[:, 2] == np.float32(level)) & ~points[:, :2].any(axis=1)
    assert winding_numbers(glass, points) == pytest.approx(np.where(is_top, 0, 1), abs=1e-3)
    # The vessel's inside, between whose volume with and without what reaches into wall and floor the drink's lies.
    heights = np.linspace(floor, level, 500)
    radii = np.interp(heights, [0, 0.05, 0.105], [0.033, 0.035, 0.0385]) - wall
    least, most = (np.pi * np.trapezoid((radii + grown) ** 2, heights) for grown in (0, reach))
    assert 0.9 * least < signed_volume(drink) < most + np.pi * 0.033**2 * reach


def test_fillets_are_arcs_that_touch_both_sides() -> None:
    outline = np.array(filleted([(0, 0, 0), (1, 0, 0.25), (1, 2, 0)], segments=8))
    arc = outline[1:-1]
    np.testing.assert_allclose(np.linalg.norm(arc - [0.75, 0.25], axis=-1), 0.25, atol=1e-12)
    np.testing.assert_allclose(arc[[0, -1]], [[0.75, 0], [1, 0.25]], atol=1e-12)


def test_a_crease_angle_of_0_makes_every_face_flat() -> None:
    """Although rounding leaves some unit normals a little shorter than 1."""
    round_one = ball(1.0, subdivisions=2)
    gem = shaded(round_one.vertices.astype(np.float64), round_one.faces, crease_deg=0)
    np.testing.assert_allclose(corner_cosines(gem), 1, atol=1e-6)


def test_creases_split_a_box_and_leave_a_ball_whole() -> None:
    corners = np.array(list(np.ndindex(2, 2, 2)), np.float64)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                      [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    cube = shaded(corners, faces, crease_deg=40)
    assert len(cube.vertices) == 24
    np.testing.assert_allclose(corner_cosines(cube), 1, atol=1e-6)
    assert len(shaded(corners, faces, crease_deg=120).vertices) == 8
    sphere = ball(1.0, subdivisions=3)
    again = shaded(sphere.vertices.astype(np.float64), sphere.faces, crease_deg=40)
    assert len(again.vertices) == len(sphere.vertices)
    assert np.einsum("vi,vi->v", again.normals, again.vertices).min() > 0.9999


# Solid textures

RED, BLUE = (0.8, 0.1, 0.1), (0.1, 0.1, 0.9)


def points(count: int = 4000) -> np.ndarray:
    return np.random.default_rng(0).uniform(-2, 2, (count, 3))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_every_pattern_mixes_its_two_colors_and_shows_both(pattern: str) -> None:
    texture = SolidTexture(pattern=pattern, colors=(RED, BLUE), scale=0.3)  # pyright: ignore[reportArgumentType]
    values = evaluate_texture(texture, points())
    amount = (values[:, 2] - 0.1) / 0.8
    np.testing.assert_allclose(values, np.array(RED) + amount[:, None] * (np.array(BLUE) - np.array(RED)), atol=1e-6)
    assert amount.min() >= -1e-6
    assert amount.max() <= 1 + 1e-6
    assert amount.std() > 0.1
    np.testing.assert_array_equal(values, evaluate_texture(texture, points()))


@pytest.mark.parametrize("pattern", ["checker", "stripes"])
def test_checker_and_stripes_repeat_after_scale_and_swap_after_half(pattern: str) -> None:
    texture = SolidTexture(pattern=pattern, colors=(RED, BLUE), scale=0.25, axis="x")  # pyright: ignore[reportArgumentType]
    here = evaluate_texture(texture, points())
    np.testing.assert_allclose(evaluate_texture(texture, points() + np.array([0.25, 0, 0])), here, atol=1e-6)
    there = evaluate_texture(texture, points() + np.array([0.125, 0, 0]))
    np.testing.assert_allclose(here + there, np.broadcast_to(np.add(RED, BLUE), here.shape), atol=1e-6)
    if pattern == "stripes":  # Across their axis only.
        assert np.ptp(evaluate_texture(texture, points() * [0, 1, 1]), axis=0).max() == 0


def test_noise_is_continuous_bounded_and_known_at_lattice_points() -> None:
    p = points() * 5
    for noise in (value_noise, lambda q: fractal_noise(q, octaves=4)):
        assert 0 <= noise(p).min() < 0.35 < 0.65 < noise(p).max() <= 1
        assert np.abs(noise(p + 1e-5) - noise(p)).max() < 1e-3
    # Golden: the hash must never change, or every stored scene changes its textures.
    golden = value_noise(np.array([[0.0, 0, 0], [1, 2, 3], [-4, 5, -6]]))
    np.testing.assert_allclose(golden, GOLDEN, atol=1e-12)


GOLDEN = (0.0, 0.027354258112609386, 0.2896695521194488)


def test_a_baked_texture_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    mesh, scene = sheet((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), cells=(3, 2)), synthetic_scene()
    texture = SolidTexture(pattern="marble", colors=(RED, BLUE), scale=0.1)
    expected = bake_texture(texture, mesh, 128)
    for count, scale in enumerate((0.1, 0.1, 0.2)):
        found = linear_texels(scene, mesh, dataclasses.replace(texture, scale=scale))
        assert np.array_equal(found, expected) == (scale == 0.1)
        assert len(list((tmp_path / "hyaline" / "textures").iterdir())) == max(1, count)
