"""Tests that files stay where they belong: a run's are refused in another, and no output replaces any of them."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.commands import call, run
from support.synthetic import write_synthetic_dataset
from support.training import stop_at

from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit_sealed, load_sealed
from model.run import train_flags
from model.run.checkpoint import load_state, save_state
from model.run.run_folder import TrainConfig, find_run

pytestmark = pytest.mark.usefixtures("one_thread")

QUICK = "--steps 2 --batch 64 --texture-size 16 --hidden 32 --device cpu"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """data/d1 and data/d2, and the runs d1/one, d1/two (another seed) and d2/one."""
    home = tmp_path_factory.mktemp("made")
    for name, views in (("d1", 2), ("d2", 3)):
        write_synthetic_dataset(home / "data" / name, train_views=views)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        for out, seed in (("d1/one", 0), ("d1/two", 1), ("d2/one", 0)):
            run(f"model train paper {out[:2]} --out runs/{out} --seed {seed} {QUICK}")
    return home


@pytest.fixture
def home(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


RENDER = "model film runs/d1/one --path orbit --width 8 --device cpu"


def foreign_weights() -> None:
    shutil.copy("runs/d2/one/weights.pt", "runs/d1/one/weights.pt")


def link() -> None:
    Path("link.png").symlink_to("data/d1/images/train/0000.png")


def foreign_pictures() -> None:
    shutil.copytree("runs/d1/one/predictions/interpolating", "runs/d1/splats/predictions/interpolating")


def described_pictures() -> None:
    foreign_pictures()
    Path("runs/d1/splats/run.json").write_text('{"method": "splats"}')


def circle() -> None:
    Path("circle").symlink_to("circle")


REFUSED: dict[Callable[[], None], tuple[str, tuple[str, ...]]] = {
    foreign_weights: (
        "weights.pt: trained on other data (dataset_seal ",
        (
            "model predict runs/d1/one --overwrite",
            "model film runs/d1/one --path orbit --frames 2 --out film.webp",
            "model export runs/d1/one",
            "model view runs/d1/one --port 0",
        ),
    ),
    link: (
        ": is a file of the ",
        (
            "datagen look d1 --out data/d2/images/train/0000.png --overwrite",
            "datagen look d1 --out link.png --overwrite",
            "model export runs/d1/one --out data/d1/dataset.json --overwrite",
            "model export runs/d1/one --out runs/d2/one/weights.pt --overwrite",
            "model export runs/d1/one --out runs/d1/one/predictions.json --overwrite",
        ),
    ),
    foreign_pictures: (
        "runs/d1/splats: holds a foreign method's pictures",
        ("model export runs/d1/splats", f"{RENDER.replace('one', 'splats')}"),
    ),
    described_pictures: ("runs/d1/splats: holds a foreign method's pictures", ("model predict runs/d1/splats",)),
    circle: (
        "circle",
        (
            "datagen build --scene glass_table --preset tiny --out circle",
            "datagen build --scene glass_table --preset tiny --out circle/below",
            "datagen look d1 --out circle/look.html",
            "datagen export d1 --format nerfstudio --out circle",
            "datagen import-dataset circle --out other",
            "datagen film d1 --path orbit --frames 2 --spp 2 --out circle --overwrite",
            f"{RENDER} --frames 2 --out circle --overwrite",
            "model train paper d1 --out circle --steps 2 --device cpu",
            "model export runs/d1/one --out circle/page.html",
            "proxies make circle",
            "eval report --out circle",
            "eval report circle",
        ),
    ),
}
"""What is put where it does not belong, what is said of it, and by which commands."""


@pytest.mark.parametrize(
    ("misplace", "said", "line"), [(put, said, line) for put, (said, lines) in REFUSED.items() for line in lines]
)
def test_what_is_misplaced_is_named_in_one_line_and_no_file_changes(
    home: Path, misplace: Callable[[], None], said: str, line: str
) -> None:
    def files() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in home.rglob("*") if path.is_file()}

    misplace()
    before = files()
    answer = call(line)
    assert answer.status == 1 and answer.error.startswith("error: ") and said in answer.error
    assert files() == before


@pytest.mark.usefixtures("home")
def test_a_checkpoint_of_a_run_on_another_dataset_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    configure = train_flags.configure

    def often(method: str, asked: train_flags.Asked) -> tuple[TrainConfig, Dataset]:
        config, dataset = configure(method, asked)
        return dataclasses.replace(config, checkpoint_every=2), dataset

    monkeypatch.setattr(train_flags, "configure", often)
    line = "model train paper {} --out runs/{}/stopped --steps 8 --batch 64 --texture-size 16 --device cpu"
    for name in ("d1", "d2"):
        with monkeypatch.context() as patch:
            stop_at(patch, 6)
            assert call(line.format(name, name)).status != 0
    shutil.copy("runs/d2/stopped/checkpoint.pt", "runs/d1/stopped/checkpoint.pt")
    answer = call(line.format("d1", "d1"))
    theirs, own = (open_dataset(Path("data", name)).seal[:12] for name in ("d2", "d1"))
    assert answer.status == 1
    assert f"checkpoint.pt: trained on other data (dataset_seal {theirs}...) than this run ({own}...)" in answer.error


@pytest.mark.usefixtures("home")
@pytest.mark.parametrize(
    ("source", "said"), [("d2/one", "of other data (dataset_seal"), ("d1/two", "by another run (")]
)
def test_predictions_from_elsewhere_are_not_scored_and_are_drawn_again(source: str, said: str) -> None:
    before = Path("runs/d1/one/predictions.json").read_bytes()
    shutil.copytree(f"runs/{source}/predictions", "runs/d1/one/predictions", dirs_exist_ok=True)
    shutil.copy(f"runs/{source}/predictions.json", "runs/d1/one/predictions.json")
    answer = call("eval report --out report")
    assert answer.status == 1
    (line,) = [line for line in answer.err.splitlines() if "d1/one" in line]
    assert f"runs/d1/one/predictions.json: its pictures are {said}" in line
    run("model predict runs/d1/one --device cpu")
    assert Path("runs/d1/one/predictions.json").read_bytes() == before
    run("eval report --out report")


@pytest.mark.usefixtures("home")
def test_files_of_older_programs_which_do_not_say_where_they_belong_are_read() -> None:
    weights, predictions = Path("runs/d1/one/weights.pt"), Path("runs/d1/one/predictions.json")
    state = load_state(weights)
    save_state(weights, {key: value for key, value in state.items() if not key.endswith("_seal")})
    listed = load_sealed(predictions)
    commit_sealed(predictions, {key: value for key, value in listed.items() if not key.endswith("_seal")})
    assert len(state) + len(listed) == 5 + 4
    answer = call("model predict runs/d1/one")
    assert answer.status == 0 and "predictions are intact, nothing to do" in answer.err
    run("model predict runs/d1/one --overwrite --device cpu")
    assert load_sealed(predictions) == listed
    run("eval report --out report")


@pytest.mark.usefixtures("home")
def test_a_film_replaces_its_own_frames_and_none_that_somebody_has_put_beside_them() -> None:
    run(f"{RENDER} --frames 3 --out film")
    Path("film/0003.png").write_text("mine")
    answer = call(f"{RENDER} --frames 4 --out film --overwrite")
    assert answer.status == 1 and answer.error.startswith("error: film/0003.png: is in the way")
    assert len(list(Path("film").iterdir())) == 5 and Path("film/0003.png").read_text() == "mine"
    run(f"{RENDER} --frames 2 --out film --overwrite")
    assert sorted(path.name for path in Path("film").iterdir()) == ["0000.png", "0001.png", "0003.png", "film.json"]


@pytest.mark.usefixtures("home")
def test_an_output_beside_a_datasets_own_files_is_written_and_replaced() -> None:
    for page, line in (
        (Path("data/d1/look.html"), "datagen look d1"),
        (Path("runs/d1/one/scene.html"), "model export runs/d1/one"),
    ):
        page.write_text("an older page")
        run(f"{line} --out {page} --overwrite")
        assert page.read_text() != "an older page"


def test_a_run_is_found_by_its_folder_and_by_its_name_under_runs(home: Path) -> None:
    (home / "d1" / "one").mkdir(parents=True)  # Holds no run.
    for name in ("d1/one", "runs/d1/one"):
        assert find_run(Path(name)) == Path("runs/d1/one")
    with pytest.raises(HyalineError, match=r"^no run at d1/won or runs/d1/won; choose from d1/one, d1/two, d2/one$"):
        find_run(Path("d1/won"))
    answer = call("model predict d1/two")
    assert answer.status == 0 and answer.out == "runs/d1/two\n"
