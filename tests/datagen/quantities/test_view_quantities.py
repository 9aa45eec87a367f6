"""Tests the quantities of views against closed formulas: a ball, a slab, a pane and a cube above a floor."""

from typing import Literal

import numpy as np
import pytest
from support.traced_dataset import BALL, SLAB, glass_scene, write_traced_dataset

from datagen.builder.variants import plan_stereo
from datagen.data.dataset import Dataset, View
from datagen.disk.errors import HyalineError
from datagen.quantities import ViewQuantities, quantities
from datagen.scene.materials import SolidTexture
from datagen.scene.textures import evaluate_texture


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("quantities") / "glasses")


@pytest.fixture(params=range(3))
def found(dataset: Dataset, request: pytest.FixtureRequest) -> ViewQuantities:
    return quantities(dataset.view("train", request.param))


def project(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (column, row) of world points and their distance ahead, by the camera's matrices alone."""
    camera = view.camera
    p_camera = (points - camera.world_from_camera[:3, 3]) @ camera.world_from_camera[:3, :3] * [1, -1, -1]
    image = p_camera @ camera.intrinsics.T
    return image[..., :2] / image[..., 2:], p_camera[..., 2]


def test_depth_and_position_say_the_same_of_every_pixel(found: ViewQuantities) -> None:
    rows, columns = np.indices(found.object_id.shape)
    centres = np.stack([columns, rows], axis=-1) + 0.5
    for position, along_ray, along_axis, ids in (
        (found.position, found.depth_along_ray, found.depth_along_axis, found.object_id),
        (found.opaque_position, found.opaque_depth_along_ray, found.opaque_depth_along_axis, found.opaque_object_id),
    ):
        there = ids > 0
        assert there.any() and not (position[~there].any() or along_ray[~there].any() or along_axis[~there].any())
        pixels, ahead = project(found.view, position[there].astype(np.float64))
        assert np.abs(pixels - centres[there]).max() < 1e-3
        assert np.abs(ahead - along_axis[there]).max() < 1e-4
        origin = found.view.camera.world_from_camera[:3, 3]
        assert np.abs(np.linalg.norm(position[there] - origin, axis=-1) - along_ray[there]).max() < 1e-4


def test_positions_lie_on_the_surfaces_that_the_masks_name(found: ViewQuantities) -> None:
    center, radius = BALL
    on_ball = found.object_mask("ball")
    assert on_ball.any() and np.abs(np.linalg.norm(found.position[on_ball] - center, axis=-1) - radius).max() < 0.01
    on_floor = found.opaque_object_id == 1
    assert on_floor.any() and np.abs(found.opaque_position[on_floor][:, 2]).max() < 1e-4
    names = [item.name for item in found.view.dataset.objects]
    masks = np.stack([found.background, *(found.object_mask(name) for name in names)])
    whole = found.object_mask("floor", amodal=True)
    assert np.array_equal(whole, (found.layers.object_id == 1).any(axis=0)) and whole.sum() > masks[1].sum()
    assert (masks.sum(axis=0) == 1).all() and found.background.any()
    with pytest.raises(HyalineError, match="has no object 'teapot'"):
        found.object_mask("teapot")


@pytest.mark.parametrize("surface", ["first", "opaque"])
def test_the_right_camera_sees_the_point_of_a_pixel_further_left_by_its_disparity(
    dataset: Dataset, surface: Literal["first", "opaque"]
) -> None:
    right, num_seen, num_hidden = plan_stereo(dataset, 0.06).cameras["train"], 0, 0
    for view in dataset.views("train"):
        found, camera = quantities(view), right[view.index]
        points = found.position if surface == "first" else found.opaque_position
        there, disparity = points.any(axis=-1), found.disparity(0.06, surface)
        assert disparity[there].min() > 0.5 and not disparity[~there].any()
        rows, columns = np.nonzero(there)
        pixels = np.stack([columns + 0.5 - disparity[there], rows + 0.5, np.ones(len(rows))])
        directions = (np.linalg.inv(camera.intrinsics) @ pixels).T * [1, -1, -1] @ camera.world_from_camera[:3, :3].T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        origin = camera.world_from_camera[:3, 3]
        hits = found.surfaces.peeler.trace(origin.astype(np.float32), directions.astype(np.float32), 8)
        is_seen = (hits.shape >= 0) & ((surface == "first") | ~found.surfaces.is_glass[hits.shape + 1])
        distance = np.take_along_axis(hits.t, is_seen.argmax(axis=0)[None], axis=0)[0]
        off = np.linalg.norm(origin + distance[:, None] * directions - points[there], axis=-1)
        is_hidden = distance < np.linalg.norm(points[there] - origin, axis=-1) - 1e-3
        assert off[~is_hidden].max() < 1e-3
        num_seen, num_hidden = num_seen + (~is_hidden).sum(), num_hidden + is_hidden.sum()
    assert num_seen > 5000 and 0 < num_hidden < 0.05 * num_seen


def test_masks_and_materials_are_those_of_the_scene(found: ViewQuantities) -> None:
    assert np.array_equal(found.glass, found.view.mask("glass"))
    assert np.array_equal(found.ior, np.array([0, 0, 1.5, 1.6, 1.5, 0], np.float32)[found.object_id])


def test_normals_are_those_of_the_meshes(found: ViewQuantities) -> None:
    shading, geometric = found.normal("shading"), found.normal("geometric")
    there = ~found.background
    assert np.abs(np.linalg.norm(shading[there], axis=-1) - 1).max() < 1e-6 and not shading[found.background].any()
    _, directions = found.view.camera.rays()
    assert ((geometric * directions).sum(axis=-1)[there] < 0).all()
    on_ball, center = found.object_mask("ball"), BALL[0]
    outward = (found.position[on_ball] - center) / np.linalg.norm(found.position[on_ball] - center, axis=-1)[:, None]
    # A ball of 1,280 faces: its flat normals are off by up to 5 degrees, what they are interpolated to by much less.
    assert (shading[on_ball] * outward).sum(axis=-1).min() > np.cos(np.radians(0.3))
    flat = (geometric[on_ball] * outward).sum(axis=-1)
    assert np.cos(np.radians(6)) < flat.min() < np.cos(np.radians(2))
    assert np.abs(geometric[found.object_mask("floor")] - [0, 0, 1]).max() < 1e-6


def test_albedo_is_the_described_colour_at_the_place(found: ViewQuantities) -> None:
    floor = found.object_mask("floor")
    pattern = glass_scene().objects[0].material.color  # type: ignore[union-attr]
    assert isinstance(pattern, SolidTexture)
    assert (
        np.abs(found.albedo[floor] - evaluate_texture(pattern, found.position[floor].astype(np.float64))).max() < 1e-6
    )
    assert np.ptp(found.albedo[floor][:, 0]) > 0.5
    assert np.array_equal(np.isnan(found.albedo).all(axis=-1), found.glass | found.background)
    cube = found.object_mask("cube")
    assert np.array_equal(found.albedo[cube], np.tile(np.array((0.2, 0.6, 0.3), np.float32), (cube.sum(), 1)))


def test_thickness_is_the_length_inside_solid_glass(found: ViewQuantities) -> None:
    _, directions = found.view.camera.rays()
    origin = found.view.camera.world_from_camera[:3, 3]
    center, radius = BALL
    along = (directions * (center - origin)).sum(axis=-1)
    chord = 2 * np.sqrt(np.maximum(radius**2 - ((center - origin) ** 2).sum() + along**2, 0))
    low, high = SLAB
    # Both intersections of each ray with the slab's box.
    with np.errstate(divide="ignore"):
        sides = (np.array([[0.5, -0.4, low], [1.3, 0.4, high]])[:, None, None] - origin) / directions
    slab = np.maximum(sides.max(axis=0).min(axis=-1) - sides.min(axis=0).max(axis=-1), 0)
    blocked = found.object_mask("cube") | found.object_mask("floor") | found.background
    thick = found.glass_thickness
    assert not thick[blocked].any() and (thick > 0.1).any()
    # The ball's mesh is up to 3 mm smaller than the ball: a chord that grazes it may miss it.
    inside = (chord > 0.2) & (slab == 0) & ~blocked & (found.opaque_object_id != 5)
    assert inside.sum() > 20 and np.abs(thick - chord)[inside].max() < 0.02
    only_slab = (slab > 0) & (chord == 0) & found.object_mask("slab")
    assert np.abs(thick - slab)[only_slab].max(initial=0) < 1e-4
    pane = found.object_mask("pane") & (chord == 0) & (slab == 0)
    assert not thick[pane].any()
