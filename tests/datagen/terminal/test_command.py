"""Tests how commands end: one line for a person, a status for a script."""

import errno
import os
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.commands import Answer, call
from support.soon import ending_within
from support.synthetic import write_synthetic_dataset

from datagen.disk.errors import REASONS, HyalineError, describe_os_error, naming
from datagen.disk.storage import commit
from datagen.terminal.command import choose, track
from datagen.terminal.command import run as command_run
from datagen.terminal.distribution import VERSION
from datagen.terminal.parsing import group
from datagen.terminal.signals import Stopped


@pytest.mark.parametrize(
    "line",
    [
        *("datagen build --scene glas_table", "proxies make --kind elipsoid", "datagen build --preset tyni"),
        *("eval report nowhere", "datagen verify", "model --version"),
    ],
)
def test_a_process_of_its_own_answers_as_a_call_in_this_one(line: str) -> None:
    alone = subprocess.run([sys.executable, "-m", *line.split()], capture_output=True, text=True, check=False)
    assert Answer(status=alone.returncode, out=alone.stdout, err=alone.stderr) == call(line)


@pytest.mark.parametrize("program", ["datagen", "proxies", "model"])
@pytest.mark.parametrize("words", ["nonsense --help", "nonsense -h"])
def test_help_on_a_command_that_does_not_exist_says_so(program: str, words: str) -> None:
    answer, plain = call(f"{program} {words}"), call(f"{program} nonsense")
    assert answer.status == plain.status == 2
    assert answer.err == plain.err and "nonsense" in answer.err
    assert answer.out == ""


def test_a_dataset_with_a_slip_in_its_name_is_asked_about(tmp_path: Path) -> None:
    write_synthetic_dataset(tmp_path / "data" / "glass_table", resolution=8, train_views=1)
    for line in ("datagen look glass_tabel", "proxies make glass_tabel", "model train paper glass_tabel"):
        answer = call(line)
        assert answer.status == 1
        assert answer.error == "error: data/glass_tabel: no dataset; did you mean glass_table?"


def test_a_mistyped_flag_ends_a_process_with_2() -> None:
    line = [sys.executable, "-m", "datagen", "build", "--sceen", "x"]
    answer = subprocess.run(line, capture_output=True, text=True, check=False)
    assert (answer.returncode, answer.stdout) == (2, "")
    assert "Unrecognized options: --sceen" in answer.stderr and "Traceback" not in answer.stderr


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("datagen build --scene glas_table", 2, "did you mean 'glass_table'?"),
        (
            "datagen build --preset dmeo",
            2,
            "invalid choice 'dmeo' for argument '--preset'. Expected one of (",
        ),
        ("datagen build --scene ./nowhere", 1, "nowhere/scene.json: the file is missing"),
        ("datagen build --resolution 0", 1, "resolution: is 0; expected 1 to 8192 pixels"),
        ("datagen build --resolution 320x9999", 1, "resolution: is 9999; expected 1 to 8192 pixels"),
        ("datagen build --resolution wide", 1, "resolution: is 'wide'; expected a width and height such as 320x240"),
        ("datagen build --num-layers 0", 1, "num_layers: is 0; expected 1 to 255"),
        ("datagen build --views nan", 2, "datagen build: Error parsing --views: "),
        ("datagen build --ceiling x", 2, "datagen build: Error parsing --ceiling: "),
        ("datagen build --shard 5/4", 1, "shard: is 5/4; expected a part from 1/4 to 4/4"),
        ("datagen build --workers 0", 1, "workers: is 0; expected 1 to 1024"),
        ("datagen build --count 2", 2, "--family, --count: only for random scenes"),
        ("datagen build --shard 1/2 --overwrite", 2, "--overwrite: cannot be combined with --shard; delete"),
        ("datagen build --spp 99999999", 1, "spp: is 99999999; expected 2 to 1,048,576 samples"),
        ("datagen verify", 1, "data: no dataset there; make one with `datagen build --scene glass_table`"),
        ("datagen verify data/glass_table", 1, "no dataset; make one with `datagen build --scene glass_table`"),
        ("datagen peel nothing", 1, "data/nothing: no dataset; make one with"),
        ("datagen build --sceen x", 2, "datagen build: Unrecognized options: --sceen, x. See `datagen build --help`"),
        ("datagen bulid", 2, "no datagen command 'bulid'; did you mean 'build'? Choose from add, build, "),
        ("proxies make --kind elipsoid", 2, "ellipsoid"),
        ("proxies make", 1, "no dataset"),
        ("model train papr", 2, "paper"),
        ("model train paper", 1, "no dataset"),
        ("eval report nowhere", 1, "nowhere"),
    ],
)
def test_wrong_input_is_answered_with_the_way_out(line: str, status: int, message: str) -> None:
    answer = call(line)
    assert answer.status == status
    assert message in answer.err
    assert len(answer.err.splitlines()) == 1
    assert answer.out == ""


@pytest.mark.parametrize(
    "line",
    ["datagen", "datagen build", "proxies", "proxies make", "model", "model train", "eval", "eval report"],
)
def test_every_command_tells_its_version(line: str) -> None:
    assert call(f"{line} --version") == Answer(status=0, out=f"hyaline {VERSION}\n", err="")
    assert re.fullmatch(r"\d+\.\d+\.\d+", VERSION)


@pytest.mark.parametrize("line", ["datagen verify", "datagen peel", "proxies make", "model train paper"])
def test_a_dataset_may_stand_first_or_behind_its_flag(line: str) -> None:
    first, flag, scene = (call(f"{line} {words}") for words in ("here", "--dataset here", "--scene here"))
    asked = "error: data/here: no dataset; make one with `datagen build --scene glass_table`\n"
    assert first.err == flag.err == scene.err == asked
    assert first.status == flag.status == 1


@pytest.mark.parametrize("line", ["datagen verify", "datagen peel", "model train paper"])
def test_of_several_datasets_the_flag_chooses_one(line: str, tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / "data" / name).mkdir(parents=True)
        (tmp_path / "data" / name / "dataset.json").write_text("{}")
    assert call(line).err == "error: data: holds 2 datasets; name one of data/a, data/b\n"


def test_a_choice_far_from_all_gets_no_suggestion() -> None:
    with pytest.raises(HyalineError, match=r"^no scene 'qqqq'; choose from a, b$"):
        choose("scene", "qqqq", ["b", "a"])


def test_progress_passes_items_through(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track(iter("abc"), label="work", total=5, done=2)) == ["a", "b", "c"]
    assert "work: 5/5" in capsys.readouterr().err


def test_the_time_left_does_not_count_what_the_first_item_compiles(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)

    def work() -> Iterator[int]:
        nonlocal now
        for item in range(4):
            now += 100 if item == 0 else 20
            yield item

    assert list(track(work(), label="work", total=12)) == [0, 1, 2, 3]
    assert capsys.readouterr().err.splitlines() == [
        "work: 1/12",
        "work: 2/12, about 200 s left",
        "work: 3/12, about 180 s left",
        "work: 4/12, about 160 s left",
    ]


def test_output_that_nobody_reads_ends_the_command_without_a_word(tmp_path: Path) -> None:
    line = f"{sys.executable} -m datagen build --help | true; echo ${{PIPESTATUS[0]}}"
    answer = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (answer.stdout, answer.stderr) == ("141\n", "")


@pytest.mark.parametrize("line", ["datagen --version", "datagen --help", "datagen build --help", "datagen scenes"])
@pytest.mark.parametrize("end", [">&-", "> /dev/full"])
def test_a_result_that_cannot_be_printed_is_an_error(line: str, end: str) -> None:
    command = ["bash", "-c", f"exec {sys.executable} -m {line} {end}"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode == 1 and re.fullmatch(
        r"error: standard output\b.*: (is closed|no space).*\n", answer.stderr
    )


def test_a_terminal_that_knows_only_ascii_gets_escapes() -> None:
    code = "from datagen.terminal.command import run, tell; run('arrow', lambda: tell('PSNR dB \u2191'), [])"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert (answer.returncode, answer.stdout) == (0, "PSNR dB \\u2191\n"), answer.stderr


@pytest.mark.parametrize(
    "number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EMFILE, errno.EIO, errno.ENAMETOOLONG]
)
def test_each_refusal_of_the_system_names_the_file_and_its_own_way_out(number: int, tmp_path: Path) -> None:
    with pytest.raises(OSError) as caught, naming(tmp_path / "file"):
        raise OSError(number, os.strerror(number), "temporary name")
    message = describe_os_error(caught.value)
    assert message.startswith(f"{tmp_path / 'file'}: {REASONS[number][0]}; {REASONS[number][1]}")
    assert len({reason for reason, _ in REASONS.values()}) == len(REASONS)


def test_a_full_disk_and_a_forbidden_folder_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fill(dataset: str, /) -> None:
        commit(tmp_path / "folder" / "file", b"x" * 5000)

    (tmp_path / "folder").mkdir()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(SystemExit) as ended:
            command_run("tool", group("", {"fill": fill}), ["fill", "x"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert ended.value.code == 1
    assert capsys.readouterr().err.startswith(
        f"error: {tmp_path / 'folder' / 'file'}: the file would be larger than allowed; raise the limit"
    )
    (tmp_path / "folder" / "file").mkdir()
    with pytest.raises(SystemExit):
        command_run("tool", group("", {"fill": fill}), ["fill", "x"])
    assert "file: is a folder, where a file belongs; move it away" in capsys.readouterr().err


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


def test_a_process_that_is_out_of_file_handles_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def open_nothing(path: Path, flags: int) -> int:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), str(path))

    (tmp_path / "scene.json").touch()
    monkeypatch.setattr("datagen.disk.records.os.open", open_nothing)
    with ending_within(20):
        answer = call("datagen build --scene .")
    assert answer.status == 1
    assert "scene.json: too many files are open in this process; raise the limit" in answer.error


def test_an_error_that_is_its_own_cause_ends_the_command_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def work() -> None:
        try:
            raise HyalineError("place: is wrong")
        except HyalineError as error:
            raise error from error

    def work_in_a_circle() -> None:
        one, other = HyalineError("place: is wrong"), ValueError("inside")
        one.__cause__, other.__cause__ = other, one
        raise one

    for run in (work, work_in_a_circle):
        with pytest.raises(SystemExit) as ended, ending_within(20):
            command_run("program", run, [])
        assert ended.value.code == 1
        assert capsys.readouterr().err == "error: place: is wrong\n"


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
