"""Tests random scenes: what a seed draws passes every check, keeps apart, shows enough glass, and is drawn again."""

import dataclasses
import functools
import re
from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from support.rigs import config
from support.synthetic import pixel_rays

from datagen.data.meshes import points_on
from datagen.disk.errors import HyalineError
from datagen.scene.finding import find_scene, find_source
from datagen.scene.folder import scene_files
from datagen.scene.modelling import moved
from datagen.scene.rig import make_cameras
from datagen.scene.soundness import check_scene
from hyaline_random.drawing import Drawn, check_inside, draw_scene, glass_shares
from hyaline_random.families import PANES, filled_vessel
from hyaline_random.names import RandomName, parse_random
from hyaline_random.things import Thing

OTHERS = "random-0002", "random-0003", "random-0004", "random-solid-0005", "random-frosted-0006", "random-lamps-0007"
NAMES = ("random-0000", "random-drinks-0001", *(pytest.param(name, marks=pytest.mark.full) for name in OTHERS))
"""One of each family, and once more."""


@functools.cache
def drawn(name: str) -> Drawn:
    found = parse_random(name)
    assert found is not None
    return draw_scene(found)


@pytest.mark.parametrize("name", NAMES)
def test_a_seed_draws_a_scene_that_passes_every_check(name: str) -> None:
    scene, seed = drawn(name).scene, int(name[-4:])
    check_scene(scene)
    assert scene.name == name
    assert 0.05 <= drawn(name).glass_share <= 0.40
    family = name.split("-")[1] if name.count("-") == 2 else ("object", "table", "nested")[seed % 3]
    assert f"family {family}, seed {seed}: " in scene.description
    assert any(item.material.is_glass for item in scene.objects)
    assert bool(scene.lights) == (family in ("drinks", "lamps"))


@pytest.mark.parametrize("name", NAMES)
def test_things_stand_a_centimetre_apart_and_a_slit_above_the_ground(name: str) -> None:
    clouds = [
        np.concatenate([points_on(item.mesh, 4000).position for item in thing.objects]) for thing in drawn(name).things
    ]
    for one, other in combinations(clouds, 2):
        assert KDTree(one).query(other)[0].min() > 0.01
    things = drawn(name).things
    for thing in things:
        assert min(item.mesh.vertices[:, 2].min() for item in thing.objects) == pytest.approx(0, abs=1e-6)
    stood_on = drawn(name).scene.objects[sum(len(thing.objects) for thing in things) :]
    tops = [float(item.mesh.vertices[:, 2].max()) for item in stood_on]
    assert max(top for top in tops if top < 0) == pytest.approx(-0.001, abs=1e-6)


def test_the_same_seed_draws_the_same_bytes_and_another_one_others() -> None:
    again, other = draw_scene(RandomName(seed=2)).scene, drawn("random-0000").scene
    assert scene_files(again) == scene_files(drawn("random-0002").scene)
    assert scene_files(again)["scene.json"] != scene_files(other)["scene.json"]


@pytest.mark.parametrize("name", ["random-0000", "random-0002"])
def test_the_share_of_glass_is_what_an_independent_tracer_sees(name: str) -> None:
    scene = drawn(name).scene
    cameras = make_cameras(scene.cameras, config(views=3, size=40))["train"]
    things = tuple(item for thing in drawn(name).things for item in thing.objects)
    counted = glass_shares(things, cameras)
    # All objects, the backdrop included, by Embree.
    meshes = [trimesh.Trimesh(item.mesh.vertices, item.mesh.faces, process=False) for item in scene.objects]
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    whole = trimesh.util.concatenate(meshes)
    for view in range(len(cameras)):
        origin, directions = pixel_rays(cameras, view)
        directions = directions.reshape(-1, 3)
        first = whole.ray.intersects_first(np.broadcast_to(origin, directions.shape), directions)
        sees = [hit >= 0 and scene.objects[owner[hit]].material.is_glass for hit in first]
        assert 0.02 < counted[view]
        assert counted[view] == pytest.approx(np.mean(sees), abs=2 / 40**2)  # Up to two rays that meet an edge.


def glass_with_ice() -> Thing:
    glasses = (filled_vessel("tumbler", rng=np.random.default_rng(seed)) for seed in range(100))
    return next(thing for thing in glasses if thing.words.endswith("ice"))


@pytest.mark.parametrize(
    ("make", "place", "offset"),
    [(glass_with_ice, -1, (1.0, 0, 0)), (lambda: PANES["panes"](np.random.default_rng(0)), 1, (0, 0, -0.01))],
    ids=["ice in its glass", "a pane in its stand"],
)
def test_what_reaches_into_another_thing_is_refused(
    make: Callable[[], Thing], place: int, offset: tuple[float, float, float]
) -> None:
    thing = make()
    check_inside([thing], where="here")
    objects, item = list(thing.objects), thing.objects[place]
    shift = np.array(offset) * (thing.reach if offset[0] else 1)  # The ice goes to the wall.
    objects[place] = dataclasses.replace(item, mesh=moved(item.mesh, shift.tolist()))
    with pytest.raises(HyalineError, match=re.escape(f"here: {item.name} reaches into {thing.objects[0].name};")):
        check_inside([dataclasses.replace(thing, objects=tuple(objects))], where="here")


@pytest.mark.parametrize("name", ["random-0000", "random-0007", "random-table-0012", "random-nested-12345"])
def test_a_name_says_which_scene_it_is_of(name: str) -> None:
    assert str(parse_random(name)) == name and find_source(name, is_of_files=False) is not None


@pytest.mark.parametrize("name", ["random", "random-7", "random-00007", "random-vase-0007", "random-9" + 18 * "9"])
def test_other_names_mean_no_random_scene(name: str) -> None:
    assert parse_random(name) is None
    with pytest.raises(HyalineError, match="expected a name like random-0007"):
        find_scene(name)
