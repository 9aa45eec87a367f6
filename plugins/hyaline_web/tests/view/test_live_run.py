"""Tests that a run is drawn as it is now: from checkpoints while it trains, from its weights afterwards."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.builds import tree
from support.training import SMALL, stop_at

import hyaline
from datagen.data.dataset import Dataset
from hyaline_web.view.live_run import LiveRun, MovedOn
from model.methods.light_path.config import LightPathConfig
from model.methods.paper.config import DnrConfig, PaperConfig
from model.run.run_folder import TrainConfig
from model.run.train import train

CPU = torch.device("cpu")
CONFIG = dataclasses.replace(SMALL, steps=8)


def live(out: Path, dataset: Dataset, config: TrainConfig = CONFIG) -> LiveRun:
    return LiveRun(out, config, dataset, device=CPU)


@pytest.mark.usefixtures("one_thread")
def test_a_run_is_drawn_from_its_newest_checkpoint_then_from_its_weights_and_nothing_is_written(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, camera = tmp_path / "run", dataset.view("interpolating", 0).camera
    with monkeypatch.context() as patch:
        stop_at(patch, 6)
        with pytest.raises(KeyboardInterrupt):
            train(CONFIG, dataset, out, label="run", device=CPU)
    before = tree(out)
    run = live(out, dataset)
    assert run.draw(camera, is_quick=True) is None
    assert run.status == "no checkpoint yet"
    assert run.refresh() and not run.refresh()
    assert (run.step, run.is_trained) == (4, False)
    assert run.status == "step 4 of 8"
    early = run.draw(camera, is_quick=False)
    assert tree(out) == before

    train(CONFIG, dataset, out, label="run", device=CPU)
    assert np.array_equal(run.draw(camera, is_quick=False), early), "until somebody looks again"
    assert run.refresh()
    assert (run.step, run.is_trained) == (8, True)
    assert run.status == "step 8 of 8"
    late = run.draw(camera, is_quick=False)
    assert not np.array_equal(late, early)
    assert np.array_equal(late, hyaline.open_run(out, dataset=dataset, device="cpu").render(camera))

    with pytest.raises(MovedOn):
        answers = iter([True, False])
        run.draw(camera, is_quick=False, is_wanted=lambda: next(answers))
    assert np.array_equal(run.draw(camera, is_quick=False), late), "the next picture is whole"


def test_a_picture_in_haste_takes_one_ray_a_pixel() -> None:
    paper = PaperConfig().usual("truth")
    assert dataclasses.replace(paper, render_samples=9).hurried() == dataclasses.replace(paper, render_samples=1)
    path = LightPathConfig().sized((4, 4)).hurried()
    assert (path.render_samples, path.refined_samples) == (1, 1)
    assert DnrConfig().hurried() == DnrConfig()
