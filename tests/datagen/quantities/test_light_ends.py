"""Tests refractive flow and attenuation against Snell, Fresnel and Beer, worked out for a slab of glass."""

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from support.traced_dataset import SLAB, glass_scene, write_traced_dataset

from datagen.data.cameras import Camera, Cameras, look_at
from datagen.data.dataset import Dataset, open_dataset
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.quantities import LightEnds, Surfaces, find_light_ends, quantities, surfaces_of
from datagen.scene.materials import Diffuse, SolidTexture

IOR = 1.6


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dataset]:
    root = tmp_path_factory.mktemp("ends") / "glasses"
    scene = glass_scene()
    (pattern,) = (item for item in scene.objects if item.name == "floor")
    absorbing = dataclasses.replace(scene.objects[2].material, absorption=(4.0, 1.0, 0.0))
    slab = dataclasses.replace(scene.objects[2], material=absorbing)
    write_traced_dataset(root, scene=dataclasses.replace(scene, objects=(pattern, slab)))
    use_mitsuba()
    yield open_dataset(root)


@pytest.fixture(scope="module")
def ends(dataset: Dataset) -> tuple[Camera, LightEnds, Surfaces]:
    surfaces = surfaces_of(dataset)
    pose = look_at(np.array([0.9, -0.6, 1.6]), np.array([0.9, 0.0, 0.5]))
    camera = Camera(world_from_camera=pose, fov_x=0.5, width=40, height=30)
    return camera, find_light_ends(camera, surfaces.tracer, surfaces.is_glass), surfaces


def through_slab(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each pixel: where its ray meets the floor after the slab, the share that comes through, and if it does so."""
    origin, directions = camera.rays()
    o, d = origin.astype(np.float64), directions.astype(np.float64)
    low, high = SLAB
    cos_i = -d[..., 2]
    sin_t = np.sqrt(1 - cos_i**2) / IOR
    cos_t = np.sqrt(1 - sin_t**2)
    flat = d[..., :2] / np.linalg.norm(d[..., :2], axis=-1, keepdims=True)
    enter = o[:2] + d[..., :2] * ((o[2] - high) / cos_i)[..., None]
    leave = enter + flat * ((high - low) * sin_t / cos_t)[..., None]
    end = leave + d[..., :2] * (low / cos_i)[..., None]
    r_s = ((cos_i - IOR * cos_t) / (cos_i + IOR * cos_t)) ** 2
    r_p = ((IOR * cos_i - cos_t) / (IOR * cos_i + cos_t)) ** 2
    transmitted = (1 - (r_s + r_p) / 2) ** 2
    absorbed = np.exp(-np.array([4.0, 1.0, 0.0]) * ((high - low) / cos_t)[..., None])
    inside = np.ones(cos_i.shape, bool)
    for place in (enter, leave):
        inside &= (np.abs(place - [0.9, 0.0]) < 0.399).all(axis=-1)
    return end, transmitted[..., None] * absorbed, inside


def test_flow_is_snells_displacement_behind_a_slab(ends: tuple[Camera, LightEnds, Surfaces]) -> None:
    camera, found, _ = ends
    end, share, inside = through_slab(camera)
    assert inside.sum() > 300 and (found.object_id[inside] == 1).all() and found.has_flow[inside].all()
    assert np.abs(found.position[inside] - np.pad(end, ((0, 0), (0, 0), (0, 1)))[inside]).max() < 1e-4
    p_camera = (np.pad(end, ((0, 0), (0, 0), (0, 1))) - camera.world_from_camera[:3, 3]) @ camera.world_from_camera[
        :3, :3
    ]
    focal = camera.intrinsics[0, 0]
    column = 20 + focal * p_camera[..., 0] / -p_camera[..., 2]
    row = 15 - focal * p_camera[..., 1] / -p_camera[..., 2]
    rows, columns = np.indices(column.shape) + 0.5
    expected = np.stack([column - columns, row - rows], axis=-1)
    assert np.abs(expected[inside]).max() > 1 and np.abs(found.flow - expected)[inside].max() < 0.01
    assert np.abs(-p_camera[..., 2] - found.depth_along_axis)[inside].max() < 1e-4
    assert np.abs(np.linalg.norm(p_camera, axis=-1) - found.distance)[inside].max() < 1e-4
    assert np.abs(found.attenuation - share)[inside].max() < 1e-4


def test_the_rendered_twin_without_glass_warped_by_the_flow_and_dimmed_is_the_rendered_truth() -> None:
    use_mitsuba()
    from datagen.render.truth import Renderer

    sky, scene = 0.5, glass_scene()
    stripes = SolidTexture(pattern="stripes", colors=((0.8, 0.2, 0.1), (0.1, 0.2, 0.8)), scale=0.2)
    floor = dataclasses.replace(scene.objects[0], material=Diffuse(color=stripes))
    glass = dataclasses.replace(scene, objects=(floor, scene.objects[2]))  # A clear slab: it tints no shadow.
    pose = look_at(np.array([0.2, -0.9, 1.5]), np.array([0.9, 0.05, 0.5]))
    cameras = Cameras(world_from_camera=pose[None], fov_x=0.45, width=48, height=36)
    truth, twin = (
        Renderer(dataclasses.replace(glass, objects=objects), max_depth=12).radiance(cameras, 0, spp=64, seed=seed)
        for seed, objects in enumerate((glass.objects, (floor,)))
    )
    surfaces = Surfaces(scene=glass, meshes=tuple(item.mesh for item in glass.objects))
    ends = find_light_ends(cameras[0], surfaces.tracer, surfaces.is_glass)
    rows, columns = np.indices(ends.object_id.shape) + 0.5
    places = [rows + ends.flow[..., 1] - 0.5, columns + ends.flow[..., 0] - 0.5]
    background = np.stack([map_coordinates(twin[..., c], places, order=1, cval=np.nan) for c in range(3)], axis=-1)
    behind = np.isfinite(background[..., 0]) & (np.abs(ends.flow).max(axis=-1) > 0.05) & (ends.object_id == 1)
    assert behind.sum() > 1000
    # What does not come through mirrors the sky, which is equal all over.
    mirrored = (1 - ends.attenuation) * sky
    warped, straight = (np.abs(seen * ends.attenuation + mirrored - truth)[behind] for seen in (background, twin))
    # The floor is lit through the slab, too, a few per cent less; what is left is noise.
    assert warped.mean(axis=0).max() < 0.02 < 0.08 < straight.mean(axis=0).max()


def test_where_there_is_no_glass_there_is_no_flow(dataset: Dataset) -> None:
    found = quantities(dataset.view("train", 0))
    clear = found.object_mask("floor") | found.background
    ends = found.light_ends
    assert clear.any() and np.abs(ends.flow[clear]).max() < 0.01 and np.abs(ends.attenuation[clear] - 1).max() == 0
    assert np.array_equal(ends.has_left[clear], found.background[clear])
    assert np.abs(ends.position - found.position)[found.object_mask("floor")].max() < 1e-4
    assert ends.has_flow[clear].all() and (ends.flow[found.glass & ends.has_flow] != 0).any()
