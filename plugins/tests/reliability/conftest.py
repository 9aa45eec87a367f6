"""What the tests of promises share: a small world of commands, and the states of the disk that they start from."""

import dataclasses
import inspect
import os
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
import torch
from support.commands import call, run
from support.disk import State, empty, read_state
from support.fake_renderer import film, install
from support.scenarios import GRID, PREPARED
from support.synthetic import synthetic_scene

from datagen.scene.folder import save_scene
from model.run.run_folder import TrainConfig


@pytest.fixture(scope="session")
def started() -> dict[str, State]:
    """Folders as they are after some commands, by name; made when they are first asked for."""
    return {}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty working folder of commands that cost nothing but their writes.

    Views are drawn by a formula, one thread computes, and nothing waits for the disk: no power cut is tried here.
    """
    install(monkeypatch)
    monkeypatch.setattr("model.run.sweep._train_in_child", train_here)
    monkeypatch.setattr(
        "model.run.predict.film_pictures",
        lambda run, config, dataset, cameras, device: film(cameras),
    )
    make = inspect.unwrap(TrainConfig.__init__)
    often = (make.__kwdefaults__ or {}) | {"checkpoint_every": 2}
    monkeypatch.setattr(make, "__kwdefaults__", often)
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield tmp_path
    torch.set_num_threads(before)


@pytest.fixture
def start(here: Path, started: dict[str, State], monkeypatch: pytest.MonkeyPatch) -> Callable[[str], State]:
    """Makes the working folder what a prepared state's commands leave."""

    def make(name: str) -> State:
        empty(here)
        if name not in started:
            before, *lines = PREPARED[name]
            if before:
                make(before)
            else:
                scene = synthetic_scene()
                rig = dataclasses.replace(scene.cameras, azimuth_deg=(-100, 100))
                save_scene(dataclasses.replace(scene, cameras=rig), here / "scene")
                (here / "grid.txt").write_text(GRID)
            for line in lines:
                run(line)
            started[name] = read_state(here)
            empty(here)
        started[name].restore(here)
        return started[name]

    return make


def train_here(arguments: Sequence[str], *_: object) -> str:
    """A run of a sweep in this process, where its writes are seen."""
    answer = call(shlex.join(["model", "train", *arguments]))
    return answer.error.removeprefix("error: ") if answer.status else ""
