"""Tests that files of one run are refused in another: weights, checkpoints and predictions say where they belong."""

import dataclasses
import shutil
from pathlib import Path

import pytest
from support.commands import call, run
from support.synthetic import write_synthetic_dataset
from support.training import stop_at

from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.storage import commit_sealed, load_sealed
from model.methods.protocol import MethodConfig
from model.run import train_flags
from model.run.checkpoint import load_state, save_state
from model.run.run_folder import TrainConfig
from model.settings.optimisation import Optimisation

pytestmark = pytest.mark.usefixtures("one_thread")

QUICK = "--steps 2 --batch 64 --texture-size 16 --width 32 --device cpu"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """data/d1 and data/d2, and the runs d1/one, d1/two (another seed) and d2/one."""
    home = tmp_path_factory.mktemp("made")
    for name, views in (("d1", 2), ("d2", 3)):
        write_synthetic_dataset(home / "data" / name, train_views=views)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        for out, seed in (("d1/one", 0), ("d1/two", 1), ("d2/one", 0)):
            run(f"model train paper --dataset {out[:2]} --out runs/{out} --seed {seed} {QUICK}")
    return home


@pytest.fixture
def home(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def seals(name: str) -> tuple[str, ...]:
    """The beginnings of the digests of two datasets, that of `name` last."""
    other = {"d1": "d2", "d2": "d1"}[name]
    return tuple(open_dataset(Path("data", place)).seal[:12] for place in (other, name))


@pytest.mark.parametrize(
    "line",
    [
        "model render --run runs/d1/one --overwrite",
        "model render --run runs/d1/one --path orbit --frames 2 --video film.gif",
        "model export --run runs/d1/one",
        "model view runs/d1/one --port 0",
    ],
)
def test_weights_of_a_run_on_another_dataset_are_refused(home: Path, line: str) -> None:
    shutil.copy("runs/d2/one/weights.pt", "runs/d1/one/weights.pt")
    before = Path("runs/d1/one/predictions.json").read_bytes()
    answer = call(line)
    assert (answer.status, answer.out) == (1, "")
    theirs, own = seals("d1")
    assert f"weights.pt: of a run on other data (dataset_seal {theirs}...) than this one ({own}...)" in answer.error
    assert Path("runs/d1/one/predictions.json").read_bytes() == before
    assert not (home / "scene.html").exists() and not (home / "film.gif").exists()


@pytest.mark.usefixtures("home")
def test_a_checkpoint_of_a_run_on_another_dataset_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    configure = train_flags.configure

    def often(method: str, asked: train_flags.Asked[MethodConfig, Optimisation]) -> tuple[TrainConfig, Dataset]:
        config, dataset = configure(method, asked)
        return dataclasses.replace(config, checkpoint_every=2), dataset

    monkeypatch.setattr(train_flags, "configure", often)
    line = "model train paper --dataset {} --out runs/{}/stopped --steps 8 --batch 64 --texture-size 16 --device cpu"
    for name in ("d1", "d2"):
        with monkeypatch.context() as patch:
            stop_at(patch, 6)
            assert call(line.format(name, name)).status != 0
    shutil.copy("runs/d2/stopped/checkpoint.pt", "runs/d1/stopped/checkpoint.pt")
    answer = call(line.format("d1", "d1"))
    theirs, own = seals("d1")
    assert answer.status == 1
    assert f"checkpoint.pt: of a run on other data (dataset_seal {theirs}...) than this one ({own}...)" in answer.error


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
    run("model render --run runs/d1/one --device cpu")
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
    answer = call("model render --run runs/d1/one")
    assert answer.status == 0 and "predictions are intact, nothing to do" in answer.err
    run("model render --run runs/d1/one --overwrite --device cpu")
    assert load_sealed(predictions) == listed
    run("eval report --out report")
