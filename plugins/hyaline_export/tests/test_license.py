"""Tests that a dataset says what may be done with it, by the commands that make it and hand it on."""

import json
from pathlib import Path

import pytest
from support import fake_renderer
from support.builds import FLAGS, build_whole
from support.commands import call, run
from support.gltf import BOX, GltfBuilder
from support.synthetic import synthetic_scene

from datagen.data.dataset import open_dataset
from datagen.disk.records import load_sealed
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.folder import save_scene
from hyaline_export.formats import FORMATS


@pytest.fixture(autouse=True)
def no_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """What pictures show has no licence of its own; rays that look for light are traced all the same."""
    use_mitsuba()
    fake_renderer.install(monkeypatch)


CARD_LICENSES = {"CC0-1.0": "license: cc0-1.0", "Mine alone": "license: other\nlicense_name: mine-alone"}


@pytest.fixture
def scene_folder(tmp_path: Path) -> Path:
    save_scene(synthetic_scene(), tmp_path / "mine")
    return tmp_path / "mine"


def state(scene_folder: Path, terms: str) -> None:
    """What a user does to say the licence of a scene."""
    file = scene_folder / "scene.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "license": terms}))


def glb(path: Path, asset: dict, extensions: dict | None = None) -> Path:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(BOX))
    builder.content["asset"] |= asset
    builder.content |= {} if extensions is None else {"extensions": extensions}
    path.write_bytes(builder.glb())
    return path


def test_datasets_of_scenes_that_code_makes_may_be_used_for_anything(tmp_path: Path) -> None:
    run(f"datagen build --scene random-object-0003 --out {tmp_path / 'data'} {' '.join(FLAGS)}")
    assert load_sealed(tmp_path / "data" / "dataset.json")["license"] == "CC0-1.0"
    assert json.loads((tmp_path / "data" / "scene" / "scene.json").read_text())["license"] == "CC0-1.0"


def test_a_scene_of_ones_own_has_the_licence_that_it_states(scene_folder: Path, tmp_path: Path) -> None:
    build_whole(scene_folder, tmp_path / "silent")
    assert open_dataset(tmp_path / "silent").license == "unknown; ask the author of scene synthetic"
    state(scene_folder, "CC-BY-4.0")
    build_whole(scene_folder, tmp_path / "stated")
    dataset = open_dataset(tmp_path / "stated")
    assert dataset.license == "CC-BY-4.0"
    run(f"datagen add {tmp_path / 'stated'} --edit remove:pane")
    assert open_dataset(tmp_path / "stated" / "variants" / "remove-pane").license == "CC-BY-4.0"


RIGHTS = {
    "copyright": ({"copyright": "2024 (c) Glass Works"}, None, "2024 (c) Glass Works"),
    "Sketchfab": (
        {"extras": {"author": "Ann (https://x.org)", "license": "CC-BY-4.0 (http://y.org)", "title": "Cup"}},
        None,
        "CC-BY-4.0 (http://y.org); by Ann (https://x.org)",
    ),
}


@pytest.mark.parametrize("kind", RIGHTS)
def test_a_foreign_file_brings_its_licence(kind: str, tmp_path: Path) -> None:
    asset, extensions, expected = RIGHTS[kind]
    file = glb(tmp_path / "cup.glb", asset, extensions)
    run(f"datagen import {file} --out {tmp_path / 'scene'}")
    assert json.loads((tmp_path / "scene" / "scene.json").read_text())["license"] == expected
    if kind == "copyright":
        build_whole(file, tmp_path / "data")
        assert open_dataset(tmp_path / "data").license == expected


@pytest.mark.parametrize("terms", [pytest.param("CC0-1.0", marks=pytest.mark.full), "Mine alone"])
def test_every_export_says_the_licence(terms: str, scene_folder: Path, tmp_path: Path) -> None:
    state(scene_folder, terms)
    build_whole(scene_folder, tmp_path / "data")
    for form in FORMATS.built_in:
        answer = call(f"datagen export {tmp_path / 'data'} --format {form} --points 20 --out {tmp_path / form}")
        assert answer.status == 0 and f"licence: {terms}" in answer.err
        assert terms in (tmp_path / form / "LICENSE.txt").read_text()
    heads = [path for form in FORMATS.built_in for path in _heads(tmp_path / form)]
    said = [json.loads(path.read_text()).get("license") for path in heads]
    assert len(said) == 1 + 3 + 3 + 1 + 1 and set(said) == {terms}
    assert CARD_LICENSES[terms] in (tmp_path / "huggingface" / "README.md").read_text()
    run(f"datagen import-dataset {tmp_path / 'nerfstudio'} --out {tmp_path / 'again'}")
    assert open_dataset(tmp_path / "again").license == terms


def _heads(export: Path) -> list[Path]:
    """The files of an export that tell of all its views."""
    return [path for name in ("transforms*.json", "dataset.json") for path in export.glob(name)]
