"""Tests first guesses of materials on losses whose lowest place is known."""

import dataclasses

import numpy as np
import pytest
from support.drawn_glass import IS_EVEN, OUTSIDE_OF, PIXELS, TRUTH, misses_of

from hyaline_photos.fit.search import find_absorption, find_index, find_material, find_roughness, penalty, vertex
from hyaline_photos.fit.shapes import Revolution


def test_the_first_guess_of_an_index_may_be_far_away() -> None:
    sapphire = OUTSIDE_OF.having(ior=1.78)
    assert find_index(OUTSIDE_OF, misses_of(sapphire)).numbers["ior"] in (1.75, 1.8)
    vessel = OUTSIDE_OF.hollowed(0.07, 0.13, 0.45)
    assert find_index(vessel, misses_of(vessel.having(ior=1.78))) == vessel


def test_a_solid_is_tinted_after_its_index_was_found() -> None:
    truth = dataclasses.replace(OUTSIDE_OF, absorption=(8.0, 0.0, 20.0)).having(ior=1.8)
    found = find_material(OUTSIDE_OF, misses_of(truth), IS_EVEN)
    assert found.numbers["ior"] == 1.8 and "roughness" not in found.numbers
    assert found.absorption == pytest.approx(truth.absorption, rel=0.25, abs=0.3)


@pytest.mark.parametrize(("gain", "found"), [(0.01, None), (0.03, 0.06)])
def test_glass_is_frosted_only_if_that_explains_enough(gain: float, found: float | None) -> None:
    def misses(glass: Revolution) -> np.ndarray:
        return np.full((PIXELS, 3), 1.0 - gain * (glass.numbers.get("roughness") == 0.06))

    assert find_roughness(OUTSIDE_OF, misses).numbers.get("roughness") == found


@pytest.mark.parametrize(("apart", "index"), [(0.005, 1.65), (0.02, 2.0)])
def test_of_indices_that_explain_frosted_glass_as_well_the_most_usual_is_taken(apart: float, index: float) -> None:
    def misses(glass: Revolution) -> np.ndarray:
        # Frost spreads light as far as a lower index with more of it.
        spread = (glass.numbers["ior"] - 1) * glass.numbers.get("roughness", 0.0)
        wrong = max(0.0, abs(np.log(max(spread, 1e-3) / 0.072)) - 0.2) if glass.numbers["ior"] > 1.6 else 2.0
        return np.full((PIXELS, 3), 1 + wrong + apart * abs(glass.numbers["ior"] - 2.2) / 0.55)

    found = find_roughness(OUTSIDE_OF.having(ior=2.2), misses)
    assert found.numbers["ior"] == pytest.approx(index)
    vessel = OUTSIDE_OF.hollowed(0.07, 0.13, 0.45).having(ior=2.2)
    assert find_roughness(vessel, misses).numbers["ior"] == 2.2


def test_channels_are_searched_apart_and_clear_glass_stays_clear() -> None:
    clear = dataclasses.replace(TRUTH, absorption=(0.0, 0.0, 0.0))
    glass, _ = find_absorption(clear, "absorption", misses_of(clear), IS_EVEN)
    assert glass.absorption == (0.0, 0.0, 0.0)
    glass, found = find_absorption(clear, "absorption", misses_of(TRUTH), IS_EVEN)
    assert glass.absorption[1] == 0.0
    assert found[0].value == pytest.approx(6, rel=0.3)
    assert found[2].value == pytest.approx(20, rel=0.3)


def test_glass_that_lets_no_light_through_does_not_darken_from_round_to_round() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(PIXELS, 3)) * 0.02
    lengths = rng.uniform(0.02, 0.2, (PIXELS, 1))

    def miss(glass: Revolution) -> np.ndarray:
        return penalty(np.exp(-np.array(glass.absorption) * lengths) + noise)

    glass = TRUTH
    for _ in range(10):
        glass, _ = find_absorption(glass, "absorption", miss, IS_EVEN)
    assert max(glass.absorption) * lengths.min() < 10


def test_a_parabola_stays_in_its_bracket_and_falls_back_to_the_least() -> None:
    places = np.linspace(1.4, 1.6, 7)
    assert vertex(places, (places - 1.47) ** 2) == pytest.approx(1.47)
    assert vertex(places, (places - 3.0) ** 2) == pytest.approx(1.6)
    assert vertex(places, -((places - 1.45) ** 2)) == pytest.approx(1.6)
