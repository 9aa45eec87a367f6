"""Tests which medium fills what several solids share, against a list kept by hand."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from support.meshes import mesh_of

from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.materials import Dielectric, Diffuse, Material
from datagen.scene.media import MAX_NESTED, find_media, medium_of, no_solids, with_solid, without_solid

use_mitsuba()


def cube(x: float = 0.0, size: float = 1.0) -> Mesh:
    return mesh_of(trimesh.creation.box((size, size, size)).apply_translation((x, 0, 0)))


def test_higher_priority_comes_first_and_of_equals_the_one_listed_first() -> None:
    materials: tuple[Material, ...] = (
        Dielectric(ior=1.1),
        Diffuse(color=(0.5, 0.5, 0.5)),
        Dielectric(ior=1.3, priority=2, absorption=(1, 2, 3)),
        Dielectric(ior=1.4, priority=-1),
        Dielectric(ior=1.5),
    )
    media = find_media(materials, tuple(cube(0.1 * index) for index in range(5)))
    assert media.is_nested
    np.testing.assert_array_equal(media.rank, [1, -1, 0, 3, 2])
    np.testing.assert_array_equal(media.ior, np.float32([1.3, 1.1, 1.5, 1.4] + [1] * (MAX_NESTED - 3)))
    np.testing.assert_array_equal(media.absorption[:2], [[1, 2, 3], [0, 0, 0]])
    assert not media.absorption[1:].any()


@pytest.mark.parametrize(("distance", "is_nested"), [(0.0, True), (0.9, True), (1.1, False)])
def test_solids_are_nested_where_their_boxes_meet(distance: float, is_nested: bool) -> None:
    media = find_media((Dielectric(), Dielectric(ior=1.3)), (cube(), cube(distance)))
    assert media.is_nested == is_nested
    assert find_media((Dielectric(), Diffuse(color=(0, 0, 0))), (cube(), cube(distance))).is_nested is False


def test_any_number_of_dielectrics_may_stand_apart_or_have_no_priorities() -> None:
    count = MAX_NESTED + 8
    glass = tuple(Dielectric(ior=1.1 + 0.01 * index) for index in range(count))
    media = find_media(glass, tuple(cube() for _ in range(count)))
    assert not media.is_nested
    np.testing.assert_array_equal(media.rank, np.arange(count))
    assert len(media.ior) == count + 1
    full = find_media(glass[:MAX_NESTED], tuple(cube() for _ in range(MAX_NESTED)))
    assert full.is_nested
    assert len(full.ior) == MAX_NESTED + 1


@given(
    st.lists(st.integers(-9, 9), min_size=2, max_size=MAX_NESTED),
    st.lists(st.integers(0, MAX_NESTED - 1), max_size=20),
)
@settings(max_examples=20, deadline=None, derandomize=True)
def test_the_set_of_solids_gives_the_medium_that_a_list_gives(priorities: list[int], crossings: list[int]) -> None:
    import mitsuba as mi

    glass = tuple(Dielectric(ior=1.1 + 0.01 * index, priority=value) for index, value in enumerate(priorities))
    media = find_media(glass, tuple(cube() for _ in glass))
    solids, inside = mi.UInt32(no_solids(media)), set()
    for crossing in crossings:
        index = crossing % len(glass)
        cross = without_solid if index in inside else with_solid
        inside ^= {index}
        solids = cross(media, solids, mi.UInt32(int(media.rank[index])))
        first = min(inside, key=lambda one: (-priorities[one], one), default=None)
        ior = 1.0 if first is None else glass[first].ior
        assert media.ior[medium_of(media, solids)[0]] == np.float32(ior)


def test_solids_apart_are_entered_from_air_and_left_into_air() -> None:
    import mitsuba as mi

    media = find_media((Dielectric(), Dielectric(ior=1.3)), (cube(), cube(2.0)))
    solids = with_solid(media, mi.UInt32(no_solids(media)), mi.UInt32(1))
    assert media.ior[medium_of(media, solids)[0]] == np.float32(1.3)
    assert media.ior[medium_of(media, with_solid(media, solids, mi.UInt32(0)))[0]] == np.float32(1.5)
    assert media.ior[medium_of(media, without_solid(media, solids, mi.UInt32(0)))[0]] == 1
