"""Tests the scene record and its folder: what users bring, good and bad."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.synthetic import synthetic_scene

from datagen.disk.errors import HyalineError
from datagen.scene.folder import load_scene, save_scene
from datagen.scene.materials import Diffuse, ImageTexture


def edit(folder: Path, change: object) -> None:
    path = folder / "scene.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_a_users_folder_with_an_image_texture_is_copied_whole(tmp_path: Path) -> None:
    scene = synthetic_scene()
    save_scene(scene, tmp_path / "mine")
    Image.fromarray(np.full((4, 4, 3), 200, np.uint8)).save(tmp_path / "mine" / "photo.png")
    texture = {"type": "Diffuse", "color": {"type": "ImageTexture", "path": "photo.png"}}
    edit(tmp_path / "mine", lambda data: data["objects"][1].update(material=texture))
    loaded = load_scene(tmp_path / "mine")
    assert loaded.objects[1].material == Diffuse(color=ImageTexture(path="photo.png"))
    save_scene(loaded, tmp_path / "copy")
    assert (tmp_path / "copy" / "photo.png").read_bytes() == (tmp_path / "mine" / "photo.png").read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(version=7), r"scene\.json: version 7; this program reads version 1"),
        (
            lambda d: d["objects"][0]["material"].update(ior=0),
            r"scene\.json: object pane.material: ior: is 0\.0; expected .* from 1 to below 10",
        ),
        (
            lambda d: d["objects"][0]["material"].update(iro=1.5),
            r"scene\.json: object pane\.material: unknown key 'iro'",
        ),
        (lambda d: d["objects"][0].update(mesh="../evil.ply"), r"names '\.\./evil\.ply'; expected a file inside"),
        (lambda d: d["objects"][0].update(mesh="meshes/none.ply"), r"none\.ply: the file is missing"),
        (lambda d: d["objects"][0].update(name="floor"), r"two objects are called 'floor'"),
        (lambda d: d["objects"][1].update(material={"type": "Gold"}), r"object floor\.material\.type: is 'Gold'"),
        (lambda d: d["objects"][1].update(name="\x1b[2J", mesh=7), r"scene\.json: objects\[1\]\.mesh: is 7"),
        (
            lambda d: d["objects"][0].update(material={"type": "Dielectric", "ior": 1.5}),
            r"object pane: 4 open edges; glass must be a closed mesh",
        ),
    ],
)
def test_a_bad_scene_gets_one_line_that_names_place_and_value(tmp_path: Path, change: object, message: str) -> None:
    save_scene(synthetic_scene(), tmp_path)
    edit(tmp_path, change)
    with pytest.raises(HyalineError, match=message):
        load_scene(tmp_path)
