"""Tests that files stay where they belong: a run's are refused in another, and no output replaces any of them."""

import dataclasses
import shutil
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
    monkeypatch.setattr("eval.page.report.figures_of", lambda *_: {})  # Which take a second a report.
    return tmp_path


def seals(name: str) -> tuple[str, ...]:
    """The beginnings of the digests of two datasets, that of `name` last."""
    other = {"d1": "d2", "d2": "d1"}[name]
    return tuple(open_dataset(Path("data", place)).seal[:12] for place in (other, name))


@pytest.mark.parametrize(
    "line",
    [
        "model predict runs/d1/one --overwrite",
        "model film runs/d1/one --path orbit --frames 2 --out film.webp",
        "model export runs/d1/one",
        "model view runs/d1/one --port 0",
    ],
)
def test_weights_of_a_run_on_another_dataset_are_refused(home: Path, line: str) -> None:
    shutil.copy("runs/d2/one/weights.pt", "runs/d1/one/weights.pt")
    before = Path("runs/d1/one/predictions.json").read_bytes()
    answer = call(line)
    assert (answer.status, answer.out) == (1, "")
    theirs, own = seals("d1")
    assert f"weights.pt: trained on other data (dataset_seal {theirs}...) than this run ({own}...)" in answer.error
    assert Path("runs/d1/one/predictions.json").read_bytes() == before
    assert not (home / "scene.html").exists() and not (home / "film.webp").exists()


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
    theirs, own = seals("d1")
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


RENDER = "model film runs/d1/one --path orbit --width 8 --device cpu"


@pytest.mark.usefixtures("home")
def test_a_film_replaces_its_own_frames_and_none_that_somebody_has_put_beside_them() -> None:
    run(f"{RENDER} --frames 3 --out film")
    Path("film/0003.png").write_text("mine")
    answer = call(f"{RENDER} --frames 4 --out film --overwrite")
    assert (answer.status, answer.error) == (
        1,
        "error: film/0003.png: is in the way, and no file of this film; move it elsewhere, or choose another --out",
    )
    assert Path("film/0003.png").read_text() == "mine"
    assert sorted(path.name for path in Path("film").iterdir()) == [
        "0000.png",
        "0001.png",
        "0002.png",
        "0003.png",
        "film.json",
    ]
    run(f"{RENDER} --frames 2 --out film --overwrite")
    assert sorted(path.name for path in Path("film").iterdir()) == ["0000.png", "0001.png", "0003.png", "film.json"]


@pytest.mark.usefixtures("home")
@pytest.mark.parametrize(
    ("line", "owner"),
    [
        ("datagen look d1 --out data/d1/images/train/0000.png", "dataset"),
        ("datagen look d1 --out data/d2/images/train/0000.png", "dataset"),
        ("datagen look d1 --out link.png", "dataset"),
        ("model export runs/d1/one --out data/d1/dataset.json", "dataset"),
        ("model export runs/d1/one --out runs/d2/one/weights.pt", "run"),
        ("model export runs/d1/one --out runs/d1/one/predictions.json", "run"),
    ],
)
def test_no_output_replaces_a_file_of_a_dataset_or_a_run(line: str, owner: str) -> None:
    Path("link.png").symlink_to("data/d1/images/train/0000.png")
    place = Path(line.split()[-1])
    before = place.read_bytes()
    answer = call(f"{line} --overwrite")
    assert answer.status == 1
    assert answer.error.startswith(f"error: {place}: is a file of the {owner} {Path.cwd()}/")
    assert place.read_bytes() == before


@pytest.mark.usefixtures("home")
def test_a_label_that_no_record_can_hold_is_refused_before_training() -> None:
    answer = call("model train paper d1 --steps 2 --label 'M\udcfcller' --out runs/d1/three")
    assert answer.status == 1 and "--label: the string 'M\\udcfcller' holds a NUL or half of" in answer.error
    assert not Path("runs/d1/three").exists()


@pytest.mark.usefixtures("home")
def test_an_output_beside_a_datasets_own_files_is_written_and_replaced() -> None:
    for page, line in (
        (Path("data/d1/look.html"), "datagen look d1"),
        (Path("runs/d1/one/scene.html"), "model export runs/d1/one"),
    ):
        page.write_text("an older page")
        run(f"{line} --out {page} --overwrite")
        assert page.read_text() != "an older page"


@pytest.mark.usefixtures("home")
@pytest.mark.parametrize(
    "line",
    [
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
    ],
)
def test_a_link_to_itself_is_one_line(line: str) -> None:
    Path("circle").symlink_to("circle")
    answer = call(line)
    assert answer.status == 1
    assert answer.error.startswith("error: ") and "circle" in answer.error
    assert Path("circle").is_symlink()


@pytest.mark.usefixtures("home")
@pytest.mark.parametrize("line", ["model export {}", "model predict {}", "model film {} --path orbit"])
@pytest.mark.parametrize("record", [None, '{"method": "splats"}'])
@pytest.mark.parametrize("below", ["predictions/interpolating", "."])
def test_pictures_of_another_method_are_no_place_to_train_in(line: str, record: str | None, below: str) -> None:
    folder = Path("runs/d1/splats")
    shutil.copytree("runs/d1/one/predictions/interpolating", folder / below)
    if record is not None:
        (folder / "run.json").write_text(record)
    answer = call(line.format(folder))
    assert (answer.status, answer.error) == (
        1,
        f"error: {folder}: holds a foreign method's pictures, and no weights; expected the folder "
        "of a run of `model train` (`eval report` scores pictures of any method)",
    )


def test_a_run_is_found_by_its_folder_and_by_its_name_under_runs(home: Path) -> None:
    (home / "d1" / "one").mkdir(parents=True)  # Holds no run.
    for name in ("d1/one", "runs/d1/one"):
        assert find_run(Path(name)) == Path("runs/d1/one")
    with pytest.raises(HyalineError, match=r"^no run at d1/won or runs/d1/won; choose from d1/one, d1/two, d2/one$"):
        find_run(Path("d1/won"))
    answer = call("model predict d1/two")
    assert answer.status == 0 and answer.out == "runs/d1/two\n"
