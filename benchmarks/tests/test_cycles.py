"""Tests the comparison with Cycles: what Blender is asked for, and how its answer is judged."""

import dataclasses
import json
import math
import sys
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.commands import call
from support.gltf import GltfBuilder
from support.meshes import mesh_of
from support.synthetic import synthetic_scene

from benchmarks.blender_truth import Cycles, below_coat, open_cycles
from datagen.data.cameras import Camera, look_at
from datagen.data.images import decode_radiance
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.mitsuba_scene import radiance_of_environment
from datagen.scene.description import RectangleLight, Scene, SceneObject
from datagen.scene.materials import Diffuse, Material, Plastic, ThinDielectric
from datagen.scene.staging import LIGHT

FAKE = """#!{python}
import json, shutil, sys
import numpy as np
job = json.load(open(sys.argv[-2]))
for key in ("sky", "file"):
    shutil.copy(job[key], {folder!r})
shutil.copy(job["ground"]["image"], {folder!r})
json.dump(job, open({folder!r} + "/job.json", "w"))
for half, picture in enumerate(job["pictures"]):
    np.save(picture, np.full((job["height"], job["width"], 3), [0.25, 0.5, 1.0], np.float32) * (0.9 + 0.2 * half))
json.dump({{"version": "5.0", "size": [0.2, 0.1, 0.05]}}, open(sys.argv[-1], "w"))
"""


def box_of(folder: Path) -> Path:
    """A matt box of 10 x 6 x 4 cm."""
    builder = GltfBuilder()
    matt = {"baseColorFactor": [0.5, 0.4, 0.3, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = builder.material(pbrMetallicRoughness=matt)
    builder.node(mesh=builder.mesh(material=material), scale=[0.1] * 3, name="box")
    return builder.written(folder)


def columns(table: str) -> list[str]:
    return [cell.strip() for cell in table.strip().splitlines()[-1].strip("|").split("|")]


def test_blender_is_asked_for_the_same_scene_and_its_pictures_are_judged(tmp_path: Path) -> None:
    asked = tmp_path / "asked"
    asked.mkdir()
    python = tmp_path / "python"
    python.write_text(FAKE.format(python=sys.executable, folder=str(asked)))
    python.chmod(0o700)
    path = box_of(tmp_path)
    answer = call(f"benchmarks cycles {path} --python {python} --out {tmp_path / 'out'} --size 24x16 --spp 8")
    assert answer.status == 0, answer.err
    job = json.loads((asked / "job.json").read_text())
    assert (job["width"], job["height"], job["spp"]) == (24, 16, 4)
    np.testing.assert_allclose(job["linear"], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(job["base"], 0, atol=1e-6)
    sky = decode_radiance((asked / "sky.exr").read_bytes(), where="sky")
    height, width, _ = sky.shape
    for direction, row, column in (((1, 0, 0), 0.5, 0.5), ((0, 1, 0), 0.5, 0.25), ((0, -1, 0), 0.5, 0.75)):
        expected = radiance_of_environment(LIGHT, np.array(direction, float))
        np.testing.assert_allclose(sky[int(row * height), int(column * width)], expected, atol=0.02)
    ground = decode_radiance((asked / "ground.exr").read_bytes(), where="ground")
    assert len(np.unique(ground.reshape(-1, 3), axis=0)) > 1
    name, psnr, noise, below, ratios, size = columns(answer.out)
    assert name == path.name and float(size) == pytest.approx(2, rel=1e-3)
    assert float(below) == pytest.approx(float(noise) - float(psnr), abs=0.11)
    red, green, blue = map(float, ratios.split())
    assert red > green > blue, "the answer is bluer than our picture"
    with Image.open(tmp_path / "out" / f"{path.name}.png") as picture:
        pixels = np.asarray(picture)
        assert pixels.shape == (16, 72, 3)
        np.testing.assert_allclose(pixels[:, 24:48].mean(axis=(0, 1)), [137, 188, 255], atol=1)
    again = call(f"benchmarks cycles {path} --python {python} --out {tmp_path / 'out'} --size 24x16 --spp 8")
    assert again.status == 1 and f"{path.name}.png" in again.error


# Cycles as a rival in rendering truth

use_mitsuba()

CAMERA = Camera(width=6, height=4, fov_x=math.radians(40), world_from_camera=look_at((0, -2, 1), (0, 0, 0)))

ASKED = """#!{python}
import json, sys, time
import numpy as np
job = json.load(open(sys.argv[-1]))
json.dump(job, open({folder!r} + "/job.json", "w"))
color = job["objects"][0]["material"]["color"]
for line in sys.stdin:
    asked = json.loads(line)
    if asked["spp"] > 100:
        sys.exit("no memory left")
    np.save(asked["picture"], np.full((job["height"], job["width"], 3), asked["seed"], np.float32))
    print("Fra:1 Mem:2M", file=sys.stderr)
    print("drawn in", asked["spp"] / 4, file=sys.stderr, flush=True)
"""


def rival(tmp_path: Path, script: str, scene: Scene) -> AbstractContextManager[Cycles]:
    python = tmp_path / "python"
    python.write_text(script.format(python=sys.executable, folder=str(tmp_path)))
    python.chmod(0o700)
    return open_cycles(scene, CAMERA, python=python, max_depth=5)


def lit_box(material: Material) -> Scene:
    lamp = RectangleLight(corner=(-1, 1, 2), edge_u=(2, 0, 0), edge_v=(0, -2, 0), radiance=(3, 2, 1))
    mesh = mesh_of(trimesh.creation.box((1, 1, 1)))
    return dataclasses.replace(
        synthetic_scene(), objects=(SceneObject(name="box", mesh=mesh, material=material),), lights=(lamp,)
    )


def test_a_rival_keeps_the_scene_and_draws_what_it_is_asked_for(tmp_path: Path) -> None:
    with rival(tmp_path, ASKED, lit_box(Plastic(color=(0.5, 0.25, 0.0), ior=1.5, roughness=0.2))) as cycles:
        for seed in (3, 4):
            picture, spp = cycles.radiance(spp=8, seed=seed)
            assert spp == 8 and picture.shape == (4, 6, 3) and (picture == seed).all()
        assert cycles.cpu_seconds == 4
        with pytest.raises(HyalineError, match=r"Blender failed \(no memory left\)"):
            cycles.radiance(spp=101, seed=0)
    job = json.loads((tmp_path / "job.json").read_text())
    assert job["lamps"] == [{"center": [0, 0, 2], "u": [2, 0, 0], "v": [0, -2, 0], "radiance": [3, 2, 1]}]
    material = job["objects"][0]["material"]
    assert (material["kind"], material["ior"], material["alpha"]) == ("Plastic", 1.5, 0.2)
    np.testing.assert_allclose(material["color"], below_coat(np.array([0.5, 0.25, 0.0]), 1.5))


def test_a_white_base_loses_nothing_and_a_dark_one_both_passages_of_its_coat() -> None:
    white, dark = below_coat(np.array([1.0, 1e-9]), 1.5)
    assert white == pytest.approx(1)
    # Diffuse reflectance of an index of 1.5: 0.0918 (Egan and Hilgeman 1979).
    assert dark / 1e-9 == pytest.approx((1 - 0.0918) / 1.5**2, rel=1e-3)


def test_a_rival_that_cannot_start_is_one_line(tmp_path: Path) -> None:
    scene = lit_box(Diffuse(color=(0.5, 0.5, 0.5)))
    without_bpy = rival(tmp_path, "#!{python}\nimport sys\nsys.exit(3)\n", scene)
    with (
        without_bpy as cycles,
        pytest.raises(HyalineError, match=r"has no bpy; `.* -m pip install bpy` brings Blender"),
    ):
        cycles.radiance(spp=1, seed=0)
    nowhere = open_cycles(scene, CAMERA, python=tmp_path / "none", max_depth=5)
    with pytest.raises(HyalineError, match="does not run"), nowhere:
        pass
    with pytest.raises(HyalineError, match="box is ThinDielectric; only Diffuse, Plastic, Conductor, Dielectric"):
        rival(tmp_path, ASKED, lit_box(ThinDielectric(ior=1.5))).__enter__()
