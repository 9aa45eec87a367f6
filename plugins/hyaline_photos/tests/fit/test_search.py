"""Tests the searches on losses whose lowest place is known."""

import dataclasses

import numpy as np
import pytest
from support.drawn_glass import IS_EVEN, OUTSIDE_OF, PIXELS, TRUTH, misses_of

from hyaline_photos.fit.found import intervals
from hyaline_photos.fit.search import INDEX_HELD, Misses, cells_of, find_absorption, guess, in_even_views, refine, scan
from hyaline_photos.fit.shapes import Glass, Revolution


def best_of_grid(misses: Misses) -> Glass:
    return min(scan(cells_of(OUTSIDE_OF), misses), key=lambda cell: cell[1])[0]


def test_the_grid_tells_a_vessel_from_a_solid_and_the_cells_next_to_the_truth() -> None:
    best = best_of_grid(misses_of(TRUTH))
    assert best.numbers["wall"] == pytest.approx(0.08 * 0.05)
    assert best.numbers["floor"] in (pytest.approx(0.01), pytest.approx(0.015))
    assert "wall" not in best_of_grid(misses_of(OUTSIDE_OF)).numbers


def test_a_solid_of_high_index_is_not_taken_for_a_vessel() -> None:
    sapphire = OUTSIDE_OF.having(ior=1.78)

    def misses(glass: Revolution) -> np.ndarray:
        # A hollow makes up for two thirds of a wrong index.
        off = abs(glass.numbers["ior"] - sapphire.numbers["ior"])
        return np.full((PIXELS, 3), off * (1 / 3 if glass.hollow else 1) + 0.01)

    best = best_of_grid(misses)
    assert "wall" not in best.numbers and best.numbers["ior"] in (1.75, 1.8)


def test_a_filled_vessel_is_told_from_an_empty_one_where_it_may_be_filled() -> None:
    level = 0.74 * OUTSIDE_OF.height  # Between those of the grid.

    def misses(glass: Revolution) -> np.ndarray:
        off = abs(glass.numbers.get("level", 0) - level) / OUTSIDE_OF.height
        return np.full((PIXELS, 3), 0.03 + 0.05 * min(off / 0.01, 1) + 0.02 * min(off, 1))

    found = guess(OUTSIDE_OF, misses, IS_EVEN, label="glass", may_be_filled=True)
    assert found.numbers["level"] == pytest.approx(level, rel=0.04)
    assert "level" not in guess(OUTSIDE_OF, misses, IS_EVEN, label="glass").numbers
    # What explains hardly more than the best empty one is not taken for a drink.
    hardly = guess(OUTSIDE_OF, lambda glass: misses(glass) + 0.3, IS_EVEN, label="glass", may_be_filled=True)
    assert "level" not in hardly.numbers


def test_cells_are_as_dark_as_tinted_glass_and_as_rough() -> None:
    like = dataclasses.replace(OUTSIDE_OF.hollowed(0.08, 0.1, 0.3), absorption=(30.0, 0.0, 6.0)).having(roughness=0.1)
    for glass, _ in scan(cells_of(OUTSIDE_OF), misses_of(TRUTH), like):
        length = glass.numbers.get("wall", 0.05)
        assert np.array(glass.absorption) * length == pytest.approx(np.array([30.0, 0.0, 6.0]) * 0.08 * 0.05)
        assert glass.numbers["roughness"] == 0.1


def test_a_little_frost_does_not_hide_a_wrong_wall() -> None:
    thin, thick = 0.03 * 0.05, 0.2 * 0.05

    def misses(glass: Revolution) -> np.ndarray:
        if "wall" not in glass.numbers:
            return np.ones((PIXELS, 3))
        tint = abs(np.exp(-glass.absorption[0] * glass.numbers["wall"]) - np.exp(-0.2))
        if not any(glass.absorption):
            shape = 0.1 * np.log(glass.numbers["wall"] / thin)
        elif "roughness" in glass.numbers:
            shape = 0.02 + 0.01 * np.log(glass.numbers["wall"] / thin)
        else:
            shape = 0.05 * np.log(thick / glass.numbers["wall"])
        return np.full((PIXELS, 3), tint + shape)

    found = guess(OUTSIDE_OF, misses, IS_EVEN, label="glass")
    assert isinstance(found, Revolution)
    assert found.numbers["wall"] == pytest.approx(thick) and "roughness" not in found.numbers


def test_a_frosted_solid_is_not_taken_for_a_vessel_whose_wall_blurs() -> None:
    def misses(glass: Revolution) -> np.ndarray:
        blur = glass.numbers.get("roughness", 0.0) + (0.1 if "wall" in glass.numbers else 0.0)
        wrong = abs(blur - 0.25) + (0.02 if "wall" in glass.numbers else abs(glass.numbers["ior"] - 1.5))
        return np.full((PIXELS, 3), 0.1 + wrong + sum(glass.absorption))

    found = guess(OUTSIDE_OF, misses, IS_EVEN, label="glass")
    assert isinstance(found, Revolution)
    assert found.hollow is None and found.numbers["roughness"] == 0.25


def test_each_wall_gets_a_tint_of_its_own_before_one_is_chosen() -> None:
    thin, thick = 0.03 * 0.05, 0.2 * 0.05
    tint = np.array([4.0, 32.0, 8.0])

    def misses(glass: Revolution) -> np.ndarray:
        if "wall" not in glass.numbers:
            return np.ones((PIXELS, 3))
        if not any(glass.absorption):
            return np.full((PIXELS, 3), 0.5 + 0.1 * np.log(glass.numbers["wall"] / thin))
        # Thin walls look best with a tint that says nothing about a thick wall's.
        wanted = tint if glass.numbers["wall"] == pytest.approx(thick) else np.array([128.0, 1.0, 128.0])
        wrong = np.log((np.array(glass.absorption) + 1e-3) / wanted)
        return np.broadcast_to(0.1 * np.abs(wrong) + 0.05 * np.log(thick / glass.numbers["wall"]), (PIXELS, 3))

    found = guess(OUTSIDE_OF, misses, IS_EVEN, label="glass")
    assert isinstance(found, Revolution)
    assert found.numbers["wall"] == pytest.approx(thick)
    assert found.absorption == pytest.approx(tint, rel=0.05)


@pytest.mark.parametrize(("gain", "is_kept"), [(0.01, False), (0.03, True)])
def test_tint_and_frost_are_given_up_once_they_explain_too_little(gain: float, is_kept: bool) -> None:
    shaded = dataclasses.replace(OUTSIDE_OF, absorption=(4.0, 8.0, 2.0)).having(roughness=0.06)

    def of_tint(glass: Revolution) -> np.ndarray:
        return np.full((PIXELS, 3), 1.0 - gain * any(glass.absorption))

    def of_frost(glass: Revolution) -> np.ndarray:
        return np.full((PIXELS, 3), 1.0 - gain * (glass.numbers.get("roughness", 0.0) > 0.01))

    tinted, _ = find_absorption(shaded, "absorption", of_tint, IS_EVEN)
    assert all(tinted.absorption) == any(tinted.absorption) == is_kept
    found = list(refine(shaded, of_frost, IS_EVEN, number=0))
    assert ("roughness" in found[-1][0].numbers) == ("roughness" in [name for _, name, _ in found]) == is_kept


def test_rounds_find_every_number_and_its_interval() -> None:
    misses = misses_of(TRUTH)
    current, found = best_of_grid(misses), {}
    for number in range(6):
        for glass, name, value in refine(current, misses, IS_EVEN, number=number):
            found[name], current = value, glass
    assert current.numbers["ior"] == pytest.approx(TRUTH.numbers["ior"], abs=0.01)
    for name, most in (("wall", 0.08), ("floor", 0.05), ("taper", 0.15)):
        assert current.numbers[name] == pytest.approx(TRUTH.numbers[name], rel=most), name
        low, high = intervals(found, 0.0)[name]
        assert low < TRUTH.numbers[name] < high, name
    assert current.absorption == pytest.approx(TRUTH.absorption, rel=0.2, abs=0.3)


@pytest.mark.parametrize(("glass", "held"), [(TRUTH, True), (OUTSIDE_OF, False)], ids=["vessel", "solid"])
def test_the_index_of_a_vessel_waits_for_its_wall(glass: Revolution, held: bool) -> None:
    names = [
        [name for _, name, _ in refine(glass, misses_of(glass), IS_EVEN, number=number)]
        for number in range(INDEX_HELD + 1)
    ]
    assert ["ior" in each for each in names] == [not held] * INDEX_HELD + [True]


@pytest.mark.parametrize("views", [(0, 2, 4, 6), (1, 5), (3,)])
def test_both_halves_of_the_views_have_pixels_whichever_views_see_an_object(views: tuple[int, ...]) -> None:
    view = np.repeat(views, PIXELS // len(views))
    is_even = in_even_views(view)
    assert is_even.sum() == PIXELS / 2
    if len(views) > 1:
        assert not set(view[is_even]) & set(view[~is_even])
