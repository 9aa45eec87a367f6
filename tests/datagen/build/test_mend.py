"""Tests that verify sees every damage of every file and folder, and that the commands it names give every byte back."""

import dataclasses
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support import fake_renderer
from support.commands import call, run
from support.synthetic import synthetic_scene

from datagen.build.survey import Survey
from datagen.scene.folder import save_scene

pytestmark = pytest.mark.promise("R4")

BUILD = (
    "datagen build --scene scene --out data/one --preset tiny --resolution 4 --views 2 --test-views 1 --spp 2"
    " --test-spp 2 --num-layers 2"
)
COMMANDS = (
    BUILD,
    "proxies make data/one --kind box --num-layers 2",
    f"{BUILD} --angles --larger 2 --larger-views 1",
    "datagen build --scene scene --out data/one --edit remove:pane",
)
ROOT = Path("data/one")
DAMAGES = ("deleted", "truncated", "flipped", "emptied", "link", "pipe", "folder", "swapped")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene and a dataset that has everything: layers, proxies, every kind of variant."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        prepare(patch, folder)
        scene = synthetic_scene()
        rig = dataclasses.replace(scene.cameras, azimuth_deg=(-100, 100))
        save_scene(dataclasses.replace(scene, name="one", cameras=rig), Path("scene"))
        for line in COMMANDS:
            run(line)
    return folder


def prepare(patch: pytest.MonkeyPatch, folder: Path) -> None:
    patch.chdir(folder)
    patch.setattr(os, "fsync", lambda handle: None)
    patch.setattr("proxies.meshing.meshlab.meshlab_problem", lambda: "left out")
    patch.setattr("proxies.make.meshlab_problem", lambda: None)
    fake_renderer.install(patch)


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of that folder, as the working directory."""
    shutil.copytree(made, tmp_path / "copy")
    prepare(monkeypatch, tmp_path / "copy")
    return tmp_path / "copy"


def tree(root: Path) -> dict[str, bytes | str]:
    survey = Survey(root)
    kinds = {path: kind for path, kind in survey.kinds.items() if kind != "folder"}
    return {path: (root / path).read_bytes() if kind == "file" else kind for path, kind in kinds.items()}


def role(path: str) -> str:
    """Files of one role may be damaged at once: none hides another's damage."""
    if path.startswith("heads/"):
        return "copy"
    name = path.rsplit("/", 1)[-1]
    if name in ("dataset.json", "layers.json", "proxies.json"):
        return "head"
    return "record" if "/records/" in f"/{path}" or name == "edit-masks.json" else "leaf"


def damage(files: list[str], shift: int) -> list[str]:
    """Damages each file, every kind of damage in turn; returns those that are not what they were."""
    damaged: list[str] = []
    for number, file in enumerate(files):
        path, kind = ROOT / file, DAMAGES[(number + shift) % len(DAMAGES)]
        if file in damaged:
            continue
        good = path.read_bytes()
        if kind == "swapped":
            others = (
                other for other in files[number + 1 :] if Path(other).suffix == path.suffix and other not in damaged
            )
            other = next((other for other in others if (ROOT / other).read_bytes() != good), None)
            if other is not None:
                path.write_bytes((ROOT / other).read_bytes())
                (ROOT / other).write_bytes(good)
                damaged += [file, other]
                continue
        path.unlink()
        if kind == "truncated":
            path.write_bytes(good[: len(good) // 2])
        elif kind == "flipped":
            path.write_bytes(good[: len(good) // 3] + bytes([good[len(good) // 3] ^ 4]) + good[len(good) // 3 + 1 :])
        elif kind == "emptied":
            path.write_bytes(b"")
        elif kind == "link":
            (Path("elsewhere") / file).parent.mkdir(parents=True, exist_ok=True)
            (Path("elsewhere") / file).write_bytes(good)
            path.symlink_to(Path("elsewhere", file).absolute())
        elif kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        damaged.append(file)
    return damaged


def mend(most: int = 3) -> list[str]:
    """Runs what verify names, and again, until it is content; returns the lines."""
    lines: list[str] = []
    for _ in range(most):
        answer = call("datagen verify data/one")
        if answer.status == 0:
            return lines
        named = re.findall(r"`([^`]+)`", answer.error)
        assert named, answer.err
        for line in named:
            lines.append(line.replace("--scene FOLDER", "--scene scene"))
            answer = call(lines[-1])
            lines.append(f"-> {answer.status}: {answer.error}")
    assert call("datagen verify data/one").status == 0, (lines, call("datagen verify data/one").out)
    return lines


@pytest.mark.parametrize("which", ["leaf", "record", "head", "copy"])
def test_every_damage_of_every_file_is_named_and_mended_to_the_same_bytes(
    here: Path, which: str, is_full: bool, cases: Callable[[int, str], None]
) -> None:
    whole = tree(ROOT)
    files = [path for path in whole if role(path) == which]
    count = 0
    for shift in range(len(DAMAGES)) if is_full else (0,):
        damaged = damage(files, shift)
        answer = call("datagen verify data/one")
        assert answer.status == 1
        unnamed = [file for file in damaged if f"{ROOT / file}: " not in answer.out]
        # Records that are missing stand together in one line, which names three of each folder and counts the others.
        assert all(which == "record" and not os.path.lexists(ROOT / file) for file in unnamed), unnamed
        assert not unnamed or " unfinished: without records are " in answer.out
        mend()
        assert differing(tree(ROOT), whole) == []
        count += len(damaged)
    cases(count, "damaged files")


def differing(found: dict[str, bytes | str], whole: dict[str, bytes | str]) -> list[str]:
    return [path for path in sorted(found.keys() | whole.keys()) if found.get(path) != whole.get(path)]


@pytest.mark.parametrize(
    "damage_of_folder", ["deleted", *(pytest.param(kind, marks=pytest.mark.full) for kind in ("link", "pipe", "file"))]
)
def test_every_lost_folder_is_named_and_mended_to_the_same_bytes(
    here: Path, damage_of_folder: str, is_full: bool, cases: Callable[[int, str], None]
) -> None:
    whole = tree(ROOT)
    folders = [path for path, kind in Survey(ROOT).kinds.items() if kind == "folder"]
    count = 0
    for copies in (False, True):
        own = [path for path in folders if path.startswith("heads/") == copies and path != "heads"]
        depths = sorted({path.count("/") for path in own})
        for depth in depths if is_full else depths[:2]:
            chosen = [path for path in own if path.count("/") == depth]
            for path in chosen:
                shutil.rmtree(ROOT / path)
                if damage_of_folder == "link":
                    (ROOT / path).symlink_to(here)
                elif damage_of_folder == "pipe":
                    os.mkfifo(ROOT / path)
                elif damage_of_folder == "file":
                    (ROOT / path).touch()
            answer = call("datagen verify data/one")
            assert answer.status == 1
            mend()
            assert differing(tree(ROOT), whole) == [], chosen
            count += len(chosen)
    cases(count, "lost folders")


@pytest.mark.parametrize("moved", ["images", "images/train", "records", "layers"])
def test_a_link_to_a_folder_that_was_moved_elsewhere_is_kept_and_nothing_is_made_again(here: Path, moved: str) -> None:
    (ROOT / moved).rename(here / "large disk")
    (ROOT / moved).symlink_to(here / "large disk")
    before, elsewhere = tree(ROOT), tree(here / "large disk")
    answer = call("datagen mend data/one")
    assert answer.status == 1 and answer.err.count("\n") == 1
    assert f"data/one/{moved}: is a link to a folder with files of the dataset, which nothing is" in answer.error
    assert (tree(ROOT), tree(here / "large disk")) == (before, elsewhere)


def test_lost_copies_of_heads_are_a_remark_since_older_datasets_have_none(here: Path) -> None:
    whole = tree(ROOT)
    shutil.rmtree(ROOT / "heads")
    answer = call("datagen verify data/one")
    assert answer.status == 0
    assert "data/one/heads: there are no second copies" in answer.err and "`datagen mend data/one`" in answer.err
    run("datagen mend data/one")
    assert tree(ROOT) == whole


def test_a_head_that_is_lost_with_its_copy_comes_back_by_the_command_that_built_it_or_by_peeling(here: Path) -> None:
    whole = tree(ROOT)
    pictures = {path: path.stat().st_mtime_ns for path in (ROOT / "images").rglob("*.png")}
    for head in ("dataset.json", "layers/straight/layers.json"):
        (ROOT / head).unlink()
        (ROOT / "heads" / head).unlink()
    answer = call("datagen verify data/one")
    assert answer.status == 1
    assert "dataset.json and its copy heads/dataset.json are lost; build it again with the command" in answer.error
    run(BUILD)
    assert tree(ROOT) == whole
    assert {path: path.stat().st_mtime_ns for path in pictures} == pictures
    shutil.rmtree(ROOT / "heads")
    (ROOT / "layers/straight/layers.json").write_bytes(b"{}")
    mend()
    run("datagen mend data/one")
    assert tree(ROOT) == whole


def test_a_folder_that_is_no_dataset_is_not_mended(here: Path) -> None:
    Path("data/mine/heads").mkdir(parents=True)
    Path("data/mine/heads/dataset.json").symlink_to(here / "precious")
    before = tree(Path("data/mine"))
    for folder, message in (("data/mine", "data/mine: no dataset"), ("data/none", "data/none: no dataset")):
        answer = call(f"datagen mend {folder}")
        assert answer.status == 1
        assert message in answer.error
    assert tree(Path("data/mine")) == before
    assert not Path("data/none").exists()


def test_foreign_files_are_a_remark_and_no_damage(here: Path) -> None:
    (ROOT / "points3d.ply").write_bytes(b"of a Gaussian-splatting tool")
    answer = call("datagen verify data/one")
    assert answer.status == 0
    assert "1 files are no part of the dataset and were not looked at: points3d.ply" in answer.err
    run("datagen mend data/one")
    assert (ROOT / "points3d.ply").read_bytes() == b"of a Gaussian-splatting tool"


def test_an_unfinished_dataset_is_one_line(here: Path) -> None:
    whole = tree(ROOT)
    for folder in (
        "images",
        "records",
        "layers/straight/records",
        "variants",
        "proxies",
        "heads/variants",
        "heads/proxies",
    ):
        shutil.rmtree(ROOT / folder)
    answer = call("datagen verify data/one")
    assert answer.status == 1
    assert answer.out.splitlines() == [
        "data/one: unfinished: without records are 4 of 4 views (records/train/0000.json, records/train/0001.json, "
        "records/interpolating/0000.json and 1 more), 4 of 4 views of layers/straight (layers/straight/records/train/"
        "0000.json, layers/straight/records/train/0001.json, layers/straight/records/interpolating/0000.json and 1 "
        "more); finish it with `datagen mend data/one`"
    ]
    run("datagen mend data/one")
    assert tree(ROOT) == {path: data for path, data in whole.items() if (ROOT / path).exists()}


def test_a_build_that_was_stopped_while_it_rendered_is_finished_by_mend_with_its_layers(
    tmp_path: Path, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(monkeypatch, tmp_path)
    shutil.copytree(made / "scene", "scene")
    calls = []

    def stop(job: fake_renderer.FakeJob, task: fake_renderer.Task) -> None:
        calls.append(task)
        if len(calls) == 3:
            raise KeyboardInterrupt
        fake_renderer.render(job, task)

    with monkeypatch.context() as patch:
        patch.setattr("datagen.build.build.render_task", stop)
        assert call(BUILD).status == 130
    answer = call("datagen verify data/one")
    assert answer.status == 1
    assert len(answer.out.splitlines()) == 1
    assert "unfinished: without records are 2 of 4 views (" in answer.out
    run("datagen mend data/one")
    mended = tree(ROOT)
    ROOT.rename("data/before")
    run(BUILD)
    assert tree(ROOT) == mended


def test_lost_cameras_of_a_dataset_without_near_and_far_come_back_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Datasets of format version 1 have none."""
    prepare(monkeypatch, tmp_path)
    save_scene(dataclasses.replace(synthetic_scene(), name="one"), Path("scene"))
    with monkeypatch.context() as patch:
        patch.setattr("datagen.build.build.with_depth_range", lambda cameras, _: cameras)
        run(BUILD)
    before = tree(ROOT)
    (ROOT / "transforms_train.json").unlink()
    run("datagen mend data/one")
    assert tree(ROOT) == before
