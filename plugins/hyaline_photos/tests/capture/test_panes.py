"""Tests that panes are told from other glass by masks, and what a captured room makes of them; floors that go on."""

import math

import numpy as np
import pytest
import trimesh
from jaxtyping import Bool, Float, UInt8

from datagen.data.cameras import Cameras, Lens, look_at
from datagen.data.meshes import mesh_from
from datagen.scene.modelling import moved, sheet
from datagen.scene.rig import towards
from hyaline_photos.capture.planes import Rectangle, down_to
from hyaline_photos.capture.room import Outline, Pane, find_outline, find_panes, fit_room

SIDE, VIEWS = 96, 10
ANGLE = math.radians(25)
HALF, TOP, THICKNESS = (0.4, 0.25), 0.7, 0.016
BALL, RADIUS = np.array((0.1, -0.05, 0.77)), 0.07
"""A ball on a pane."""
CUPS = [np.array((x, y, 0.75)) for x in (-0.33, -0.2, -0.07, 0.07, 0.2, 0.33) for y in (-0.17, 0.0, 0.17)]
"""Opaque balls of 5 cm on it, whose edges make up most of the edges of its masks."""


def around() -> Cameras:
    aways = [1.3 * np.array(towards(math.degrees(2.4 * view), 15 + 15 * (view % 4))) for view in range(VIEWS)]
    places = [look_at(np.array((0, 0, TOP)) + away, (0.0, 0.0, TOP)) for away in aways]
    return Lens(fov_x=0.8, width=SIDE, height=SIDE).cameras(np.stack(places))


def rays(cameras: Cameras, view: int) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "h w 3"]]:
    origin, directions = (part.astype(np.float64) for part in cameras[view].rays())
    return origin, directions


def sees_ball(origin: np.ndarray, ahead: np.ndarray, ball: np.ndarray = BALL, radius: float = RADIUS) -> np.ndarray:
    away = ball - origin
    return away @ away - (ahead @ away) ** 2 < radius**2


def sees_pane(origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    c, s = math.cos(ANGLE), math.sin(ANGLE)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    low, high = np.array((-HALF[0], -HALF[1], TOP - THICKNESS)), np.array((*HALF, TOP))
    start, ahead = turn @ origin, directions @ turn.T
    ends = np.stack([(low - start) / ahead, (high - start) / ahead])
    return ends.min(axis=0).max(axis=-1) < ends.max(axis=0).min(axis=-1)


@pytest.fixture(scope="module")
def ids() -> list[UInt8[np.ndarray, "h w"]]:
    """1 where the ball is seen first, 2 at the pane."""
    cameras, found = around(), []
    for view in range(VIEWS):
        origin, directions = rays(cameras, view)
        picture = np.where(sees_pane(origin, directions), 2, 0).astype(np.uint8)
        picture[np.any([sees_ball(origin, directions, cup, 0.05) for cup in CUPS], axis=0)] = 0
        picture[sees_ball(origin, directions)] = 1
        found.append(picture)
    return found


def test_a_pane_is_found_and_a_ball_is_none(ids: list[UInt8[np.ndarray, "h w"]]) -> None:
    cameras = around()
    outlines = [find_outline(name, index, ids, cameras, where="") for index, name in ((1, "ball"), (2, "pane"))]
    (pane,) = find_panes(outlines, ids, cameras)
    assert pane.name == "pane"
    pixel = 1.3 * 0.8 / SIDE
    assert pane.top == pytest.approx(TOP, abs=pixel)
    assert pane.thickness == pytest.approx(THICKNESS, abs=pixel)
    assert np.abs(np.sort(pane.footprint.half) - np.sort(HALF)).max() < 1.2 * pixel
    corners = np.array([[1, 1], [1, -1]]) * HALF @ [[0.906, 0.423], [-0.423, 0.906]]
    assert pane.footprint.holds(0.95 * corners).all()
    outline = pane.outline()
    assert outline.center[2] + outline.radii[2] == pytest.approx(pane.top)
    assert np.all(np.array(outline.radii[:2]) > HALF[1])


def test_nothing_opaque_is_left_in_a_pane() -> None:
    pane = Pane(name="pane", footprint=Rectangle(center=(0, 0), half=(0.4, 0.25), angle=0), top=0.7, thickness=0.02)
    flat = sheet((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0))
    found = [pane.without(moved(flat, (0, 0, height))).vertices[0, 2] for height in (0.5, 0.683, 0.695, 0.72)]
    assert found[0] == pytest.approx(0.5) and found[3] == pytest.approx(0.72)
    assert 0.678 < found[1] < 0.68 and 0.7 < found[2] < 0.702
    assert pane.without(moved(flat, (2, 0, 0.69))).vertices[0, 2] == pytest.approx(0.69)


def test_glass_stands_on_a_pane_and_no_table_takes_its_place() -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-1, 1, (900, 2)), np.zeros(900)])
    frame = np.column_stack([rng.uniform(-0.4, 0.4, (300, 2)), np.full(300, 0.69)])
    pane = Pane(name="pane", footprint=Rectangle(center=(0, 0), half=HALF, angle=ANGLE), top=TOP, thickness=THICKNESS)
    glass = [Outline(name="ball", center=(0.1, -0.05, 0.76), radii=(0.07, 0.07, 0.08)), pane.outline()]
    places, points = around().world_from_camera[:, :3, 3], np.concatenate([floor, frame])
    room = fit_room(points, glass, places, panes=[pane])
    assert room.support == pytest.approx(TOP)
    assert "table" not in room.parts
    without = fit_room(points, glass, places)
    assert "table" in without.parts, "so a pane's height has points"


def test_a_floor_goes_on_to_walls_and_far_where_there_are_none() -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-1, 1, (900, 2)), np.zeros(900)])
    wall = np.column_stack([np.full(500, -1.8), rng.uniform(-1.5, 1.5, 500), rng.uniform(0.1, 1.5, 500)])
    glass = [Outline(name="ball", center=(0, 0, 0.1), radii=(0.1, 0.1, 0.1))]
    places = around().world_from_camera[:, :3, 3] * (1, 1, 0.7)

    def floors(points: Float[np.ndarray, "point 3"]) -> list[Float[np.ndarray, "_ 3"]]:
        parts = fit_room(points, glass, places).parts
        return [parts[name].vertices for name in parts if name.startswith("floor")]

    found = np.concatenate(floors(np.concatenate([floor, wall])))
    assert found[:, 0].min() == pytest.approx(-1.8, abs=0.05) and found[:, 0].max() > 4
    assert found[:, 1].min() < -4 and found[:, 1].max() > 4
    assert np.ptp(floors(np.concatenate([floor, wall]))[0], axis=0)[1] < 2.5, "what points show is a part of its own"
    deeper = np.column_stack([rng.uniform(-3, 3, (200, 2)), rng.uniform(-2, -0.5, 200)])
    assert len(floors(np.concatenate([floor, wall, deeper]))) == 1, "something is below"
    back, places = wall * (1 / 3, 0.5, 0.5), np.array([(1.2, y, 0.8) for y in (-0.5, 0.0, 0.5)])
    assert "wall_0" in fit_room(np.concatenate([floor[floor[:, 0] > -0.6], back]), glass, places).parts
    assert "wall_0" not in fit_room(np.concatenate([floor, back]), glass, places).parts, "the floor goes on behind it"


def test_what_was_cut_off_above_a_table_stands_on_it() -> None:
    ball = trimesh.creation.icosphere(radius=0.2)
    ball.apply_translation((1.0, 2.0, 0.15))
    ball.update_faces(ball.triangles_center[:, 2] > 0.05)
    found = down_to(0.0, mesh_from(ball.vertices, ball.faces, ball.vertex_normals), 0.1)
    surface = trimesh.Trimesh(found.vertices, found.faces)
    assert surface.is_winding_consistent and surface.bounds[0, 2] == 0.0
    open_edges = surface.edges[trimesh.grouping.group_rows(surface.edges_sorted, require_count=1)]
    assert len(open_edges) and (surface.vertices[open_edges][..., 2] == 0).all()
    assert len(down_to(-1.0, found, 0.1).faces) == len(found.faces)
