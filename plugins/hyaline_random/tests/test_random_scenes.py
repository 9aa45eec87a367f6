"""Tests `datagen build --scene random`: names, many at once, and which flags go together."""

from pathlib import Path

import pytest
from support import fake_renderer
from support.commands import call, run

from datagen.data.dataset import open_dataset
from datagen.data.meshes import Mesh
from datagen.disk.storage import sha256
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.folder import open_scene

SIZE = "--preset tiny --resolution 4 --views 2 --test-views 1 --spp 2 --test-spp 2 --num-layers 2"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which builds neither render nor unwrap."""

    def as_they_are(meshes: dict[str, Mesh]) -> dict[str, Mesh]:
        return meshes

    use_mitsuba()  # Textures are baked by it.
    monkeypatch.setattr("datagen.scene.mending.unwrap_all", as_they_are)
    fake_renderer.install(monkeypatch)
    return tmp_path


def test_count_builds_a_dataset_for_each_seed_and_its_name_builds_the_same_scene(here: Path) -> None:
    answer = call(f"datagen build --scene random --family object --seed 3 --count 2 {SIZE} --out many")
    names = ["random-object-0003", "random-object-0004"]
    assert answer.out.split() == [f"many/{name}" for name in names]
    for seed, name in enumerate(names, 3):
        dataset = open_dataset(here / "many" / name)
        assert (dataset.config.scene, dataset.config.seed) == (name, seed)
        assert open_scene(dataset).name == name
    run(f"datagen build --scene random-object-0003 --seed 3 {SIZE}")
    described = [Path(root, names[0], "scene/scene.json").read_bytes() for root in ("many", "data")]
    assert sha256(described[0]) == sha256(described[1])


def test_a_scene_that_fails_is_named_and_does_not_stop_the_others(here: Path) -> None:
    (here / "many/random-object-0004").mkdir(parents=True)
    (here / "many/random-object-0004/thesis.tex").write_text("precious")
    line = f"datagen build random --family object --seed 3 --count 3 {SIZE} --out many"
    answer = call(f"{line} --quiet")
    assert answer.status == 1 and answer.error.startswith("error: 1 of 3 scenes failed (see above)")
    assert "failed: random-object-0004: many/random-object-0004: is not empty (thesis.tex)" in answer.err
    assert all((here / f"many/random-object-000{seed}/dataset.json").is_file() for seed in (3, 5))
    (here / "many/random-object-0004/thesis.tex").unlink()
    assert call(line).status == 0


@pytest.mark.parametrize(
    ("flags", "status", "error"),
    [
        ("--scene drinks --count 2", 2, "--family, --count: only for random scenes"),
        ("--family table", 2, "--family, --count: only for random scenes"),
        ("--scene random --count 0", 2, "--count: is 0"),
        ("--scene random --seed -1", 1, "seed: is -1"),
        ("--scene random-12", 1, "scene random-12: is not a random scene"),
    ],
)
def test_flags_that_do_not_go_together_are_refused(here: Path, flags: str, status: int, error: str) -> None:
    answer = call(f"datagen build {flags} {SIZE}")
    assert answer.status == status and error in answer.error
    assert not (here / "data").exists()
