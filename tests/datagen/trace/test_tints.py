"""Tests metals whose colour is an image, in the truth and in light paths, against Mitsuba and SciPy."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates
from support.scenes import DUSK, camera_at, rendered
from support.synthetic import synthetic_scene

from datagen.data.images import linear_from_srgb
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene, SceneObject
from datagen.scene.materials import Conductor, ImageTexture, Plastic, SolidTexture
from datagen.scene.modelling import sheet
from datagen.scene.textures import evaluate_texture

use_mitsuba()

from datagen.render.mitsuba_scene import environment_plugin, load_sensor  # noqa: E402
from datagen.trace.light_path import LightPathTracer  # noqa: E402
from datagen.trace.surface_tables import Limits, tints_of  # noqa: E402

FLAT = sheet((-1, -1, 0), (2, 0, 0), (0, 2, 0), cells=(2, 2))
PLATE = dataclasses.replace(FLAT, uv=(0.5 + FLAT.vertices[:, :2] / 2).astype(np.float32))
PICTURE = np.random.default_rng(0).integers(0, 256, (6, 9, 3), np.uint8)
STRIPES = SolidTexture(pattern="stripes", colors=((0.9, 0.2, 0.1), (0.3, 0.5, 1.0)), scale=0.7)


def scene_of(material: Conductor | Plastic, folder: Path) -> Scene:
    Image.fromarray(PICTURE).save(folder / "picture.png")
    plate = SceneObject(name="plate", mesh=PLATE, material=material)
    return dataclasses.replace(synthetic_scene(), objects=(plate,), environment=DUSK, folder=folder)


def mirrored(scene: Scene, *, own_uv: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Places on the plate, and what light paths mirror there."""
    rng = np.random.default_rng(1)
    places = np.concatenate([rng.uniform(-0.99, 0.99, (500, 2)), np.zeros((500, 1))], axis=-1)
    origins = np.array([0.4, -0.3, 2.0]) + np.zeros((500, 3))
    directions = places - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    materials = tuple(item.material for item in scene.objects)
    tracer = LightPathTracer((PLATE,), materials, tints_of(scene, own_uv=own_uv))
    paths = tracer.trace(origins.astype(np.float32), directions.astype(np.float32), Limits(max_branches=2))
    return places, paths.end_throughput[1]


def test_light_paths_mirror_the_colour_that_the_image_has_there(tmp_path: Path) -> None:
    scene = scene_of(Conductor(color=ImageTexture(path="picture.png"), roughness=0.0), tmp_path)
    places, found = mirrored(scene)
    linear = linear_from_srgb(PICTURE / 255.0)
    u, v = (0.5 + places[:, :2] / 2).T
    spots = [(1 - v) * 6 - 0.5, u * 9 - 0.5]
    expected = [map_coordinates(linear[..., channel], spots, order=1, mode="nearest") for channel in range(3)]
    assert found == pytest.approx(np.stack(expected, axis=-1), abs=2e-4)
    # Proxies have other uv: metal has its mean there.
    _, found = mirrored(scene, own_uv=False)
    assert found == pytest.approx(np.tile(linear.mean(axis=(0, 1)), (len(found), 1)), rel=0.03)


def test_a_pattern_carved_from_space_tints_metal_too(tmp_path: Path) -> None:
    places, found = mirrored(scene_of(Conductor(color=STRIPES, roughness=0.0), tmp_path))
    expected = evaluate_texture(STRIPES, places)
    assert np.quantile(np.abs(found - expected), 0.9) < 0.02  # But for the softening of edges by texels.


@pytest.mark.parametrize("kind", ["mirror", "rough metal", "plastic"])
def test_pictures_on_metal_and_plastic_look_as_in_mitsuba(kind: str, tmp_path: Path) -> None:
    import mitsuba as mi

    image = ImageTexture(path="picture.png")
    materials = {
        "mirror": Conductor(color=image, roughness=0.0),
        "rough metal": Conductor(color=image, roughness=0.2),
        "plastic": Plastic(color=image, roughness=0.2),
    }
    scene = scene_of(materials[kind], tmp_path)
    cameras = camera_at((0.5, -2.2, 2.0), fov_x=0.7, size=48)
    ours = rendered(scene, cameras, spp=256)

    Image.fromarray(PICTURE[::-1]).save(tmp_path / "upright.png")  # Mitsuba has v = 0 in the first row.
    bitmap = {"type": "bitmap", "filename": str(tmp_path / "upright.png"), "wrap_mode": "clamp"}
    metal = {"type": "conductor", "material": "none", "specular_reflectance": bitmap}
    rough = {"alpha": 0.2, "distribution": "ggx"}
    plastic = {"type": "roughplastic", "diffuse_reflectance": bitmap, "int_ior": 1.5, "ext_ior": 1.0, "nonlinear": True}
    theirs = {"mirror": metal, "rough metal": {**metal, **rough, "type": "roughconductor"}, "plastic": plastic | rough}
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 24, "rr_depth": 50},
            "sky": environment_plugin(scene),
            "plate": {"type": "rectangle", "bsdf": theirs[kind]},
        }
    )
    picture = np.array(mi.render(loaded, sensor=load_sensor(cameras[0]), spp=256), np.float64)
    assert picture.std() > 0.1
    assert -10 * np.log10(np.mean((np.clip(ours, 0, 1) - np.clip(picture, 0, 1)) ** 2)) > 35
