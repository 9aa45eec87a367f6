"""Tests that no command touches a file that hyaline did not make, however it is called and wherever it writes."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image
from support.commands import Answer, call
from support.disk import State, read_state
from support.gltf import GltfBuilder
from support.scenarios import BUILD, GRID, TRAIN

from datagen.machine.mitsuba_variant import use_mitsuba
from model.run.sweep import Failure

RENDER = "model predict runs/one/paper --device cpu"
REPORT = "report runs --data data"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trip:
    """A command that writes, among files that are not its own."""

    line: str
    start: str = "dataset"
    """The prepared state that it starts from."""
    taken: tuple[str, ...] = ()
    """Foreign files in the very places where it would write: it must refuse, and name one of them."""


TRIPS = (
    Trip(line=BUILD, start="scene"),
    Trip(line=f"{BUILD} --seed 1 --overwrite", start="proxies"),
    Trip(line=f"{BUILD} --shard 1/2", start="scene"),
    Trip(line="datagen add data/one --edit remove:pane --overwrite"),
    Trip(line="datagen add data/one --angles --larger 2"),
    Trip(line="datagen peel data/one --num-layers 3 --overwrite"),
    Trip(line="datagen export data/one --format 3dgs --out exports/one"),
    Trip(line="datagen pack data/one --out exports/one.tar"),
    Trip(line="datagen unpack exports/one.tar --out data/two", start="packed"),
    Trip(line="datagen import thing.glb --out mine --overwrite", start="scene"),
    Trip(line="datagen import-dataset theirs --out mine --overwrite", start="scene"),
    Trip(line="datagen film data/one --path spline --frames 2 --spp 2 --out films/truth"),
    Trip(line="proxies make data/one --kind box --overwrite", start="proxies"),
    Trip(line=f"{TRAIN} --out runs/one/paper --seed 1 --overwrite", start="run"),
    Trip(line=f"{RENDER} --variant angles --overwrite", start="drawn"),
    Trip(line="model export runs/one/paper --out page.html --overwrite", start="run"),
    Trip(line="model sweep grid.toml"),
    Trip(line=REPORT, start="run"),
    # What is not ours stands where the command would write.
    Trip(line=BUILD, start="scene", taken=("data/one/transforms_train.json",)),
    Trip(line=f"{BUILD} --overwrite", start="scene", taken=("data/one/images/train/0000.png", "data/one/dataset.json")),
    Trip(line=f"{BUILD} --shard 1/2", start="scene", taken=("data/one/scene/scene.json",)),
    Trip(line=f"{BUILD} --views 2 --overwrite", taken=("data/one/images/train/0001.png",)),
    Trip(line="datagen add data/one --larger 2", taken=("data/one/variants/x2/images/interpolating/0000.png",)),
    Trip(line="proxies make data/one --kind box", taken=("data/one/proxies/box/meshes/floor.ply",)),
    Trip(line="proxies make data/one --kind box", taken=("data/one/proxies/box/layers/straight/mine.partial",)),
    Trip(line="datagen import thing.glb --out mine --overwrite", start="scene", taken=("mine/meshes/ground.ply",)),
    Trip(line="datagen import-dataset theirs --out mine", start="scene", taken=("mine/images/train/0000.png",)),
    Trip(line="datagen pack data/one --out exports/one.tar", taken=("exports/one.tar",)),
    Trip(line="datagen unpack exports/one.tar --out data/two", start="packed", taken=("data/two/dataset.json",)),
    Trip(line="datagen look data/one", taken=("one-look.html",)),
    Trip(line="datagen export data/one --format 3dgs --out exports/one", taken=("exports/one/points3d.ply",)),
    Trip(
        line=f"{TRAIN} --out runs/one/paper --overwrite", taken=("runs/one/paper/run.json", "runs/one/paper/weights.pt")
    ),
    Trip(
        line="model film runs/one/paper --device cpu --path spline --frames 2 --out film.webp",
        start="run",
        taken=("film.webp",),
    ),
    Trip(line="model sweep grid.toml", taken=("runs/one/paper-w8-t8-batch32-2-steps/weights.pt",)),
    Trip(line=REPORT, start="run", taken=("runs/report/results.json",)),
)
"""Between them they write each kind of folder and file, and each kind of command is among them."""

STRANGERS = (
    "download.partial", "notes.tmp", "0000.png.tmp", "0000.json.12ab34cd.tmp", "points3d.ply", "thesis.tex",
    "0001.json", "9999.png", "weights.pt.bak", "cache.json", "index.md", ".hidden", "predictions/train/0000.png",
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


def in_process(arguments: tuple[str, ...], *_: object) -> Failure | None:
    answer = call(" ".join(["model", "train", *arguments]))
    return None if answer.status == 0 else Failure(command="model train", reason=answer.error)


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
    use_mitsuba(quiet=True)


@pytest.fixture
def prepared(start: Callable[[str], State], here: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    # A sweep's runs are commands of their own, each in a process; here they are called in this one.
    monkeypatch.setattr("model.run.sweep._train_in_child", in_process)
    monkeypatch.setenv("XDG_CACHE_HOME", str(here.parent / "cache"))

    def make(name: str) -> None:
        start(name)
        (here / "grid.toml").write_text(GRID)
        builder = GltfBuilder()
        builder.node(mesh=builder.mesh())
        builder.written(here)
        write_theirs(here / "theirs")

    return make


FREE = [trip for trip in TRIPS if not trip.taken]
TAKEN = [trip for trip in TRIPS if trip.taken]


@pytest.mark.parametrize("trip", FREE, ids=lambda trip: f"{trip.line} ({trip.start})")
def test_foreign_files_in_every_folder_stay_as_they_were(
    trip: Trip, here: Path, prepared: Callable[[str], None]
) -> None:
    prepared(trip.start)
    # Empty folders where commands write belong to nobody: what is begun in a folder must find it empty.
    foreign = litter(here)
    answer = call(trip.line)
    _check_end(answer)
    after = read_state(here).files
    assert {path: after.get(path) for path in foreign} == foreign


@pytest.mark.parametrize("trip", TAKEN, ids=lambda trip: f"{trip.line} ({', '.join(trip.taken)})")
def test_a_foreign_file_where_a_command_would_write_is_named_and_kept(
    trip: Trip, here: Path, prepared: Callable[[str], None]
) -> None:
    prepared(trip.start)
    for file in trip.taken:
        put(here / file)
    before = read_state(here)
    answer = call(trip.line)
    _check_end(answer)
    after = read_state(here)
    assert answer.status == 1, answer.err
    assert {path: after.files.get(path) for path in trip.taken} == {path: before.files[path] for path in trip.taken}
    assert {path: after.files.get(path) for path in before.files} == before.files, "and nothing else was lost"
    assert any(Path(file).name in answer.err or str(Path(file).parent) in answer.err for file in trip.taken), answer.err


@pytest.mark.parametrize("name", ["data/one", "runs/one/paper", "runs/report"])
def test_a_link_to_a_foreign_folder_is_not_followed(name: str, here: Path, prepared: Callable[[str], None]) -> None:
    prepared("run")
    other = here / "elsewhere"
    inner = {"data/one": "images", "runs/one/paper": "predictions", "runs/report": "."}[name]
    place = here / name / inner
    if inner == ".":
        put(other / "results.json")
        place = here / name
    else:
        (here / name / inner).rename(other)
    place.symlink_to(other)
    before = read_state(other)
    line = {
        "data/one": f"{BUILD} --seed 1 --overwrite",
        "runs/one/paper": f"{RENDER} --overwrite",
        "runs/report": REPORT,
    }
    answer = call(line[name])
    assert answer.status == 1 and answer.error.startswith("error: "), answer.err
    assert read_state(other) == before


def _check_end(answer: Answer) -> None:
    """It went well, or was refused in one line."""
    assert answer.status in (0, 1), answer.err
    assert "Traceback" not in answer.err
    assert answer.status == 0 or answer.error.startswith("error: "), answer.err
