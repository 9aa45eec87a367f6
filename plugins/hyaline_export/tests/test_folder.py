"""Tests that an export appears whole in a new folder, or not at all, and touches nothing else."""

import errno
import os
from pathlib import Path

import pytest
from support.builds import tree
from support.commands import Answer, call
from support.disk import failing_from, observe, read_state
from support.synthetic import write_synthetic_dataset


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
