"""Tests with real processes and the real renderer: killed and told to stop among their views, they go on."""

import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.disk import State, differing, read_state
from support.synthetic import synthetic_scene

from datagen.scene.folder import save_scene

FLAGS = (
    *("--preset", "tiny", "--resolution", "24", "--num-layers", "4", "--views", "6", "--test-views", "3"),
    *("--spp", "64", "--test-spp", "64"),
)
KILLS, SIGNALS = (3, 200), (2, 10)
"""So many in a quick run, and in a full one."""
MOST = 4
"""Records that a process may write, at most, before it is killed or told to stop: a sixth of all."""

Build = Callable[[Path], list[str]]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """The command that builds a dataset at a place."""
    scene = tmp_path_factory.mktemp("scene") / "mine"
    save_scene(synthetic_scene(), scene)
    return lambda out: [sys.executable, "-m", "datagen", "build", "--scene", str(scene), "--out", str(out), *FLAGS]


@pytest.fixture(scope="module")
def whole(build: Build, tmp_path_factory: pytest.TempPathFactory) -> State:
    """What nobody disturbed makes."""
    out = tmp_path_factory.mktemp("whole") / "data"
    _finish(build(out))
    return read_state(out)


@pytest.mark.promise("R2")
def test_a_build_that_is_killed_again_and_again_ends_in_the_same_bytes(
    build: Build, whole: State, tmp_path: Path, is_full: bool
) -> None:
    rng = np.random.default_rng(0)
    kills = finished = 0
    while kills < KILLS[is_full]:
        out = tmp_path / f"{finished}"
        for _ in range(6 if is_full else 3):
            process = _frozen(build(out), out, int(rng.integers(MOST)))
            process.kill()
            process.communicate()
            kills += process.returncode == -signal.SIGKILL
        _finish(build(out))
        assert not differing(read_state(out), whole)
        finished += 1


@pytest.mark.promise("R11")
def test_a_build_that_is_told_to_stop_stops_after_its_view_with_its_status_and_goes_on(
    build: Build, whole: State, tmp_path: Path, is_full: bool
) -> None:
    rng = np.random.default_rng(1)
    stopped = turn = 0
    while stopped < SIGNALS[is_full]:
        number, out = (signal.SIGINT, signal.SIGTERM)[stopped % 2], tmp_path / f"{turn // 2}"
        process = _frozen(build(out), out, 1 + int(rng.integers(MOST)))
        before = _count(out)
        process.send_signal(number)
        process.send_signal(signal.SIGCONT)
        _, said = process.communicate()
        stopped += process.returncode != 0  # Unless nothing was left to be done.
        assert process.returncode in (0, 128 + number), said
        assert "Traceback" not in said, said
        assert process.returncode == 0 or _count(out) <= before + 2, "the view it was at, and a record being written"
        if turn % 2:
            _finish(build(out))
            assert not differing(read_state(out), whole)
        turn += 1


def _frozen(command: list[str], out: Path, number: int) -> subprocess.Popen[str]:
    """A build that stands still, when it has written so many records of views and layers, or has ended."""
    before = _count(out)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    process.stderr.readline()  # It says its first line when work begins, and signals are heard.
    while process.poll() is None and _count(out) < before + number:
        time.sleep(0.001)
    process.send_signal(signal.SIGSTOP)
    return process


def _count(out: Path) -> int:
    """The records in a folder: one for each view, and one for its layers."""
    return len(list(out.glob("**/records/**/*.json")))


def _finish(command: list[str]) -> None:
    """Runs it to its end in this process."""
    run(shlex.join(command[2:]))
