"""Tests that verify sees every damage, and that the commands that made a dataset give every byte back."""

import dataclasses
import os
import re
import shutil
from pathlib import Path

import pytest
from support import fake_renderer
from support.commands import call, run
from support.synthetic import synthetic_scene

from datagen.scene.folder import save_scene

pytestmark = pytest.mark.promise("R4")

BUILD = (
    "datagen build --scene scene --out data/one --preset tiny --resolution 4 --views 2 --test-views 1 --spp 2"
    " --test-spp 2 --num-layers 2"
)
COMMANDS = (
    BUILD,
    "proxies make data/one --kind box --num-layers 2",
    "datagen add data/one --angles --larger 2 --larger-views 1",
    "datagen add data/one --edit remove:pane",
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
    fake_renderer.install(patch)


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of that folder, as the working directory."""
    shutil.copytree(made, tmp_path / "copy")
    prepare(monkeypatch, tmp_path / "copy")
    return tmp_path / "copy"


def tree(root: Path) -> dict[str, bytes | str]:
    paths = sorted(path for path in root.rglob("*") if path.is_symlink() or not path.is_dir())
    is_file = {path: path.is_file() and not path.is_symlink() for path in paths}
    return {path.relative_to(root).as_posix(): path.read_bytes() if is_file[path] else "no file" for path in paths}


def role(path: str) -> str:
    """Files of one role may be damaged at once: none hides another's damage."""
    name = path.rsplit("/", 1)[-1]
    if name in ("dataset.json", "layers.json", "proxies.json", "edit-masks.json"):
        return "head"
    return "record" if "/records/" in f"/{path}" else "leaf"


def damage(files: list[str], shift: int) -> list[str]:
    """Damages each file, every kind of damage in turn; returns those that are not what they were."""
    damaged: list[str] = []
    for number, file in enumerate(files):
        path, kind = ROOT / file, DAMAGES[(number + shift) % len(DAMAGES)]
        if file in damaged:
            continue
        good = path.read_bytes()
        if kind == "swapped":
            rest = (other for other in files[number + 1 :] if Path(other).suffix == path.suffix)
            other = next(
                (other for other in rest if other not in damaged and (ROOT / other).read_bytes() != good), None
            )
            if other is not None:
                path.write_bytes((ROOT / other).read_bytes())
                (ROOT / other).write_bytes(good)
                damaged += [file, other]
                continue
        path.unlink()
        place = len(good) // 3
        flipped = good[:place] + bytes([good[place] ^ 4]) + good[place + 1 :]
        bad = {"truncated": good[: len(good) // 2], "flipped": flipped, "emptied": b""}
        if kind in bad:
            path.write_bytes(bad[kind])
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


def repair(most: int = 3) -> list[str]:
    """Moves away what is in the way of files, and runs the commands that made the dataset, until verify is content.

    What lies below a lost head is found when that is there again.
    """
    said: list[str] = []
    for _ in range(most):
        answer = call("datagen verify data/one")
        if answer.status == 0:
            return said
        for line in answer.out.splitlines():
            path = Path(line.split(": ")[0])
            if "; expected a f" in line:
                path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
        said += [f"{line} -> {answer.status}: {answer.error}" for line in COMMANDS for answer in [call(line)]]
    assert call("datagen verify data/one").status == 0, said
    return said


@pytest.mark.parametrize("which", ["leaf", "record"])
def test_every_damage_of_every_file_is_named_and_repaired_to_the_same_bytes(
    here: Path, which: str, is_full: bool
) -> None:
    whole = tree(ROOT)
    files = [path for path in whole if role(path) == which and path != "dataset.json"]
    for shift in range(len(DAMAGES)) if is_full else (0,):
        damaged = damage(files, shift)
        answer = call("datagen verify data/one")
        assert answer.status == 1
        unnamed = [file for file in damaged if f"{ROOT / file}: " not in answer.out]
        # Records that are missing stand together in one line, which names three of each folder and counts the others.
        assert all(which == "record" and not os.path.lexists(ROOT / file) for file in unnamed), unnamed
        assert not unnamed or " views have no record (" in answer.out
        lines = repair()
        assert differing(tree(ROOT), whole) == [], lines


def differing(found: dict[str, bytes | str], whole: dict[str, bytes | str]) -> list[str]:
    return [path for path in sorted(found.keys() | whole.keys()) if found.get(path) != whole.get(path)]


@pytest.mark.parametrize(
    "kind",
    [
        *("deleted", "flipped"),
        *(pytest.param(kind, marks=pytest.mark.full) for kind in ("truncated", "emptied", "link", "pipe", "folder")),
    ],
)
def test_a_damaged_head_is_named_and_comes_back_when_its_folder_is_moved_away(here: Path, kind: str) -> None:
    whole = tree(ROOT)
    heads = [path for path in whole if role(path) == "head" and path != "dataset.json"]
    for file in heads:
        damage([file], DAMAGES.index(kind))
        answer = call("datagen verify data/one")
        # Without its head, a variant or a geometry is not known to be there.
        assert answer.status == 1 and f"{ROOT / file}: " in answer.out, (file, answer.out, answer.err)
        away = here / "away" / file
        away.parent.mkdir(parents=True, exist_ok=True)
        (ROOT / file).parent.rename(away)
        for line in COMMANDS:
            run(line)
        assert differing(tree(ROOT), whole) == [], file


LOST_FOR_GOOD = re.compile(r"(.*/)?(proxies|variants)(/[^/]+)?|(.*/)?layers(/straight)?")
"""Folders that nothing else records, or whose number of layers it does not."""


@pytest.mark.parametrize(
    "damage_of_folder", ["deleted", *(pytest.param(kind, marks=pytest.mark.full) for kind in ("link", "pipe", "file"))]
)
def test_every_lost_folder_is_named_and_repaired_to_the_same_bytes(
    here: Path, damage_of_folder: str, is_full: bool
) -> None:
    whole = tree(ROOT)
    folders = [path.relative_to(ROOT).as_posix() for path in sorted(ROOT.rglob("*")) if path.is_dir()]
    folders = [path for path in folders if not LOST_FOR_GOOD.fullmatch(path)]
    depths = sorted({path.count("/") for path in folders})
    for depth in depths if is_full else depths[:2]:
        chosen = [path for path in folders if path.count("/") == depth]
        for path in chosen:
            shutil.rmtree(ROOT / path)
            if damage_of_folder == "link":
                (ROOT / path).symlink_to(here)
            elif damage_of_folder == "pipe":
                os.mkfifo(ROOT / path)
            elif damage_of_folder == "file":
                (ROOT / path).touch()
        assert call("datagen verify data/one").status == 1
        lines = repair()
        assert differing(tree(ROOT), whole) == [], (chosen, lines)


def test_a_link_to_a_folder_that_was_moved_elsewhere_is_kept_and_nothing_is_made_again(here: Path) -> None:
    (ROOT / "images").rename(here / "large disk")
    (ROOT / "images").symlink_to(here / "large disk")
    before, elsewhere = tree(ROOT), tree(here / "large disk")
    assert f"{ROOT}/images: is a link; expected a folder" in call("datagen verify data/one").out
    answer = call(BUILD)
    assert answer.status == 1 and answer.err.count("error: ") == 1
    assert "data/one/images: is a symbolic link, and hyaline does not write through links" in answer.error
    assert (tree(ROOT), tree(here / "large disk")) == (before, elsewhere)


@pytest.mark.parametrize("damage", ["lost", "cut short"])
def test_a_dataset_without_its_head_is_named_by_every_command_and_left_alone(here: Path, damage: str) -> None:
    (ROOT / "dataset.json").unlink()
    if damage == "cut short":
        (ROOT / "dataset.json").write_bytes(b"{}")
    before = tree(ROOT)
    for line in (
        "datagen verify data/one",
        "datagen peel data/one",
        "proxies make data/one",
        "model train paper data/one",
        BUILD,
    ):
        answer = call(line)
        assert answer.status == 1 and answer.err.count("error: ") == 1, answer.err
        assert "data/one" in answer.error, line
    assert tree(ROOT) == before
