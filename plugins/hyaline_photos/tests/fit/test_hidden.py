"""Tests that glass keeps its shape where something opaque, known or not, hides a part of it in a few views."""

import numpy as np
import pytest
from support.silhouettes import views_around

from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.modelling import moved, rounded_box
from hyaline_photos.fit.hull import overruled_views
from hyaline_photos.fit.kinds import choose_outside
from hyaline_photos.fit.shapes import Axis, Revolution, revolved
from hyaline_photos.fit.views import Sightings, doubted

UP = np.array([0.0, 0.0, 1.0])
VIEWS, SIZE = 24, 160
HEIGHTS = np.linspace(0, 0.1, 60)
SIDE = np.stack([0.034 + 0.008 * np.cos(2 * np.pi * (HEIGHTS - 0.1) / 0.12), HEIGHTS], axis=1)
"""A vessel of revolution with a waist; radius and height in metres."""
SPOILT = (1, 7, 13, 19)
"""Views whose masks have a hole and a speck."""
CAMERAS = views_around(views=VIEWS, size=SIZE)


def sightings(*, hidden: bool, spoilt: bool, known: bool = False) -> tuple[Sightings, list[int]]:
    """The vessel on a table, with a box beside it that hides its lower part; and the views in which it does.

    Args:
        spoilt: some masks have holes and specks.
        known: the box is, and its outline and the table's are doubted.
    """
    use_mitsuba()
    from datagen.trace.peel import Peeler

    glass = revolved(Axis(point=np.zeros(3), direction=UP), np.concatenate([[(0, 0)], SIDE, [(0, 0.1)]]))
    box = moved(rounded_box((0.04, 0.03, 0.08), bevel=0.001), (-0.009, 0.1, 0.04))
    alone, both, there = Peeler((glass,)), Peeler((glass, box)), Peeler((box,))
    rng, masks, depths, hides = np.random.default_rng(0), [], [], []
    for view in range(VIEWS):
        origin, directions = CAMERAS[view].rays()
        d = directions.reshape(-1, 3)
        whole = (alone.trace(origin, d, 1).shape[0] >= 0).reshape(SIZE, SIZE)
        mask = (both.trace(origin, d, 1).shape[0] == 0).reshape(SIZE, SIZE) if hidden else whole
        if (whole & ~mask).sum() > 0.03 * whole.sum():
            hides.append(view)
        if spoilt and view in SPOILT:
            row, column = rng.permutation(np.argwhere(mask))[0]
            mask[row : row + 3, column : column + 3] = False
            row, column = rng.permutation(np.argwhere(~whole))[0]
            mask[row : row + 2, column : column + 2] = True
        masks.append(mask)
        depths.append(np.where(directions[..., 2] < 0, -origin[2] / directions[..., 2], np.inf))
        if known:
            hits = there.trace(origin, d, 1)
            depths[-1] = np.minimum(depths[-1], np.where(hits.shape[0] >= 0, hits.t[0], np.inf).reshape(SIZE, SIZE))
    first, depth = np.stack(masks).astype(np.uint8), np.stack(depths).astype(np.float32)
    depth = doubted(depth, first) if known else depth
    return Sightings(cameras=CAMERAS, first=first, touched=first > 0, depth=depth, unknown=(1,)), hides


@pytest.mark.parametrize("spoilt", [False, True], ids=["hidden", "hidden, with holes and specks"])
def test_a_vessel_keeps_its_shape_behind_a_box_that_nobody_knows_of(spoilt: bool) -> None:
    seen, hides = sightings(hidden=True, spoilt=spoilt)
    assert len(hides) == 3
    found = choose_outside(seen, 1, UP, mask_errors=5, stands_on=lambda point, reach: 0.0)
    assert {*hides} <= {*found.overruled} <= {*hides, *(SPOILT if spoilt else ())}
    glass = found.glass
    assert isinstance(glass, Revolution) and glass.kind == "revolution"
    assert found.unexplained < 0.02
    assert glass.axis.direction == pytest.approx(UP, abs=0.005)
    assert np.linalg.norm(glass.axis.point[:2]) < 0.0003
    heights = glass.outside[:, 1] + glass.axis.point[2]
    inner = (heights > 0.006) & (heights < 0.095)
    assert glass.outside[inner, 0] == pytest.approx(np.interp(heights[inner], *SIDE.T[::-1]), rel=0.01)


def test_beside_a_known_box_no_view_is_overruled_and_the_foot_stands_on_the_table() -> None:
    seen, hides = sightings(hidden=True, spoilt=False, known=True)
    found = choose_outside(seen, 1, UP, mask_errors=5, stands_on=lambda point, reach: 0.0 if point[2] < reach else None)
    glass = found.glass
    assert isinstance(glass, Revolution) and len(hides) == 3 and not found.overruled
    assert glass.mesh().vertices[:, 2].min() == pytest.approx(0, abs=0.0005)
    heights = glass.outside[:, 1] + glass.axis.point[2]
    inner = (heights > 0.01) & (heights < 0.095)
    assert glass.outside[inner, 0] == pytest.approx(np.interp(heights[inner], *SIDE.T[::-1]), rel=0.01)


def test_views_that_contradict_no_other_are_believed() -> None:
    seen, hides = sightings(hidden=False, spoilt=True)
    assert not hides and not len(overruled_views(seen, 1, UP))
