"""Tests of workers: one that is killed is one line, with nothing lost; none runs the script that started it."""

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

from support.commands import run
from support.synthetic import synthetic_scene

from datagen.machine.processes import in_workers
from datagen.scene.folder import save_scene

FLAGS = (
    *("--preset", "tiny", "--resolution", "16", "--num-layers", "4"),
    *("--views", "8", "--test-views", "1", "--spp", "256", "--test-spp", "4"),
)


def children(process: int) -> list[int]:
    """Those that Python's spawn method started, not its resource tracker."""
    found = [int(word) for word in Path(f"/proc/{process}/task/{process}/children").read_text().split()]
    return [child for child in found if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def test_a_killed_worker_is_one_line_that_counts_missing_views_and_names_the_command_that_goes_on(
    tmp_path: Path,
) -> None:
    save_scene(synthetic_scene(), tmp_path / "scene")
    out = tmp_path / "out"
    words = ["build", "--scene", str(tmp_path / "scene"), "--out", str(out), *FLAGS, "--workers", "2"]
    start = [sys.executable, "-m", "datagen", *words]
    command = subprocess.Popen(start, stderr=subprocess.PIPE, text=True, start_new_session=True)
    while command.poll() is None and len(list(out.glob("records/*/*.json"))) < 2:
        time.sleep(0.002)
    os.killpg(command.pid, signal.SIGSTOP)  # So that no view is finished meanwhile.
    os.kill(children(command.pid)[0], signal.SIGKILL)
    os.killpg(command.pid, signal.SIGCONT)
    said = command.communicate()[1]
    assert command.returncode == 1
    assert "Traceback" not in said
    kept = {path.name: path.read_bytes() for path in out.glob("records/train/*.json")}
    error = said.splitlines()[-1]
    assert error.startswith(f"error: {out}: render: a worker process was killed (")
    assert "of 10 views are missing" in error
    assert error.endswith(f"; go on with `datagen {' '.join(words)}`")
    run(shlex.join(["datagen", *words]))
    assert len(list(out.glob("images/train/*.png"))) == 8
    assert {name: (out / "records/train" / name).read_bytes() for name in kept} == kept


def test_a_script_without_a_guard_for_new_processes_builds_in_several(tmp_path: Path) -> None:
    save_scene(synthetic_scene(), tmp_path / "scene")
    flags = "preset='tiny', resolution=16, num_layers=4, views=4, test_views=1, spp=4, test_spp=4, workers=2"
    script = tmp_path / "script.py"
    script.write_text(f"import hyaline\nhyaline.build('scene', 'out', {flags})\nprint('built')\n")
    ended = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True)
    assert ended.stdout == "built\n", ended.stderr


def touch_slowly(_: int, place: Path) -> None:
    time.sleep(1)
    place.touch()


def test_workers_end_at_once_where_their_caller_stops(tmp_path: Path) -> None:
    work = in_workers(touch_slowly, [tmp_path / str(number) for number in range(8)], 2, int, ())
    with contextlib.closing(iter(work)):  # pyright: ignore[reportArgumentType]
        next(iter(work))
    assert len(list(tmp_path.iterdir())) < 4
