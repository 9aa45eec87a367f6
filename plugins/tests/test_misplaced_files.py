"""Tests that weights and predictions of another dataset or run are neither drawn with nor scored."""

import shutil
from pathlib import Path

import pytest
from support.commands import call, run
from support.synthetic import write_synthetic_dataset

pytestmark = pytest.mark.usefixtures("one_thread")

QUICK = "--steps 2 --batch 64 --texture-size 16 --hidden 32 --device cpu"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """data/d1 and data/d2, and the runs d1/one, d1/two (another seed) and d2/one."""
    home = tmp_path_factory.mktemp("made")
    for name, views in (("d1", 2), ("d2", 3)):
        write_synthetic_dataset(home / "data" / name, resolution=16, train_views=views)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        for out, seed in (("d1/one", 0), ("d1/two", 1), ("d2/one", 0)):
            run(f"model train paper {out[:2]} --out runs/{out} --seed {seed} {QUICK}")
    return home


@pytest.fixture(autouse=True)
def home(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)


@pytest.mark.parametrize("line", ["model predict runs/d1/one --overwrite", "model export runs/d1/one"])
def test_weights_of_another_dataset_draw_nothing(line: str) -> None:
    shutil.copy("runs/d2/one/weights.pt", "runs/d1/one/weights.pt")
    answer = call(line)
    assert answer.status == 1 and "weights.pt: trained on other data (dataset_seal " in answer.error


@pytest.mark.parametrize(("source", "said"), [("d2/one", "dataset_seal is "), ("d1/two", "run_seal is ")])
def test_predictions_from_elsewhere_are_not_scored_and_are_drawn_again(source: str, said: str) -> None:
    before = Path("runs/d1/one/predictions.json").read_bytes()
    shutil.copytree(f"runs/{source}/predictions", "runs/d1/one/predictions", dirs_exist_ok=True)
    shutil.copy(f"runs/{source}/predictions.json", "runs/d1/one/predictions.json")
    answer = call("eval report --out report")
    assert answer.status == 1
    (line,) = [line for line in answer.err.splitlines() if "d1/one" in line]
    assert f"runs/d1/one/predictions.json: {said}" in line
    run("model predict runs/d1/one --device cpu")
    assert Path("runs/d1/one/predictions.json").read_bytes() == before
    run("eval report --out report")
