"""Tests the bodies, vessels and places of random scenes: solids of the promised kind, volumes, and clearances."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, KDTree

from datagen.data.meshes import Mesh, points_on, signed_volume
from datagen.data.queries import check_closed, check_solid, windings
from datagen.scene.description import SceneObject
from datagen.scene.materials import ThinDielectric
from datagen.scene.modelling import ball, lathe
from hyaline_random.families import PANES, bauble, glass_case, onion, paperweight
from hyaline_random.solids import CONVEX, NOT_CONVEX, corners_of, make_solid, polygon, with_bubbles
from hyaline_random.things import Thing, free_places
from hyaline_random.vessels import REACH, VESSELS


def convexity(mesh: Mesh) -> float:
    return signed_volume(mesh) / ConvexHull(mesh.vertices).volume


@pytest.mark.parametrize("kind", [*CONVEX, *NOT_CONVEX])
def test_a_body_is_one_solid_that_stands_and_is_convex_or_not_as_its_list_says(kind: str) -> None:
    for seed in range(2):
        mesh = make_solid(kind, rng=np.random.default_rng(seed))
        check_closed(mesh, where=kind)
        check_solid(mesh, where=kind)
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        assert low[2] == pytest.approx(0, abs=1e-7)
        assert 0.06 < (high - low).max() < 0.17
        assert convexity(mesh) > 0.999 if kind in CONVEX else convexity(mesh) < 0.98


@pytest.mark.parametrize("sides", [3, 4, 6, 8])
def test_a_polygonal_prism_has_the_volume_of_geometry(sides: int) -> None:
    outline = [(0, 0), (0.03, 0), (0.03, 0.1), (0, 0.1)]
    prism = lathe(outline, segments=corners_of(sides), around=polygon(sides))
    assert signed_volume(prism) == pytest.approx(sides * np.tan(np.pi / sides) * 0.03**2 * 0.1, rel=1e-6)


def test_bubbles_are_taken_from_the_volume_and_air_is_in_them() -> None:
    host = ball(0.05)
    pierced = with_bubbles(host, rng=np.random.default_rng(1))
    check_closed(pierced, where="bubbles")
    check_solid(pierced, where="bubbles")
    added = pierced.faces[len(host.faces) :]
    assert signed_volume(pierced) < signed_volume(host)
    first = added[: len(ball(1, subdivisions=3).faces)]
    middle = pierced.vertices[first].reshape(-1, 3).mean(axis=0)
    assert windings(pierced.vertices[pierced.faces], np.stack([middle, [0.0, 0.0, 0.049]])).tolist() == [0, 1]


@pytest.mark.parametrize("kind", VESSELS)
def test_a_drink_reaches_into_its_glass_by_less_than_the_wall(kind: str) -> None:
    for seed in range(3):
        vessel = VESSELS[kind](np.random.default_rng(seed))
        glass, drink = vessel.glass(), vessel.drink(vessel.brim)
        for mesh in (glass, drink):
            check_closed(mesh, where=kind)
            check_solid(mesh, where=kind)
        assert 0 < REACH < min(vessel.wall, vessel.floor)
        # The drink's side is in the wall all around, and never comes out of the glass.
        corners = glass.vertices[glass.faces]
        side = drink.vertices[drink.vertices[:, 2] < vessel.brim - 1e-6]
        assert (windings(corners, side) == 1).mean() > 0.98
        shell = np.linalg.norm(glass.vertices[:, :2], axis=-1).max()
        assert np.linalg.norm(drink.vertices[:, :2], axis=-1).max() < shell
        just_inside = np.array([[0.98 * vessel.inner_radius(vessel.brim), 0, vessel.brim]])
        assert windings(corners, just_inside).tolist() == [0]


@pytest.mark.parametrize("make", [paperweight, onion])
def test_what_is_inside_of_a_body_is_wholly_inside(make) -> None:
    for seed in range(4):
        thing = make(rng=np.random.default_rng(seed))
        for outer, inner in zip(thing.objects, thing.objects[1:], strict=False):
            assert (windings(outer.mesh.vertices[outer.mesh.faces], inner.mesh.vertices) == 1).all()


@pytest.mark.parametrize("seed", range(5))
def test_places_keep_clear_of_each_other_and_close_together(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reaches = rng.uniform(0.03, 0.12, 9).tolist()
    places = np.array(free_places(reaches, clearance=0.012, rng=rng))
    for one in range(9):
        for other in range(one):
            apart = np.linalg.norm(places[one] - places[other]) - reaches[one] - reaches[other]
            assert apart > 0.0118  # Places are rounded to a tenth of a millimetre.
    assert np.linalg.norm(places, axis=-1).max() < 4 * np.linalg.norm(reaches)


def thin(thing: Thing) -> list[SceneObject]:
    return [item for item in thing.objects if isinstance(item.material, ThinDielectric)]


@pytest.mark.parametrize("kind", PANES)
def test_a_thing_of_thin_glass_stands_and_its_panes_touch_nothing(kind: str) -> None:
    for seed in range(4):
        thing = PANES[kind](np.random.default_rng(seed))
        assert thin(thing)
        assert min(item.mesh.vertices[:, 2].min() for item in thing.objects) == pytest.approx(0, abs=1e-6)
        for pane in thin(thing):
            cloud = KDTree(points_on(pane.mesh, 4000).position)
            for item in thing.objects:
                if item is not pane:
                    assert cloud.query(points_on(item.mesh, 4000).position)[0].min() > 0.0007


def test_what_thin_glass_is_around_is_wholly_inside() -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        case, *inside = glass_case(of_glass=True, rng=rng).objects
        high = case.mesh.vertices.max(axis=0)
        for item in inside:
            assert (np.abs(item.mesh.vertices[:, :2]) < high[:2] - 0.004).all()
            assert (item.mesh.vertices[:, 2] < high[2] - 0.004).all()
        shell, core = bauble(is_empty=False, rng=rng).objects
        assert (windings(shell.mesh.vertices[shell.mesh.faces], core.mesh.vertices) == 1).all()
