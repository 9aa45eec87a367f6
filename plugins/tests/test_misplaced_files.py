"""Tests that files stay where they belong: a run's are refused in another, and no output replaces any of them."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.commands import call, run
from support.synthetic import write_synthetic_dataset

from datagen.disk.errors import HyalineError
from model.run.run_folder import find_run

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


def foreign_pictures() -> None:
    shutil.copytree("runs/d1/one/predictions/interpolating", "runs/d1/splats/predictions/interpolating")


def circle() -> None:
    Path("circle").symlink_to("circle")


REFUSED: dict[Callable[[], None], tuple[str, tuple[str, ...]]] = {
    foreign_weights: (
        "weights.pt: trained on other data (dataset_seal ",
        ("model predict runs/d1/one --overwrite", "model export runs/d1/one"),
    ),
    foreign_pictures: ("runs/d1/splats: holds no run; ", ("model export runs/d1/splats",)),
    circle: (
        "circle",
        (
            "datagen look d1 --out circle/look.html",
            "model train paper d1 --out circle --steps 2 --device cpu",
            "proxies make circle",
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


def test_a_run_is_found_by_its_folder_and_by_its_name_under_runs(home: Path) -> None:
    (home / "d1" / "one").mkdir(parents=True)  # Holds no run.
    for name in ("d1/one", "runs/d1/one"):
        assert find_run(Path(name)) == Path("runs/d1/one")
    with pytest.raises(HyalineError, match=r"^no run at d1/won or runs/d1/won; choose from d1/one, d1/two, d2/one$"):
        find_run(Path("d1/won"))
    answer = call("model predict d1/two")
    assert answer.status == 0 and answer.out == "runs/d1/two\n"
