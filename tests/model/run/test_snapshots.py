"""Tests the pictures of held-out views and TensorBoard's events: what they hold, who deletes them, and equal bytes."""

import dataclasses
import importlib.util
import io
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.synthetic import write_synthetic_dataset
from support.training import SMALL, call, load, run_bytes

from datagen.data.dataset import Dataset
from datagen.data.images import read_png
from datagen.disk.ownership import holding
from model.run.logs import GAP, LogChoices, list_snapshots, snapshot, write_snapshot
from model.run.predict import load_renderer, predict_pixels
from model.run.run_folder import FOLDER, begin_run, read_run
from model.run.train import train

CONFIG = dataclasses.replace(SMALL, steps=5, evaluate_every=2, checkpoint_every=2)
SNAPSHOTS = [f"snapshots/{step:06d}.png" for step in (2, 4, 5)]
CPU = torch.device("cpu")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("snapshots") / "data" / "synthetic", resolution=16)


def trained(dataset: Dataset, out: Path, **choices: bool) -> Path:
    with holding(out, FOLDER):  # As the command does: it clears what killed writers left.
        train(CONFIG, dataset, out, label="run", device=CPU, logs=LogChoices(**choices))
    return out


def test_each_evaluation_leaves_the_scored_pixels_above_their_prediction(dataset: Dataset, tmp_path: Path) -> None:
    out = trained(dataset, tmp_path / "run")
    assert sorted(path for path in run_bytes(out) if path.endswith(".png")) == SNAPSHOTS
    last = read_png(out / SNAPSHOTS[-1])
    view = dataset.view("train", 4)  # Of eight views the middle one is held out.
    assert last.shape == (2 * 8 + GAP, 8, 3)
    assert np.array_equal(last[:8], view.image[::2, ::2])
    assert (last[8 : 8 + GAP] == 255).all()
    predicted = predict_pixels(load_renderer(out, CONFIG, dataset), load(CONFIG.net, dataset, [4]))
    thinned = predicted.reshape(16, 16, 3)[::2, ::2]
    assert thinned.std() > 1 and np.abs(last[-8:].astype(int) - thinned).max() <= 1  # Whole views take another loop.


def test_without_snapshots_every_other_byte_is_the_same(dataset: Dataset, tmp_path: Path) -> None:
    with_them, without = (run_bytes(trained(dataset, tmp_path / str(on), snapshots=on)) for on in (True, False))
    assert {path: data for path, data in with_them.items() if path not in SNAPSHOTS} == without


def test_large_views_are_thinned_out_and_stand_side_by_side() -> None:
    truth = np.zeros((3, 300, 200, 3), np.uint8)
    truth[1, 3::3, ::3] = 200
    picture = snapshot(truth, truth + 9)
    assert picture.shape == (2 * 100 + GAP, 3 * 67 + 2 * GAP, 3)
    assert (picture[1:100, 67 + GAP : 2 * 67 + GAP] == 200).all()
    assert (picture[100 + GAP :, :67] == 9).all()


def test_a_new_run_deletes_the_old_ones_pictures_and_no_foreign_file(dataset: Dataset, tmp_path: Path) -> None:
    out = trained(dataset, tmp_path / "run")
    foreign = ["snapshots/000003.png", "snapshots/2.png", "snapshots/000002.png.bak", "tensorboard/notes.txt"]
    for path in foreign:
        (out / path).parent.mkdir(exist_ok=True)
        (out / path).write_bytes(b"mine")
    events = out / "tensorboard" / "events.out.tfevents.1.host.2.0"
    events.write_bytes(b"")
    assert list_snapshots(out, evaluate_every=2, steps=5) == SNAPSHOTS
    begin_run(out, dataclasses.replace(read_run(out), seed=1), overwrite=True)
    assert sorted(run_bytes(out)) == sorted([*foreign, "run.json"])


def test_without_held_out_views_there_is_no_picture(dataset: Dataset, tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, held_out_views=0)
    train(config, dataset, tmp_path / "run", label="run", device=CPU)
    assert not (tmp_path / "run" / "snapshots").exists()


def test_the_flag_turns_them_off(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("train", "paper", "--dataset", str(dataset.root), "--steps", "2", "--batch", "64", "--texture-size", "8")
    for value in ("--snapshots", "--no-snapshots"):
        out = tmp_path / value
        assert call(monkeypatch, *words, "--hidden", "8", "--out", str(out), value) == 0
        assert (out / "snapshots" / "000002.png").is_file() == (value == "--snapshots")


@pytest.fixture
def read_events() -> Callable[[Path], dict[str, list[tuple[int, object]]]]:
    """What event files hold, by tag: pairs of step and value, as TensorBoard's own reader finds them."""
    if importlib.util.find_spec("tensorboard") is None:
        pytest.skip("tensorboard is not installed; the extra tensorboard brings it")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    def read(folder: Path) -> dict[str, list[tuple[int, object]]]:
        events = EventAccumulator(str(folder))
        events.Reload()
        tags = events.Tags()
        found: dict[str, list[tuple[int, object]]] = {
            tag: [(point.step, point.value) for point in events.Scalars(tag)] for tag in tags["scalars"]
        }
        for tag in tags["images"]:
            found[tag] = [(item.step, item.encoded_image_string) for item in events.Images(tag)]
        return found

    return read


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_tensorboard_gets_curves_and_pictures_and_no_other_byte_changes(
    dataset: Dataset, tmp_path: Path, read_events: Callable[[Path], dict[str, list[tuple[int, object]]]]
) -> None:
    out = trained(dataset, tmp_path / "run", tensorboard=True)
    found = read_events(out / "tensorboard")
    assert set(found) == {"held-out PSNR (dB)", "held-out views"}, "a loss is told every ten steps"
    assert [step for step, _ in found["held-out PSNR (dB)"]] == [2, 4, 5]
    step, data = found["held-out views"][-1]
    assert isinstance(data, bytes)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(data))), read_png(out / f"snapshots/{step:06d}.png"))
    plain = run_bytes(trained(dataset, tmp_path / "plain"))
    assert {path: data for path, data in run_bytes(out).items() if not path.startswith("tensorboard/")} == plain


def test_without_tensorboard_nothing_is_trained_and_the_way_to_install_it_is_said(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    out = tmp_path / "run"
    assert call(monkeypatch, "train", "paper", "--dataset", str(dataset.root), "--out", str(out), "--tensorboard") == 1
    assert capsys.readouterr().err == (
        'error: model train: needs tensorboard, which is not installed; `pip install "hyaline-glass[tensorboard]"` '
        "brings it\n"
    )
    assert not out.exists()


def test_a_snapshot_has_the_bytes_of_its_picture_alone(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (6, 5, 3), np.uint8)
    for name in ("one", "two"):
        write_snapshot(tmp_path / name, 7, picture)
    one, two = ((tmp_path / name / "snapshots" / "000007.png").read_bytes() for name in ("one", "two"))
    assert one == two
    assert np.array_equal(read_png(tmp_path / "one" / "snapshots" / "000007.png"), picture)
