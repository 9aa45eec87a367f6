"""Tests the comparison with Cycles: what Blender is asked for, and how its answer is judged."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.commands import call
from support.gltf import GltfBuilder

from datagen.data.images import decode_radiance
from datagen.render.mitsuba_scene import radiance_of_environment
from datagen.scene.rig import LIGHT

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
