"""Tests how far numbers of a fit may be off."""

import dataclasses

import numpy as np
import pytest
from support.drawn_glass import IS_EVEN, PIXELS, TRUTH

from hyaline_photos.fit.found import FLOOR_ERROR, WALL_ERROR, WELL, intervals
from hyaline_photos.fit.search import LAST, WORTH_IT, Found, refine
from hyaline_photos.fit.shapes import Revolution

SURE = Found(value=10.0, even=10.0, odd=10.0, before=10.0)
INDEX = Found(value=1.5, even=1.501, odd=1.499, before=1.5)


def curve(*losses: float) -> tuple[tuple[float, float], ...]:
    """The search of an index that was tried in steps of 0.02 around 1.5."""
    return tuple((1.5 + 0.02 * (place - len(losses) // 2), loss) for place, loss in enumerate(losses))


def test_an_interval_is_no_narrower_than_the_values_that_were_tried() -> None:
    found = intervals({"absorption_red": SURE, "wall": SURE}, 0.0)
    assert found == {"absorption_red": pytest.approx((8.0, 12.0)), "wall": pytest.approx((9.6, 10.4))}
    # Less than the least tint was not tried, and a negative one means nothing.
    assert intervals({"absorption_blue": Found(value=0.0, even=0.0, odd=0.0)}, 0.0) == {"absorption_blue": (0.0, 0.5)}


def test_what_the_last_round_moved_is_in_doubt() -> None:
    low, high = intervals({"ior": INDEX}, 0.0)["ior"]
    moved = intervals({"ior": dataclasses.replace(INDEX, before=1.45)}, 0.0)["ior"]
    assert high - low < 0.05 < moved[1] - moved[0] == pytest.approx(0.1)


def test_values_that_explain_pictures_as_well_are_inside() -> None:
    worse = 1 + WORTH_IT
    flat = curve(*(0.5 * WELL * loss for loss in (2, 1 + 3 * WORTH_IT, worse, 1, 1, 1, 2)))
    low, high = intervals({"ior": dataclasses.replace(INDEX, curve=flat)}, 0.0)["ior"]
    assert low == pytest.approx(1.48, abs=1e-3)
    assert high == pytest.approx(1.54 + 0.02 * WORTH_IT, abs=1e-3)


def test_where_pictures_are_explained_badly_all_is_in_doubt() -> None:
    well, badly = (
        intervals({"ior": dataclasses.replace(INDEX, curve=curve(2 * loss, loss, 2 * loss))}, 0.0)["ior"]
        for loss in (0.7 * WELL, 3 * WELL)
    )
    assert well[1] - 1.5 == pytest.approx(1.5 - well[0])
    assert badly[1] - 1.5 == pytest.approx(3 * (well[1] - 1.5))


def test_walls_and_floors_are_known_to_a_share_of_a_pixel() -> None:
    pixel = 20.0
    found = intervals({"wall": SURE, "floor": SURE}, pixel)
    assert found["wall"][1] == pytest.approx(10 + WALL_ERROR * pixel)
    assert found["floor"] == (0.0, pytest.approx(10 + FLOOR_ERROR * pixel))


def test_the_index_of_a_vessel_is_as_uncertain_as_its_wall() -> None:
    wall = dataclasses.replace(SURE, before=9.0)
    alone, beside = intervals({"ior": INDEX}, 0.0)["ior"], intervals({"ior": INDEX, "wall": wall}, 0.0)["ior"]
    assert alone[1] - 1.5 < 0.03
    assert beside == pytest.approx((1.5 - 0.075, 1.5 + 0.075))


def test_the_index_of_a_frosted_solid_is_uncertain() -> None:
    frost = Found(value=0.15, even=0.15, odd=0.15, before=0.15)
    assert intervals({"ior": INDEX, "roughness": frost}, 0.0)["ior"] == pytest.approx((1.4, 1.6))


@pytest.mark.parametrize(("number", "is_last"), [(LAST - 1, False), (LAST, True)])
def test_walls_far_away_that_are_as_good_with_the_same_rim_are_inside(number: int, is_last: bool) -> None:
    wall, rim, floor = TRUTH.numbers["wall"], TRUTH.numbers["wall"] * TRUTH.numbers["taper"], TRUTH.numbers["floor"]

    def misses(glass: Revolution) -> np.ndarray:
        off = abs(glass.numbers["wall"] * glass.numbers["taper"] / rim - 1) + abs(glass.numbers["floor"] / floor - 1)
        return np.full((PIXELS, 3), 0.01 + off)

    found = intervals({name: value for _, name, value in refine(TRUTH, misses, IS_EVEN, number=number)}, 0.0)
    assert (found["wall"][0] < 0.6 * wall < 1.8 * wall < found["wall"][1]) == is_last
    assert 0.8 * floor < found["floor"][0] < floor < found["floor"][1] < 1.2 * floor
