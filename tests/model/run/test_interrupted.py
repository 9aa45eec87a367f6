"""Tests that training which was interrupted, in whatever way and however often, ends as if it had not been."""

import inspect
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from support.builds import tree
from support.commands import Answer, call
from support.disk import Change, watch

from datagen.data.dataset import Dataset
from datagen.disk.errors import DamagedError, HyalineError
from datagen.terminal.command import Stopped, hold_signals
from model.run import train as train_module
from model.run.run_folder import TrainConfig
from model.state import load_state, save_state

pytestmark = [pytest.mark.promise("R3"), pytest.mark.usefixtures("one_thread")]

SIZE = "--label it --steps 6 --batch 64 --texture-size 16 --hidden 32 --device cpu"
WHOLE, PARTS = Path("whole"), Path("parts")


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints and evaluations of a run of six steps."""
    make = inspect.unwrap(TrainConfig.__init__)
    defaults = (make.__kwdefaults__ or {}) | {"checkpoint_every": 2, "evaluate_every": 3}
    monkeypatch.setattr(make, "__kwdefaults__", defaults)


Train = Callable[..., Answer]


@pytest.fixture
def train(dataset: Dataset) -> Train:
    """`model train --out FOLDER` in this process."""
    return lambda out, flags="": call(f"model train paper {dataset.root} --out {out} {SIZE} {flags}")


class Killed(BaseException):
    """The process is gone: nothing that it would have done comes to pass."""


def dying_at(number: int) -> Callable[[Change], None]:
    """Kills at a change of the disk, counted from 0, and at whatever would clean up after it."""
    left = iter(range(number))

    def before(change: Change) -> None:
        if next(left, None) is None:
            raise Killed

    return before


def test_a_run_that_is_killed_again_and_again_ends_in_the_same_bytes(train: Train, is_full: bool) -> None:
    assert train(WHOLE).status == 0
    for number in range(2, 200, 2 if is_full else 9):
        try:
            with watch(PARTS, dying_at(number)):
                assert train(PARTS).status == 0
        except Killed:
            continue
        break
    assert tree(PARTS) == tree(WHOLE)


@pytest.mark.parametrize(("flags", "number"), [("", signal.SIGTERM), ("--overwrite", signal.SIGINT)])
def test_a_signal_leaves_a_checkpoint_from_which_the_same_command_goes_on(
    train: Train, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, flags: str
) -> None:
    assert train(WHOLE).status == 0
    check = train_module.read_finite

    def interrupt(loss: torch.Tensor, renderer: torch.nn.Module, *, step: int, out: Path) -> float:
        if step == 2:
            os.kill(os.getpid(), number)
        return check(loss, renderer, step=step, out=out)

    with monkeypatch.context() as patch:
        patch.setattr(train_module, "read_finite", interrupt)
        stopped = train(PARTS, flags)
    way_on = "the same command without --overwrite" if flags else "the same command"
    assert stopped.status == 128 + number
    assert stopped.error == f"error: parts: stopped after step 3 of 6; {way_on} resumes it"
    assert load_state(PARTS / "checkpoint.pt")["step"] == 3
    assert "parts: resuming after step 3 of 6\n" in train(PARTS).err
    assert tree(PARTS) == tree(WHOLE)


def test_checkpoints_by_the_clock_change_no_byte(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    assert train(WHOLE).status == 0
    saved: list[object] = []
    save = train_module.save_progress
    monkeypatch.setattr(train_module, "save_progress", lambda *given: (saved.append(given[0].step), save(*given)))
    monkeypatch.setattr(train_module, "CHECKPOINT_EVERY_S", 0.0)
    assert train(PARTS).status == 0
    assert saved == [1, 2, 3, 4, 5]
    assert tree(PARTS) == tree(WHOLE)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.pt"
    save_state(path, {"step": 2, "net": {"a": torch.arange(50_000.0)}, "more": {0: [1, 2.5, None, "b"]}})
    return path


def test_every_flipped_bit_and_every_cut_of_a_checkpoint_is_noticed_or_changes_no_value(
    checkpoint: Path, tmp_path: Path
) -> None:
    path, data, intact = tmp_path / "checkpoint.pt", checkpoint.read_bytes(), load_state(checkpoint)
    noticed = 0
    for place in range(0, len(data), len(data) // 400):
        path.write_bytes(data[:place])
        with pytest.raises(DamagedError, match=r"checkpoint\.pt: damaged, torch cannot read it \("):
            load_state(path)
        broken = bytearray(data)
        broken[place] ^= 1 << place % 8
        path.write_bytes(broken)
        try:
            state = load_state(path)
        except HyalineError:
            noticed += 1
        else:
            assert state.keys() == intact.keys() and torch.equal(state["net"]["a"], intact["net"]["a"])  # pyright: ignore
    assert noticed > 390


def test_a_damaged_checkpoint_ends_the_command_with_the_way_on_and_is_kept(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = PARTS / "checkpoint.pt"
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(train_module, "add_metrics", lambda *_: (_ for _ in ()).throw(Killed))
        train(PARTS)
    broken = path.read_bytes()[:-1000]
    path.write_bytes(broken)
    refused = train(PARTS)
    assert refused.status == 1 and re.search(r"checkpoint\.pt: damaged, .*; start over with --overwrite", refused.err)
    assert path.read_bytes() == broken
    assert train(PARTS, "--overwrite").status == train(WHOLE).status == 0
    assert tree(PARTS) == tree(WHOLE)


# Signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_is_held_back_is_raised_when_the_block_ends(number: signal.Signals) -> None:
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    done = []
    with pytest.raises(Stopped) as stopped, hold_signals() as held:
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)  # A launcher passes on what the terminal has sent to all.
        done.append(held.number)
    assert done == [number] and stopped.value.status == 128 + number
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_a_signal_that_the_parent_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with hold_signals() as held:
            os.kill(os.getpid(), signal.SIGINT)
        assert held.number is None
    finally:
        signal.signal(signal.SIGINT, before)
