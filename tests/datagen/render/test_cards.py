"""Tests cards of light in the sky: where they are, what they cover, and that truth aims at narrow bright ones."""

import dataclasses

import numpy as np
import pytest
from support.scenes import camera_at, rendered, scene_of
from support.synthetic import quad

from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Card, Lobe, SceneObject, SoftEnvironment
from datagen.scene.materials import Diffuse
from datagen.scene.rig import towards

use_mitsuba()

from datagen.render.mitsuba_scene import has_small_light, radiance_of_environment  # noqa: E402

GREY = SoftEnvironment(zenith=(0.2, 0.2, 0.2), horizon=(0.2, 0.2, 0.2), ground=(0.2, 0.2, 0.2))
BOX = Card(direction=(2.0, 0.0, 0.0), size_deg=(40.0, 10.0), radiance=(3.0, 2.0, 1.0), softness_deg=1.0)


def seen(sky: SoftEnvironment, azimuth_deg: float, elevation_deg: float) -> list[float]:
    return radiance_of_environment(sky, np.array(towards(azimuth_deg, elevation_deg))).tolist()


@pytest.mark.parametrize(
    ("roll_deg", "inside", "outside"),
    [
        (0.0, [(0, 0), (19, 0), (-19, 0), (0, 4), (0, -4)], [(21, 0), (-21, 0), (0, 6), (0, -6), (180, 0), (0, 90)]),
        (90.0, [(0, 19)], [(19, 0)]),
        # Seen from the scene, +y is left of who looks along +x: anticlockwise, its right end goes up.
        (45.0, [(-10, 10)], [(10, 10)]),
    ],
)
def test_a_card_shines_within_its_width_and_height_and_nowhere_else(
    roll_deg: float, inside: list[tuple[float, float]], outside: list[tuple[float, float]]
) -> None:
    sky = dataclasses.replace(GREY, cards=(dataclasses.replace(BOX, roll_deg=roll_deg),))
    for places, radiance in ((inside, [3, 2, 1]), (outside, [0.2] * 3)):
        for place in places:
            assert seen(sky, *place) == pytest.approx(radiance)


def test_a_card_is_half_in_in_the_middle_of_its_edge() -> None:
    assert seen(dataclasses.replace(GREY, cards=(BOX,)), 20, 0) == pytest.approx([1.6, 1.1, 0.6])


def test_a_dark_card_hides_what_is_behind_it_and_the_last_one_counts() -> None:
    lamp = Lobe(direction=(1.0, 0.0, 0.0), radiance=(9.0, 9.0, 9.0), sharpness=4.0)
    flag = dataclasses.replace(BOX, radiance=(0.0, 0.0, 0.0))
    assert seen(dataclasses.replace(GREY, lobes=(lamp,), cards=(BOX, flag)), 5, 0) == pytest.approx([0] * 3)
    assert seen(dataclasses.replace(GREY, lobes=(lamp,), cards=(flag, BOX)), 5, 0) == pytest.approx([3, 2, 1])


def test_narrow_bright_cards_are_aimed_at() -> None:
    def aims(**changes: object) -> bool:
        return has_small_light(dataclasses.replace(GREY, cards=(dataclasses.replace(BOX, **changes),)))

    assert aims()
    assert not aims(size_deg=(40.0, 30.0))
    assert not aims(radiance=(0.0, 0.0, 0.0))


def test_the_truth_is_lit_by_a_card_as_its_irradiance_says() -> None:
    card = Card(direction=(0.5, 0.0, 1.0), size_deg=(12.0, 12.0), radiance=(20.0, 20.0, 20.0), softness_deg=1.0)
    sky = SoftEnvironment(zenith=(0, 0, 0), horizon=(0, 0, 0), ground=(0, 0, 0), cards=(card,))
    floor = SceneObject(name="floor", mesh=quad(0.0), material=Diffuse(color=(0.5, 0.5, 0.5)))
    height, azimuth = np.meshgrid((np.arange(1000) + 0.5) / 1000, np.radians(np.arange(0, 360, 0.25)))
    across = np.sqrt(1 - height**2)  # Of equal heights, all places of a sphere count the same.
    d = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height], axis=-1)
    irradiance = 2 * np.pi * (radiance_of_environment(sky, d)[..., 0] * height).mean()
    found = rendered(scene_of(floor, environment=sky), camera_at((0.0, -0.6, 0.8), fov_x=0.1), spp=256).mean()
    assert found == pytest.approx(0.5 * irradiance / np.pi, rel=0.02)
