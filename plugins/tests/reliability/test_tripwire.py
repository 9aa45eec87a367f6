"""Tests that no command touches a file that hyaline did not make, however it is called and wherever it writes."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image
from support.commands import Answer, call
from support.disk import State, read_state
from support.gltf import GltfBuilder
from support.scenarios import BUILD, GRID, QUICK, SCENARIOS, TRAIN

from datagen.machine.mitsuba_variant import use_mitsuba

RENDER = "model predict runs/one/paper --device cpu"
IMPORT = "datagen import thing.glb --out mine"

FREE = (
    *(pytest.param(item.start, item.line, marks=() if item.name in QUICK else pytest.mark.full) for item in SCENARIOS),
    ("scene", f"{BUILD} --shard 1/2"),
    ("dataset", "datagen export data/one --format 3dgs --out exports/one"),
    ("scene", IMPORT),
    ("scene", "datagen import-dataset theirs --out mine --overwrite"),
    ("dataset", "datagen film data/one --path spline --frames 2 --spp 2 --out films/truth"),
    ("drawn", f"{RENDER} --variant angles --overwrite"),
    ("run", "model export runs/one/paper --out page.html --overwrite"),
)
"""Prepared states, and commands that write: between them each kind of folder and file."""

TAKEN = (
    ("scene", BUILD, ("data/one/transforms_train.json",)),
    ("scene", f"{BUILD} --overwrite", ("data/one/images/train/0000.png", "data/one/dataset.json")),
    ("scene", f"{BUILD} --shard 1/2", ("data/one/scene/scene.json",)),
    ("dataset", f"{BUILD} --views 2 --overwrite", ("data/one/images/train/0001.png",)),
    ("dataset", "datagen add data/one --larger 2", ("data/one/variants/x2/images/interpolating/0000.png",)),
    ("dataset", "proxies make data/one --kind box", ("data/one/proxies/box/layers/straight/mine.partial",)),
    ("scene", IMPORT, ("mine/meshes/ground.ply",)),
    ("scene", "datagen import-dataset theirs --out mine", ("mine/images/train/0000.png",)),
    ("dataset", "datagen look data/one", ("one-look.html",)),
    ("dataset", "datagen export data/one --format 3dgs --out exports/one", ("exports/one/points3d.ply",)),
    ("dataset", f"{TRAIN} --out runs/one/paper --overwrite", ("runs/one/paper/run.json", "runs/one/paper/weights.pt")),
    ("run", "model film runs/one/paper --device cpu --path spline --frames 2 --out film.webp", ("film.webp",)),
    ("dataset", "model sweep grid.txt", ("runs/one/paper-w8-t8-batch32-2-steps/weights.pt",)),
    ("run", "report", ("runs/report/results.json",)),
)
"""The same, and foreign files in the very places where they would write: they must refuse, and name one of them."""

STRANGERS = (
    "download.partial", "notes.tmp", "0000.png.tmp", "0000.json.12ab34cd.tmp", "points3d.ply", "thesis.tex",
    "9999.png", "weights.pt.bak", "cache.json", "index.md", ".hidden", "predictions/train/0000.png",
    "0000.0123456789abcdef.hyaline-tmp.zip", "mine/run.json", "mine/layers.json", "x9/predictions/train/0000.png",
)  # fmt: skip
"""Foreign files that are put into each folder."""


def put(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(f"precious {path.name}".encode())


def litter(here: Path) -> dict[str, bytes]:
    """Puts foreign files into every folder there is; returns them."""
    before = read_state(here)
    folders = [here / folder for folder in sorted(before.folders)]
    for path in (folder / name for folder in folders for name in STRANGERS):
        if not path.exists():
            put(path)
    for name in STRANGERS:
        put(here / name)
    return {path: data for path, data in read_state(here).files.items() if path not in before.files}


def write_theirs(root: Path) -> None:
    """A dataset as another project lays it out."""
    root.mkdir()
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    for role in ("train", "test"):
        Image.new("RGB", (8, 8)).save(root / f"{role}.png")
        frames = [{"file_path": f"{role}.png", "transform_matrix": pose}]
        (root / f"transforms_{role}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))


@pytest.fixture(scope="module", autouse=True)
def mitsuba() -> None:
    """Light paths are really traced: Mitsuba is ready before `here` keeps commands from starting it."""
    use_mitsuba()


@pytest.fixture
def prepared(start: Callable[[str], State], here: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(here.parent / "cache"))

    def make(name: str) -> None:
        start(name)
        (here / "grid.txt").write_text(GRID)
        builder = GltfBuilder()
        builder.node(mesh=builder.mesh())
        builder.written(here)
        write_theirs(here / "theirs")

    return make


@pytest.mark.parametrize(("state", "line"), FREE)
def test_foreign_files_in_every_folder_stay_as_they_were(
    state: str, line: str, here: Path, prepared: Callable[[str], None]
) -> None:
    prepared(state)
    # Empty folders where commands write belong to nobody: what is begun in a folder must find it empty.
    foreign = litter(here)
    if state == "run" and line.endswith("--overwrite"):
        # What has the name and place of a run's picture is the run's.
        foreign = {path: data for path, data in foreign.items() if not re.search("paper/predictions/.*9999", path)}
    answer = call(line)
    _check_end(answer)
    after = read_state(here).files
    assert {path: after.get(path) for path in foreign} == foreign


@pytest.mark.parametrize(("state", "line", "taken"), TAKEN)
def test_a_foreign_file_where_a_command_would_write_is_named_and_kept(
    state: str, line: str, taken: tuple[str, ...], here: Path, prepared: Callable[[str], None]
) -> None:
    prepared(state)
    for file in taken:
        put(here / file)
    before = read_state(here)
    answer = call(line)
    _check_end(answer)
    after = read_state(here)
    assert answer.status == 1, answer.err
    assert {path: after.files.get(path) for path in taken} == {path: before.files[path] for path in taken}
    assert {path: after.files.get(path) for path in before.files} == before.files, "and nothing else was lost"
    assert any(Path(file).name in answer.err or str(Path(file).parent) in answer.err for file in taken), answer.err


def _check_end(answer: Answer) -> None:
    """It went well, or was refused in one line."""
    assert answer.status in (0, 1), answer.err
    assert "Traceback" not in answer.err
    assert answer.status == 0 or answer.error.startswith("error: "), answer.err
