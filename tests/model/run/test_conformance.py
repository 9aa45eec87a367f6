"""Tests of `model check-method`, on the example method, which lives in a distribution of its own."""

import dataclasses
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.commands import call
from support.plugins import install
from support.synthetic import write_synthetic_dataset
from support.training import SMALL

from datagen.data.cameras import Cameras
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from model.batches.rays import PixelSource
from model.methods.paper.config import PaperConfig
from model.methods.protocol import Inputs, open_inputs
from model.run.conformance import CHECKS, Subject

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "nearest_view"
BROKEN = {
    "one seed gives one start": ("torch.tensor(sharpness)", "torch.tensor(np.random.default_rng().random())"),
    "pictures have their shape, type and range": (".flatten(0, 1)", ".flatten(0, 1)[:-1]"),
    "one seed gives one run, which learns": ("rng.integers(", "np.random.default_rng().integers("),
}
"""Changes to the example, each of which breaks the promise of one check."""


@pytest.fixture
def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The example as an installer would leave it, where this process finds it."""
    ((group, points),) = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"].items()
    ((name, value),) = points.items()
    install(tmp_path, group, name, value, (EXAMPLE / "nearest_view.py").read_text())
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("nearest_view", None)


@pytest.mark.usefixtures("one_thread", "found")
def test_a_method_of_another_distribution_is_listed_checked_and_short() -> None:
    assert len((EXAMPLE / "nearest_view.py").read_text().splitlines()) < 60
    listed = " ".join(call("model train --help").out.replace("│", " ").split())
    assert "nearest-view The training pictures with the nearest cameras, blended. Brought by nearest-view." in listed
    answer = call("model check-method nearest-view")
    lines = answer.out.splitlines()
    assert answer.status == 0, answer.out + answer.err
    assert [line.split()[0] for line in lines[:7]] == ["ok"] * 7
    assert lines[7].startswith("skip  a view's camera gives the view's picture: it only draws the views of its dataset")
    assert lines[8] == "skip  its web page has what it needs: it has no web page (page is empty)"
    assert lines[9] in ("ok    it runs on a GPU", "skip  it runs on a GPU: torch finds no GPU")


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("check", BROKEN)
def test_a_method_that_breaks_a_promise_is_told_which(found: Path, check: str) -> None:
    source = (found / "nearest_view.py").read_text()
    before, after = BROKEN[check]
    assert before in source
    (found / "nearest_view.py").write_text(source.replace(before, after))
    answer = call("model check-method nearest-view")
    assert answer.status == 1
    assert any(line.startswith(f"FAIL  {check}: ") for line in answer.out.splitlines()), answer.out


def test_a_method_that_draws_another_camera_than_asked_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data")
    config = dataclasses.replace(SMALL, steps=4)
    subject = Subject(config=config, inputs=open_inputs(config.net, dataset, TRUTH), folder=tmp_path)
    subject.train("first")
    check = CHECKS["a view's camera gives the view's picture"]
    check(subject)
    right = PaperConfig.load_cameras

    def from_the_other_side(config: PaperConfig, inputs: Inputs, cameras: Cameras) -> PixelSource:
        turned = np.diag([-1.0, -1.0, 1.0, 1.0]) @ cameras.world_from_camera
        return right(config, inputs, dataclasses.replace(cameras, world_from_camera=turned))

    monkeypatch.setattr(PaperConfig, "load_cameras", from_the_other_side)
    with pytest.raises(HyalineError, match=r"^through a view's camera \d+% of the pixels differ from the view's$"):
        check(subject)
