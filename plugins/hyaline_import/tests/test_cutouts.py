"""Tests surfaces that an image cuts out, against Mitsuba's masks, Embree, and SciPy's interpolation."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates, zoom
from support.scenes import WHITE, rendered, scene_of
from support.synthetic import look_at

from datagen.data.cameras import Cameras
from datagen.data.images import linear_from_srgb, png_bytes
from datagen.data.meshes import Mesh, check_mesh, face_areas
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import SceneObject
from datagen.scene.images import linear_pixels
from datagen.scene.materials import Diffuse
from datagen.scene.modelling import sheet
from hyaline_import.foreign import ForeignImage
from hyaline_import.pictures import Cut, cut_out, decoded

use_mitsuba()

from datagen.render.mitsuba_scene import load_sensor  # noqa: E402
from datagen.trace.peel import Peeler  # noqa: E402

FINE = 32
"""Texels of an oracle's picture in one of the image."""


def leaf(size: int = 24) -> np.ndarray:
    """Opacity of a leaf with soft edges and a hole; row 0 on top."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    edge = 0.42 - np.hypot(x - 0.5, 0.8 * (y - 0.45)) + 0.06 * np.sin(9 * np.arctan2(y - 0.45, x - 0.5))
    hole = np.hypot(x - 0.6, y - 0.4) - 0.09
    return np.clip(np.minimum(edge, hole) * size / 2 + 0.5, 0, 1).astype(np.float32)


def opacity_at(opacity: np.ndarray, uv: np.ndarray, *, repeats: bool = False) -> np.ndarray:
    """Bilinear, by SciPy."""
    height, width = opacity.shape
    places = [(1 - uv[..., 1]) * height - 0.5, uv[..., 0] * width - 0.5]
    return map_coordinates(opacity.astype(np.float64), places, order=1, mode="grid-wrap" if repeats else "nearest")


def card(height: float = 0.0, *, cells: int = 3, scale: float = 1.0) -> Mesh:
    """A square from (0, 0) to (1, 1), whose image lies on it `scale` times in each direction."""
    flat = sheet((0, 0, height), (1, 0, 0), (0, 1, 0), cells=(cells, cells))
    return dataclasses.replace(flat, uv=(scale * flat.vertices[:, :2]).astype(np.float32))


def cut(mesh: Mesh, opacity: np.ndarray, cutoff: float = 0.5) -> Mesh:
    return cut_out(mesh, Cut(opacity=opacity, cutoff=cutoff, corner_uv=mesh.uv[mesh.faces]), where="leaf")


@pytest.mark.parametrize("image", ["leaf", "noise", "wide"])
@pytest.mark.parametrize(("cutoff", "scale"), [(0.5, 1.0), (0.3, 2.7)])
def test_what_is_left_has_the_area_in_which_interpolated_opacity_reaches_the_cutoff(
    image: str, cutoff: float, scale: float
) -> None:
    rng = np.random.default_rng(1)
    # Noise is smooth: what touches in a saddle of four texels is always parted.
    images = {
        "leaf": leaf(),
        "noise": zoom(rng.random((9, 9)), 4, order=1),
        "wide": zoom(rng.random((5, 17)), 4, order=1),
    }
    opacity = images[image].astype(np.float32)
    mesh = cut(card(scale=scale), opacity, cutoff)
    check_mesh(dataclasses.replace(mesh, uv=mesh.uv / np.float32(scale)), where="leaf")
    place = (np.arange(1500) + 0.5) / 1500
    uv = scale * np.stack(np.meshgrid(place, place), axis=-1)
    expected = float((opacity_at(opacity, uv, repeats=scale > 1) >= cutoff).mean())
    # An outline is straight inside a cell of four texels, where the interpolation's is a hyperbola.
    assert face_areas(mesh).sum() == pytest.approx(expected, abs=0.002)
    assert mesh.uv == pytest.approx(scale * mesh.vertices[:, :2], abs=1e-5)
    assert mesh.normals == pytest.approx(np.tile([0, 0, 1], (len(mesh.vertices), 1)), abs=1e-6)


def test_layers_are_those_hits_of_embree_on_whole_cards_that_are_opaque() -> None:
    cards, opacity = [card(0.0), card(0.3, cells=2), card(0.7, cells=5)], leaf()
    peeler = Peeler(tuple(cut(mesh, opacity) for mesh in cards))
    rng = np.random.default_rng(2)
    origin = np.array([0.5, 0.4, 3.0], np.float32)
    targets = np.concatenate([rng.random((20_000, 2)), np.zeros((20_000, 1))], axis=-1)
    directions = targets - origin
    directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)
    hits = peeler.trace(origin, directions, 3)

    expected, is_clear = np.full((3, len(directions)), -1), np.ones(len(directions), bool)
    found = np.zeros(len(directions), int)
    for index in (2, 1, 0):  # From the top.
        whole = trimesh.Trimesh(cards[index].vertices, cards[index].faces, process=False)
        places, rays, _ = whole.ray.intersects_location(np.tile(origin, (len(directions), 1)), directions)
        amount = opacity_at(opacity, places[:, :2])
        is_clear[rays[np.abs(amount - 0.5) < 0.1]] = False  # An outline may be a tenth of a texel off.
        for ray in rays[amount >= 0.5]:
            expected[found[ray], ray] = index
            found[ray] += 1
    assert is_clear.mean() > 0.8
    assert np.array_equal(hits.shape[:, is_clear], expected[:, is_clear])


def test_a_cut_card_and_its_shadow_look_as_in_mitsubas_mask() -> None:
    import mitsuba as mi

    opacity, material = leaf(), Diffuse(color=(0.2, 0.5, 0.1))
    floor = sheet((-1, -1, 0), (3, 0, 0), (0, 3, 0))
    objects = (
        SceneObject(name="floor", mesh=floor, material=Diffuse(color=(0.6, 0.5, 0.4))),
        SceneObject(name="leaf", mesh=cut(card(0.25), opacity), material=material),
    )
    pose = look_at(np.array([0.5, -1.2, 2.0]), np.array([0.5, 0.5, 0.1]))[None]
    cameras = Cameras(world_from_camera=pose, fov_x=0.7, width=64, height=64)
    ours = rendered(scene_of(*objects, environment=WHITE), cameras, spp=256)

    place = (np.arange(24 * FINE) + 0.5) / (24 * FINE)
    upright = (opacity_at(opacity, np.stack(np.meshgrid(place, place), axis=-1)) >= 0.5)[..., None]
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(upright.astype(np.float32)),  # Its first row is where v is 0.
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
    }

    def square(side: float, place: list[float], bsdf: dict) -> dict:
        to_world = mi.ScalarTransform4f().translate(place).scale([side / 2, side / 2, 1])
        return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}

    def matt(color: list[float]) -> dict:
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}}}

    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 24, "rr_depth": 50},
            "sky": {"type": "constant"},
            "floor": square(3, [0.5, 0.5, 0], matt([0.6, 0.5, 0.4])),
            "leaf": square(1, [0.5, 0.5, 0.25], {"type": "mask", "opacity": texture, "bsdf": matt([0.2, 0.5, 0.1])}),
        }
    )
    theirs = np.array(mi.render(scene, sensor=load_sensor(cameras[0]), spp=256), np.float64)
    assert theirs.std() > 0.1
    assert -10 * np.log10(np.mean((np.clip(ours, 0, 1) - np.clip(theirs, 0, 1)) ** 2)) > 35


def test_fine_noise_is_cut_along_coarser_outlines_and_images_larger_than_needed_are_reduced() -> None:
    noise = np.random.default_rng(3).random((1024, 1024)).astype(np.float32)
    mesh = cut(card(), noise)
    assert len(mesh.faces) < 100_000
    # Means of many texels are near a half everywhere, so that about half of the surface stays.
    assert face_areas(mesh).sum() == pytest.approx(0.5, abs=0.1)


def test_grey_of_16_bits_is_scaled_to_8() -> None:
    data = png_bytes(np.array([[0, 20000], [40000, 65535]], np.uint16))
    encoded = np.array([[0, 78], [156, 255]]) / 255
    assert linear_pixels(data, where="x")[..., 1] == pytest.approx(linear_from_srgb(encoded))
    assert decoded(ForeignImage(name="x", data=data))[..., 2] == pytest.approx(linear_from_srgb(encoded))
