"""Tests with real processes and the real renderer: killed and told to stop at random moments, they go on."""

import os
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

VIEWS = 6
FLAGS = (
    *("--preset", "tiny", "--resolution", "24", "--num-layers", "4", "--views", str(VIEWS), "--test-views", "3"),
    *("--spp", "64", "--test-spp", "64"),
)
KILLS, SIGNALS = (3, 200), (2, 10)
"""So many in a quick run, and in a full one."""

Build = Callable[[Path], list[str]]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """The command that builds a dataset at a place."""
    scene = tmp_path_factory.mktemp("scene") / "mine"
    save_scene(synthetic_scene(), scene)
    return lambda out: [sys.executable, "-m", "datagen", "build", "--scene", str(scene), "--out", str(out), *FLAGS]


@pytest.fixture(scope="module")
def whole(build: Build, tmp_path_factory: pytest.TempPathFactory) -> tuple[State, float]:
    """What nobody disturbed makes, and how many seconds of work that takes."""
    out = tmp_path_factory.mktemp("whole") / "data"
    process = _start(build(out))
    begin = time.monotonic()
    process.communicate()
    assert process.returncode == 0
    return read_state(out), time.monotonic() - begin


@pytest.mark.promise("R2")
def test_a_build_that_is_killed_again_and_again_ends_in_the_same_bytes(
    build: Build, whole: tuple[State, float], tmp_path: Path, is_full: bool
) -> None:
    expected, seconds = whole
    rng = np.random.default_rng(0)
    kills = finished = 0
    while kills < KILLS[is_full]:
        out = tmp_path / f"{finished}"
        for _ in range(6 if is_full else 3):
            process = _start(build(out))
            time.sleep(rng.uniform(0, 0.7) * seconds)
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            if process.returncode == 0:
                break  # Nothing is left to be killed.
            kills += process.returncode == -signal.SIGKILL
        _finish(build(out))
        assert not differing(read_state(out), expected)
        finished += 1


@pytest.mark.promise("R11")
def test_a_build_that_is_told_to_stop_stops_soon_with_its_status_and_goes_on(
    build: Build, whole: tuple[State, float], tmp_path: Path, is_full: bool
) -> None:
    expected, seconds = whole
    a_view = seconds / (VIEWS + 6)
    rng = np.random.default_rng(1)
    stopped = 0
    out = tmp_path / "data"
    for turn in range(SIGNALS[is_full]):
        number = (signal.SIGINT, signal.SIGTERM)[turn % 2]
        process = _start(build(out))
        time.sleep(rng.uniform(0, 0.3) * seconds)
        process.send_signal(number)
        begin = time.monotonic()
        _, said = process.communicate()
        took = time.monotonic() - begin
        if process.returncode == 0:
            continue  # It was finished before.
        # Without a handler the system ends a process by the signal, which a shell calls 143.
        assert process.returncode in (128 + number, -number), said
        assert "Traceback" not in said, said
        assert took < a_view + 1 + seconds, f"took {took:.1f} s"
        stopped += 1
    assert stopped >= SIGNALS[is_full] // 2
    _finish(build(out))
    assert not differing(read_state(out), expected)


def _start(command: list[str]) -> subprocess.Popen[str]:
    """Starts a build and waits until it renders or peels."""
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stderr is not None
    # The first line is said when work begins, or when none is left.
    process.stderr.readline()
    return process


def _finish(command: list[str]) -> None:
    """Runs it to its end in this process."""
    run(shlex.join(command[2:]))
