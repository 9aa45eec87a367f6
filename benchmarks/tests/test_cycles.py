"""Tests pictures by Cycles: what Blender is asked for, how its answer is judged, and datasets that are made of it."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.commands import call
from support.gltf import GltfBuilder
from support.meshes import mesh_of
from support.synthetic import synthetic_scene

from datagen.data.dataset import open_dataset
from datagen.data.images import decode_radiance, encode_float_exr
from datagen.render.mitsuba_scene import radiance_of_environment
from datagen.scene.description import SceneObject
from datagen.scene.folder import save_scene
from datagen.scene.materials import Dielectric, Plastic
from datagen.scene.rig import LIGHT

FAKE = """#!{python}
import json, shutil, sys
import numpy as np
job = json.load(open(sys.argv[-2]))
for path in (job["sky"], job.get("file"), *(item.get("image") for item in job["objects"])):
    if path:
        shutil.copy(path, {folder!r})
json.dump(job, open({folder!r} + "/job.json", "w"))
for view in job["views"]:
    for half, picture in enumerate(view["pictures"]):
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


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """An interpreter that pretends to have Blender, and keeps what it is asked for in the folder `asked` beside it."""
    (tmp_path / "asked").mkdir()
    path = tmp_path / "python"
    path.write_text(FAKE.format(python=sys.executable, folder=str(tmp_path / "asked")))
    path.chmod(0o700)
    return path


def test_blender_is_asked_for_the_same_scene_and_its_pictures_are_judged(tmp_path: Path, python: Path) -> None:
    asked = tmp_path / "asked"
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
    (ground,) = job["objects"]
    ground = decode_radiance((asked / Path(ground["image"]).name).read_bytes(), where="ground")
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


def test_a_dataset_has_the_pictures_of_cycles_and_a_second_run_draws_what_is_missing(
    tmp_path: Path, python: Path
) -> None:
    scene = synthetic_scene()
    ball = mesh_of(trimesh.creation.icosphere(2, 0.4).apply_translation((0, 0, 0.5)))
    glass = SceneObject(name="ball", mesh=ball, material=Dielectric(ior=1.4, absorption=(3.0, 1.0, 2.0)))
    floor = dataclasses.replace(scene.objects[1], material=Plastic(color=(0.2, 0.3, 0.4)))
    save_scene(dataclasses.replace(scene, objects=(glass, floor)), tmp_path / "scene")
    sky = np.random.default_rng(0).uniform(-0.1, 1, (4, 8, 3)).astype(np.float32)
    (tmp_path / "map.exr").write_bytes(encode_float_exr({name: sky[..., i] for i, name in enumerate("RGB")}))
    script = Path(__file__).parents[2] / "examples" / "truth_by_cycles.py"
    small = ["--resolution", "8", "--views", "3", "--test-views", "1", "--spp", "8", "--test-spp", "16"]
    words = [sys.executable, script, "scene", "map.exr", "out", "--python", python, *small]
    subprocess.run(words, cwd=tmp_path, check=True)
    dataset = open_dataset(tmp_path / "out")
    view = dataset.view("train", 0)
    assert (view.record.variant, view.record.spp) == ("Cycles of Blender 5.0", 8)
    np.testing.assert_allclose(view.radiance[0, 0], [0.25, 0.5, 1.0], rtol=1e-3)
    np.testing.assert_allclose(view.noise[0, 0], [-0.025, -0.05, -0.1], rtol=1e-3)
    assert view.layers().object_id.any()
    dataset.view("train", 1).record_path.unlink()
    subprocess.run(words, cwd=tmp_path, check=True)
    job = json.loads((tmp_path / "asked" / "job.json").read_text())
    assert [each["world_from_camera"] for each in job["views"]] == [
        dataset.view("train", 1).camera.world_from_camera.tolist()
    ]
    assert job["objects"][0]["inputs"] == {"IOR": 1.4, "Roughness": 0.0}
    assert job["objects"][0]["absorption"] == [3.0, 1.0, 2.0]
    assert (job["objects"][1]["type"], job["objects"][1]["inputs"]) == ("Diffuse", {"Color": [0.2, 0.3, 0.4, 1.0]})
    np.testing.assert_array_equal(
        decode_radiance((tmp_path / "asked" / "sky.exr").read_bytes(), where="sky"), np.maximum(sky, 0)
    )
