"""Tests drawn maps of the environment: directions as in every map, and light as bright as told."""

import numpy as np
import pytest

from benchmarks.sky import radiance_of_map
from datagen.scene.images import read_map
from hyaline_random.backdrop import SKIES, draw_sky, map_directions, paper_radiance


def test_pixels_lie_in_the_directions_in_which_maps_are_looked_up() -> None:
    shown = map_directions(256).astype(np.float32)
    wanted = np.random.default_rng(0).normal(size=(500, 3))
    wanted /= np.linalg.norm(wanted, axis=-1, keepdims=True)
    assert radiance_of_map(shown, wanted, 0.0) == pytest.approx(wanted, abs=0.02)


def test_white_paper_in_an_even_light_is_as_bright_as_the_light() -> None:
    directions = map_directions(128)
    assert paper_radiance(np.full(directions.shape, 0.7), directions) == pytest.approx(0.7, rel=1e-3)


@pytest.mark.parametrize("shows", SKIES)
def test_a_sky_has_the_light_that_is_told_and_bright_places_in_it(shows: str) -> None:
    radiance = read_map(draw_sky(shows, rng=np.random.default_rng(0)), where=shows)
    assert radiance.shape == (256, 512, 3)
    assert 0.799 < paper_radiance(radiance, map_directions(256)) < 1.001
    assert radiance.max() > 3
