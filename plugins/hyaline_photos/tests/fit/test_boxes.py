"""Boxes are found again from their masks."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage
from support.silhouettes import Meets, block, sightings_of

from datagen.data.meshes import check_mesh, signed_volume
from datagen.data.queries import check_closed, check_solid
from datagen.scene.atlas import coverage
from datagen.scene.modelling import rotation
from hyaline_photos.fit.boxes import Box, fit_box
from hyaline_photos.fit.views import rays_near
from proxies.solid import enclosure

UP = np.array([0.0, 0.0, 1.0])
CENTER, SIZES, TURN = (0.01, -0.02, 0.052), (0.03, 0.02, 0.05), rotation((0, 0, 1), 28)


def found(meets: Meets, support: float | None = 0.0, wrong: float = 0.0) -> Box:
    box = fit_box(rays_near(sightings_of(meets, wrong=wrong), 1), UP, support)
    assert box is not None
    return box


def corners_of(box: Box) -> np.ndarray:
    signs = np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3)
    return box.center + (signs * box.half_sizes) @ box.axes


def worst_corner(box: Box, center: tuple, sizes: tuple, turn: np.ndarray) -> float:
    """Largest distance in metres from a true corner to the nearest one of the box, whose axes may be swapped."""
    true = Box(center=np.array(center), axes=turn.T, half_sizes=np.array(sizes), rounding=0.0)
    return float(np.linalg.norm(corners_of(true)[:, None] - corners_of(box), axis=-1).min(axis=1).max())


def test_an_upright_box_is_found_to_a_tenth_of_a_pixel_from_masks_that_are_wrong_in_places() -> None:
    box = found(block(CENTER, SIZES, TURN), wrong=0.02)
    assert worst_corner(box, CENTER, SIZES, TURN) < 0.0005  # A pixel is 6 mm wide.
    assert box.rounding < 0.0015
    assert box.unexplained < 0.043


def test_a_pane_that_nearly_fills_the_pictures_does_not_grow_out_of_sight_behind_its_face() -> None:
    center, sizes = (0, 0, 0.09), (0.17, 0.12, 0.003)
    box = found(block(center, sizes, np.eye(3)), support=None)
    assert 2 * box.half_sizes.min() == pytest.approx(0.006, abs=0.0001)
    assert worst_corner(box, center, sizes, np.eye(3)) < 0.0001


def test_a_box_that_stands_on_a_surface_does_not_reach_below_it() -> None:
    box = found(block((0, 0, 0.04), (0.03, 0.03, 0.04), np.eye(3)))
    assert box.center[2] - box.half_sizes[2] == pytest.approx(0, abs=3e-4)


def test_a_pane_does_not_grow_towards_a_known_thing_on_it_whose_mesh_is_too_large() -> None:
    center, sizes, above = (0, 0, 0.09), (0.17, 0.12, 0.003), 0.01
    masked = sightings_of(block(center, sizes, np.eye(3)))
    rays = [masked.cameras[view].rays() for view in range(len(masked.first))]
    origins, directions = (np.stack(values).astype(np.float64) for values in zip(*rays, strict=True))
    to_face = (center[2] + sizes[2] - origins[:, None, None, 2]) / directions[..., 2]
    across = (origins[:, None, None] + to_face[..., None] * directions)[..., :2]
    from_middle = np.where(to_face > 0, np.linalg.norm(across, axis=-1), np.inf)
    # The thing hides the pane within 5 cm, and its mesh within 10 cm.
    first = np.where(from_middle < 0.05, 0, masked.first).astype(np.uint8)
    depth = np.where(from_middle < 0.1, to_face + above / directions[..., 2], masked.depth).astype(np.float32)
    box = fit_box(rays_near(dataclasses.replace(masked, first=first, touched=first > 0, depth=depth), 1), UP)
    assert box is not None
    assert worst_corner(box, center, sizes, np.eye(3)) < 0.0001


def test_a_box_of_which_others_hide_all_edges_is_not_found() -> None:
    seen = sightings_of(block(CENTER, SIZES, TURN))
    inside = ndimage.binary_erosion(seen.first > 0, np.ones((1, 3, 3)), iterations=2)
    seen = dataclasses.replace(seen, first=np.where(inside, 1, 2).astype(np.uint8), unknown=(1, 2))
    assert fit_box(rays_near(seen, 1), UP) is None


@pytest.mark.parametrize("rounding", [0.0002, 0.004])
def test_the_mesh_is_closed_outward_rounded_and_has_texels_of_its_own_everywhere(rounding: float) -> None:
    box = Box(center=np.array(CENTER), axes=TURN.T, half_sizes=np.array(SIZES), rounding=rounding)
    mesh = box.mesh()
    for check in (check_mesh, check_closed, check_solid):
        check(mesh, where="box")
    assert coverage(mesh, 128).max() == 1
    # `proxies check` has nothing against roundings that are finer than texels.
    assert enclosure(mesh, None).problem is None
    # The volume of a box grown by a ball (Steiner's formula).
    a, b, c = 2 * (box.half_sizes - rounding)
    edges, r = a + b + c, rounding
    sides = 2 * (a * b + b * c + c * a)
    volume = a * b * c + sides * r + np.pi * edges * r**2 + 4 / 3 * np.pi * r**3
    assert signed_volume(mesh) == pytest.approx(volume, rel=1e-3)


def test_normals_are_those_of_the_sides_but_on_rounded_edges() -> None:
    box = Box(center=np.zeros(3), axes=np.eye(3), half_sizes=np.array(SIZES), rounding=0.004)
    mesh = box.mesh()
    flat = (np.abs(mesh.vertices) <= box.half_sizes - 0.004 + 1e-7).sum(axis=1) == 2
    assert flat.sum() == 24
    assert np.sort(np.abs(mesh.normals[flat]), axis=1) == pytest.approx(np.array([[0, 0, 1]] * 24), abs=1e-6)
    around = np.clip(mesh.vertices, 0.004 - box.half_sizes, box.half_sizes - 0.004)
    assert mesh.normals == pytest.approx((mesh.vertices - around) / 0.004, abs=1e-4)
