"""Tests how commands end: one line for a person, a status for a script."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.commands import Answer, call

from datagen.disk.errors import HyalineError
from datagen.terminal.command import Stopped
from datagen.terminal.command import run as command_run
from datagen.terminal.plugins import VERSION


@pytest.mark.parametrize("line", ["datagen build --scene glas_table", "eval report nowhere"])
def test_a_process_of_its_own_answers_as_a_call_in_this_one(line: str) -> None:
    alone = subprocess.run([sys.executable, "-m", *line.split()], capture_output=True, text=True, check=False)
    assert Answer(status=alone.returncode, out=alone.stdout, err=alone.stderr) == call(line)


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("datagen build --scene glas_table", 2, "did you mean 'glass_table'?"),
        ("datagen build --preset dmeo", 2, "invalid choice 'dmeo' for argument '--preset'; choose from tiny, "),
        ("datagen build --scene ./nowhere", 1, "nowhere/scene.json: the file is missing"),
        ("datagen build --resolution 320x9999", 1, "resolution: is 9999; expected 1 to 8192 pixels"),
        ("datagen build --stereo 60", 1, "error: --stereo: is 60; expected more than 0 and at most 10 metres"),
        ("datagen build --shard 5/4", 1, "shard: is '5/4'; expected the part and the number of parts, such as 2/4"),
        ("datagen build --count 2", 2, "--family, --count: only for random scenes"),
        ("datagen build --shard 1/2 --overwrite", 2, "--overwrite: cannot be combined with --shard; delete"),
        ("datagen build --launcher slurm --slurm-time 0", 2, "--slurm-time, --slurm-cpus: expected at least 1"),
        ("datagen build --slurm-gpus 2 --shards 3", 2, "--slurm-gpus, --shards: need --launcher"),
        ("datagen verify", 1, "data: no dataset there; make one with `datagen build glass_table`"),
        ("datagen build --sceen x", 2, "datagen build: Unrecognized options: --sceen, x. See `datagen build --help`"),
        ("datagen bulid", 2, "no datagen command 'bulid'; did you mean 'build'? Choose from add, build, "),
    ],
)
def test_wrong_input_is_answered_with_the_way_out(line: str, status: int, message: str) -> None:
    answer = call(line)
    assert answer.status == status
    assert message in answer.err
    assert len(answer.err.splitlines()) == 1
    assert answer.out == ""


@pytest.mark.parametrize("line", ["datagen", "proxies make", "model train", "eval report"])
def test_every_command_tells_its_version(line: str) -> None:
    assert call(f"{line} --version") == Answer(status=0, out=f"hyaline {VERSION}\n", err="")
    assert re.fullmatch(r"\d+\.\d+\.\d+", VERSION)


def test_output_that_nobody_reads_ends_the_command_without_a_word(tmp_path: Path) -> None:
    line = f"{sys.executable} -m datagen build --help | true; echo ${{PIPESTATUS[0]}}"
    answer = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (answer.stdout, answer.stderr) == ("141\n", "")


@pytest.mark.parametrize("line", ["datagen --version", "datagen build --help", "datagen scenes"])
@pytest.mark.parametrize("end", [">&-", "> /dev/full"])
def test_a_result_that_cannot_be_printed_is_an_error(line: str, end: str) -> None:
    command = ["bash", "-c", f"exec {sys.executable} -m {line} {end}"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode == 1 and re.fullmatch(
        r"error: standard output\b.*: (bad file descriptor|no space).*\n", answer.stderr
    )


@pytest.mark.parametrize("wrapper", [RuntimeError, SystemError, ImportError, HyalineError, OSError])
@pytest.mark.parametrize(("stop", "status"), [(KeyboardInterrupt(), 130), (Stopped(signal.SIGTERM), 143)])
def test_a_signal_that_a_library_turned_into_its_own_error_still_ends_the_command_as_a_signal(
    wrapper: type[Exception], stop: BaseException, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    def work() -> None:
        try:
            raise stop
        except BaseException as error:
            raise wrapper("a library's words") from error

    with pytest.raises(SystemExit) as ended:
        command_run("program", work, [])
    assert ended.value.code == status
    assert capsys.readouterr().err == "error: stopped; run the same command again to continue\n"


def test_with_standard_error_closed_work_is_done_and_only_the_result_is_printed(tmp_path: Path) -> None:
    program = """
import sys
from datagen.terminal.command import run, say, tell, track
def work() -> None:
    say("works")
    with open("data", "w") as data:
        tell(f"{len(list(track([1, 2], label='item', total=2)))} items, {data.fileno() > 2}")
run("work", work, [])
"""
    (tmp_path / "work.py").write_text(program)
    line = f"cd {tmp_path} && exec {sys.executable} -P work.py <&- 2>&-"
    answer = subprocess.run(["sh", "-c", line], stdout=subprocess.PIPE, text=True, check=False)
    assert (answer.returncode, answer.stdout) == (0, "2 items, True\n")
