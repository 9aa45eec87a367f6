"""Tests that an export goes on where it was stopped, skips what is finished, and touches nothing but its own files."""

from collections.abc import Callable
from pathlib import Path

import pytest
from support.builds import tree
from support.commands import call
from support.synthetic import write_synthetic_dataset

from datagen.data.dataset import open_dataset
from datagen.export import plan
from datagen.export.formats import export_dataset


@pytest.fixture
def export(tmp_path: Path) -> Callable[..., None]:
    write_synthetic_dataset(tmp_path / "table")

    def run(form: str = "nerfstudio", *, overwrite: bool = False, points: int = 50) -> None:
        dataset = open_dataset(tmp_path / "table")
        export_dataset(dataset, form, tmp_path / "out", num_points=points, flow=False, overwrite=overwrite)

    return run


def test_what_was_stopped_goes_on_and_ends_in_the_same_bytes(
    export: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export("colmap")
    whole = tree(tmp_path / "out")
    (tmp_path / "out").rename(tmp_path / "whole")
    written = []
    commit = plan.commit

    def stop(path: Path, data: bytes) -> None:
        if len(written) == 5:
            raise KeyboardInterrupt
        written.append(path)
        commit(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(plan, "commit", stop)
        with pytest.raises(KeyboardInterrupt):
            export("colmap")
    assert 0 < len(tree(tmp_path / "out")) < len(whole)
    export("colmap")
    assert tree(tmp_path / "out") == whole


def test_finished_parts_are_not_made_again_and_damaged_ones_are(
    export: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export()
    whole = tree(tmp_path / "out")
    written: list[str] = []
    commit = plan.commit

    def watch(path: Path, data: bytes) -> None:
        written.append(path.name)
        commit(path, data)

    monkeypatch.setattr(plan, "commit", watch)
    export()
    assert written == []
    damaged = tmp_path / "out" / "depths" / "train_0003.png"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    (tmp_path / "out" / "transforms.json").unlink()
    export()
    assert sorted(written) == ["train_0003.png"] * 3 + ["transforms.json"]
    assert tree(tmp_path / "out") == whole


def test_another_export_is_replaced_only_when_told_and_strangers_stay(
    export: Callable[..., None], tmp_path: Path
) -> None:
    export("nerfstudio")
    stranger = tmp_path / "out" / "images" / "mine.png"
    stranger.write_bytes(b"precious")
    before = tree(tmp_path / "out")
    for line, reason in (("3dgs", "format: nerfstudio -> 3dgs"), ("nerfstudio", "points: 50 -> 60")):
        answer = call(f"datagen export {tmp_path}/table --format {line} --out {tmp_path}/out --points 60")
        assert answer.status == 1 and f"holds another export ({'format: nerfstudio -> 3dgs; ' * (line == '3dgs')}" in (
            answer.error
        )
        assert reason in answer.error and "pass --overwrite" in answer.error
    assert tree(tmp_path / "out") == before
    export("3dgs", overwrite=True)
    after = tree(tmp_path / "out")
    assert after.pop("images/mine.png") == b"precious"
    assert "points3d.ply" in after and not any(file.startswith(("images/", "depths/")) for file in after)
    stranger.unlink()
    stranger.parent.rmdir()
    export("nerfstudio", overwrite=True)
    assert tree(tmp_path / "out") == {file: data for file, data in before.items() if file != "images/mine.png"}


def test_a_folder_of_something_else_is_refused(export: Callable[..., None], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    answer = call(f"datagen export {tmp_path}/table --format blender --out {tmp_path}/out --overwrite")
    assert answer.status == 1 and "is not empty (notes.txt) and no export; choose another --out" in answer.error
    assert tree(tmp_path / "out") == {"notes.txt": b"mine"}


def test_the_command_says_where_it_went_and_how_a_tool_opens_it(tmp_path: Path, export: Callable[..., None]) -> None:
    del export
    answer = call(f"datagen export {tmp_path}/table --format blender --out {tmp_path}/out")
    assert answer.status == 0 and answer.out == f"{tmp_path}/out\n"
    assert f"{tmp_path}/out: 12 views; 7 train, 1 val, 4 test" in answer.err
    assert answer.error == f"next: ns-train nerfacto --data {tmp_path}/out blender-data"
