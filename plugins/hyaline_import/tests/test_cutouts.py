"""Tests surfaces that an image cuts out, against Mitsuba's masks, Embree, and SciPy's interpolation."""

import dataclasses
import io
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import map_coordinates
from support.hostile.pictures import png as png_of
from support.scenes import WHITE, rendered, scene_of
from support.soon import soon
from support.synthetic import look_at, synthetic_scene

from datagen.data.cameras import Cameras
from datagen.data.images import linear_from_srgb, png_bytes
from datagen.data.meshes import Mesh, check_mesh, face_areas
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.cutouts import Cut, corner_uv_of, cut_out, opacity_of
from datagen.scene.description import SceneObject
from datagen.scene.folder import load_scene, save_scene, scene_files
from datagen.scene.images import linear_pixels
from datagen.scene.materials import Diffuse
from datagen.scene.modelling import ball, sheet
from hyaline_import.foreign import ForeignImage
from hyaline_import.pictures import decoded

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
    return cut_out(mesh, Cut(opacity=opacity, cutoff=cutoff, corner_uv=corner_uv_of(mesh)), where="leaf")


@pytest.mark.parametrize("image", ["leaf", "noise", "wide"])
@pytest.mark.parametrize(("cutoff", "scale"), [(0.5, 1.0), (0.3, 2.7)])
def test_what_is_left_has_the_area_in_which_interpolated_opacity_reaches_the_cutoff(
    image: str, cutoff: float, scale: float
) -> None:
    rng = np.random.default_rng(1)
    images = {"leaf": leaf(), "noise": rng.random((9, 9)), "wide": rng.random((5, 17))}
    opacity = images[image].astype(np.float32)
    mesh = cut(card(scale=scale), opacity, cutoff)
    check_mesh(dataclasses.replace(mesh, uv=mesh.uv / np.float32(scale)), where="leaf")
    place = (np.arange(1500) + 0.5) / 1500
    uv = scale * np.stack(np.meshgrid(place, place), axis=-1)
    expected = float((opacity_at(opacity, uv, repeats=scale > 1) >= cutoff).mean())
    # An outline is straight inside a cell of four texels, where the interpolation's is a hyperbola.
    assert face_areas(mesh).sum() == pytest.approx(expected, abs=0.012 if image != "leaf" else 0.002)
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


def png(opacity: np.ndarray, mode: str) -> bytes:
    values = (255 * opacity).round().astype(np.uint8)
    image = Image.fromarray(values)
    if mode == "RGBA":
        image = Image.merge("RGBA", [Image.new("L", image.size, 90)] * 3 + [image])
    data = io.BytesIO()
    image.save(data, format="PNG")
    return data.getvalue()


@pytest.mark.parametrize("mode", ["RGBA", "L"])
def test_a_scene_names_what_cuts_an_object_and_is_written_with_the_cut_mesh(mode: str, tmp_path: Path) -> None:
    uncut = dataclasses.replace(card(0.4), uv=card(scale=2).uv)  # Repeated, so that it gets an atlas of its own.
    leaves = SceneObject(name="leaves", mesh=uncut, material=Diffuse(color=(0.2, 0.5, 0.1)))
    save_scene(dataclasses.replace(synthetic_scene(), objects=(*synthetic_scene().objects, leaves)), tmp_path)
    (tmp_path / "leaf.png").write_bytes(png(leaf(), mode))
    path = tmp_path / "scene.json"
    data = json.loads(path.read_text())
    data["objects"][-1]["cutout"] = {"type": "Cutout", "image": "leaf.png", "cutoff": 0.5}
    path.write_text(json.dumps(data))
    scene = load_scene(tmp_path)
    mesh = scene.objects[-1].mesh
    expected = float((leaf(24) >= 0.5).mean())
    assert face_areas(mesh).sum() == pytest.approx(expected, abs=0.02)
    assert 0 <= mesh.uv.min() <= mesh.uv.max() <= 1
    save_scene(scene, tmp_path / "again")
    assert "cutout" not in (tmp_path / "again" / "scene.json").read_text()
    assert scene_files(load_scene(tmp_path / "again")) == scene_files(scene)


DRAWING = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 4\n%%EndComments\nshowpage\n"
FILES = {
    "leaf.png": png(leaf(), "L"),
    "none.png": png(np.zeros((4, 4)), "L"),
    "text.png": b"leaf",
    "bomb.png": png_of(30_000, 30_000),
    "drawing.png": DRAWING,  # Pillow would hand it to another program.
}
REFUSED: dict[str, tuple[dict[str, object], str]] = {
    "path": ({"image": "../leaf.png"}, r"\.\./leaf\.png"),
    "root": ({"image": "/etc/passwd"}, "passwd"),
    "cutoff": ({"cutoff": 1.5}, r"cutout cutoff: is 1\.5; expected above 0, up to 1"),
    "zero": ({"cutoff": 0}, "cutoff"),
    "words": ({"cutoff": "0.5"}, "cutoff"),
    "gone": ({"image": "none.png"}, "its cutout removes all of it"),
    **{name: ({"image": f"{name}.png"}, "not an image that can be read") for name in ("text", "bomb", "drawing")},
}


def refused_scene(root: Path, change: Callable[[dict], object], index: int = -1) -> str:
    """Why a scene of leaves is not read whose entry is changed."""
    solid = ball(0.2, subdivisions=1)
    solid = dataclasses.replace(solid, uv=(solid.vertices[:, :2] + 0.5).astype(np.float32))
    thing = SceneObject(name="leaves", mesh=solid, material=Diffuse(color=(0.2, 0.5, 0.1)))
    save_scene(dataclasses.replace(synthetic_scene(), objects=(synthetic_scene().objects[1], thing)), root)
    (root / "meshes" / "floor.ply").write_bytes(trimesh.creation.box((1, 1, 0.5)).export(file_type="ply"))
    for name, data in FILES.items():
        (root / name).write_bytes(data)
    path = root / "scene.json"
    data = json.loads(path.read_text())
    data["objects"][index]["cutout"] = {"type": "Cutout", "image": "leaf.png"}
    change(data["objects"][index])
    path.write_text(json.dumps(data))
    with soon(), pytest.raises(HyalineError) as error:
        load_scene(root)
    text = str(error.value)
    assert "\n" not in text and " at 0x" not in text
    return text


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_cut_is_refused_by_name(case: str, tmp_path: Path) -> None:
    change, text = REFUSED[case]
    error = refused_scene(tmp_path, lambda entry: entry["cutout"].update(change))
    assert re.search(text, error) and "leaves" in error


def test_a_solid_and_a_mesh_without_uv_cannot_be_cut(tmp_path: Path) -> None:
    error = refused_scene(tmp_path, lambda entry: entry.update(material={"type": "Dielectric"}))
    assert "leaves" in error and "is solid, and a cutout would open it" in error
    assert "object floor: has no uv for leaf.png; export its mesh with uv" in refused_scene(
        tmp_path, lambda entry: None, index=0
    )


def test_opacity_is_alpha_and_else_brightness() -> None:
    for mode in ("RGBA", "L"):
        assert opacity_of(png(leaf(), mode), where="x") == pytest.approx(leaf(), abs=1 / 500)


def test_grey_of_16_bits_is_scaled_to_8() -> None:
    data = png_bytes(np.array([[0, 20000], [40000, 65535]], np.uint16))
    encoded = np.array([[0, 78], [156, 255]]) / 255
    assert opacity_of(data, where="x") == pytest.approx(encoded)
    assert linear_pixels(data, where="x")[..., 1] == pytest.approx(linear_from_srgb(encoded))
    assert decoded(ForeignImage(name="x", data=data))[..., 2] == pytest.approx(linear_from_srgb(encoded))
