"""Tests that an object gets the kind of shape that its masks show."""

import dataclasses

import numpy as np
import pytest
from support.silhouettes import Meets, ball, block, cylinder, sightings_of, traced

from datagen.data.meshes import signed_volume
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.modelling import cylinder as a_cylinder
from datagen.scene.modelling import moved, rotation, turned
from hyaline_photos.fit.found import from_state, to_state
from hyaline_photos.fit.kinds import choose_outside

use_mitsuba()
pytestmark = pytest.mark.usefixtures("coarse_hulls")
UP = np.array([0.0, 0.0, 1.0])


def on_the_table(point: np.ndarray, reach: float) -> float | None:
    return 0.0 if abs(point[2]) < reach else None


LYING = moved(turned(turned(a_cylinder(0.03, 0.08), (0, 1, 0), 90), (0, 0, 1), 35), (0.02, 0, 0.031))


@pytest.mark.parametrize(
    ("meets", "kind"),
    [
        (ball((0.0, 0.01, 0.05), 0.04), "ball"),
        (cylinder(0.03, 0.001, 0.09), "revolution"),
        pytest.param(block((0.0, 0.0, 0.004), (0.04, 0.03, 0.003), np.eye(3)), "box", marks=pytest.mark.full),
        pytest.param(traced(LYING), "hull", marks=pytest.mark.full),
    ],
    ids=["ball", "cylinder", "slab", "lying cylinder"],
)
def test_the_kind_is_the_one_whose_silhouettes_fit(meets: Meets, kind: str) -> None:
    sightings = sightings_of(meets, views=20, size=48)
    found = choose_outside(sightings, 1, UP, mask_errors=0, stands_on=on_the_table)
    glass = found.glass
    assert glass.kind == kind
    assert found.unexplained < 0.03 and not found.overruled
    assert glass.mesh().vertices[:, 2].min() > -1e-3  # Nothing shows that it does not reach into the table.
    mesh, again = glass.mesh(), from_state(to_state(glass)).mesh()
    assert np.array_equal(mesh.vertices, again.vertices)
    assert np.array_equal(mesh.faces, again.faces)


def test_a_known_thing_that_is_placed_in_front_of_what_the_masks_show_does_not_count() -> None:
    turn = rotation((0, 0, 1), 20.0)
    sightings = sightings_of(block((0.0, 0.0, 0.031), (0.04, 0.02, 0.03), turn), views=20, size=48)
    is_hidden = (sightings.first > 0) & (np.arange(48) > 27)
    sightings = dataclasses.replace(sightings, depth=np.where(is_hidden, np.float32(0.5), sightings.depth))
    found = choose_outside(sightings, 1, UP, mask_errors=5, stands_on=on_the_table)
    assert found.unexplained < 0.03
    assert found.glass.kind == "box"
    assert signed_volume(found.glass.mesh()) == pytest.approx(0.08 * 0.04 * 0.06, rel=0.03)
