"""Tests that an export appears whole in a new folder, or not at all, touches nothing else, and says the licence."""

import errno
import json
import os
from pathlib import Path

import pytest
from support import fake_renderer
from support.builds import build, tree
from support.commands import Answer, call, run
from support.disk import failing_from, observe, read_state
from support.synthetic import synthetic_scene, write_synthetic_dataset

from datagen.data.dataset import open_dataset
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.folder import save_scene
from hyaline_export.formats import FORMATS


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_synthetic_dataset(tmp_path / "data" / "table")
    return tmp_path


def export(form: str = "nerfstudio", out: str = "out") -> Answer:
    return call(f"datagen export table --format {form} --out {out} --points 50")


def test_the_command_says_where_it_went_and_how_a_tool_opens_it(here: Path) -> None:
    del here
    answer = export("blender")
    assert answer.status == 0 and answer.out == "out\n"
    assert "out: 12 views; 7 train, 1 val, 4 test" in answer.err
    assert answer.error == "next: ns-train nerfacto --data out blender-data"


@pytest.mark.parametrize("form", ["colmap", "huggingface"])
def test_two_exports_of_a_dataset_are_equal_byte_by_byte(form: str, here: Path) -> None:
    assert export(form).status == export(form, "again").status == 0
    assert tree(here / "out") == tree(here / "again") and tree(here / "out")


TAKEN = {
    "an export": lambda: export("colmap"),
    "a file in it": lambda: (Path("out").mkdir(), Path("out/notes.txt").write_text("mine")),
    "a file": lambda: Path("out").write_text("mine"),
    "a link to a full folder": lambda: Path("out").symlink_to("data"),
}


@pytest.mark.parametrize("what", TAKEN)
def test_only_a_new_or_empty_folder_is_written(what: str, here: Path) -> None:
    TAKEN[what]()
    before = tree(here)
    answer = export()
    assert answer.status == 1 and "out: is not empty, or not a folder; " in answer.error
    assert tree(here) == before


def test_a_killed_export_leaves_no_folder_and_does_not_hinder_the_next(here: Path) -> None:
    seen = observe(here, lambda: export())
    whole = {path: data for path, data in seen.states[-1].files.items() if path.startswith("out/")}
    halfway = seen.states[len(seen.states) // 2]
    assert not any(path.startswith("out/") for path in halfway.files)
    left = [path for path in halfway.files if ".hyaline-tmp/" in path]
    assert left and all(path.startswith("out.") for path in left)
    for path in left:
        (here / path).parent.mkdir(parents=True, exist_ok=True)
        (here / path).write_bytes(halfway.files[path])
    (here / "out").rename(here / "first")
    assert export().status == 0
    assert {f"out/{path}": data for path, data in tree(here / "out").items()} == whole


@pytest.mark.parametrize("place", [0.0, 0.9])
def test_a_full_disk_is_one_line_and_leaves_nothing(place: float, here: Path) -> None:
    changes = observe(here, lambda: export()).changes
    (here / "out").rename(here / "first")
    before = read_state(here)
    with failing_from(here, int(place * len(changes)), "ENOSPC") as refused:
        answer = export()
    assert refused and answer.status == 1
    assert answer.error.startswith("error: out: ") and os.strerror(errno.ENOSPC).lower()[:8] in answer.error
    assert read_state(here).files == before.files and read_state(here).folders == before.folders


# The licence


@pytest.fixture(autouse=True)
def no_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """What pictures show has no licence of its own; rays that look for light are traced all the same."""
    use_mitsuba()
    fake_renderer.install(monkeypatch)


CARD_LICENSES = {"CC0-1.0": "license_name: cc0-1.0", "Mine alone": "license_name: mine-alone"}


@pytest.fixture
def scene_folder(tmp_path: Path) -> Path:
    save_scene(synthetic_scene(), tmp_path / "mine")
    return tmp_path / "mine"


def state(scene_folder: Path, terms: str) -> None:
    """What a user does to say the licence of a scene."""
    file = scene_folder / "scene.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "license": terms}))


@pytest.mark.parametrize("terms", [pytest.param("CC0-1.0", marks=pytest.mark.full), "Mine alone"])
def test_every_export_says_the_licence(terms: str, scene_folder: Path, tmp_path: Path) -> None:
    state(scene_folder, terms)
    run(build(scene_folder, tmp_path / "data"))
    for form in FORMATS.built_in:
        answer = call(f"datagen export {tmp_path / 'data'} --format {form} --points 20 --out {tmp_path / form}")
        assert answer.status == 0 and f"licence: {terms}" in answer.err
        assert terms in (tmp_path / form / "LICENSE.txt").read_text()
        heads = [path for name in ("transforms*.json", "dataset.json") for path in (tmp_path / form).glob(name)]
        assert heads or form in ("colmap", "huggingface", "bop", "bop-sensor")
        assert {json.loads(path.read_text())["license"] for path in heads} <= {terms}
    assert CARD_LICENSES[terms] in (tmp_path / "huggingface" / "README.md").read_text()
    run(f"datagen import-dataset {tmp_path / 'nerfstudio'} --out {tmp_path / 'again'}")
    assert open_dataset(tmp_path / "again").license == terms
