"""Tests how commands end: one line for a person, a status for a script."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.command import choose, track, version
from datagen.errors import HyalineError


def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, check=False, cwd=cwd)


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("datagen build --scene glas_table", 1, "did you mean 'glass_table'?"),
        ("datagen build --preset dmeo", 1, "did you mean 'demo'?"),
        ("datagen build --scene ./nowhere", 1, "nowhere/scene.json: the file is missing"),
        ("datagen build --resolution 0", 1, "resolution: is 0; expected 1 to 8192 pixels"),
        ("datagen verify", 1, "data: no dataset there; make one with `datagen build --scene glass_table`"),
        ("datagen verify data/glass_table", 1, "no dataset; make one with `datagen build --scene glass_table`"),
        ("datagen peel --dataset nothing", 1, "data/nothing: no dataset; make one with"),
        ("datagen build --sceen x", 2, "--scene"),
        ("datagen bulid", 2, "build"),
        ("proxies make --kind elipsoid", 1, "ellipsoid"),
        ("proxies make", 1, "no dataset"),
        ("model train --method papr", 1, "paper"),
        ("model train --method paper", 1, "no dataset"),
        ("eval report --runs nowhere", 1, "nowhere"),
    ],
)
def test_wrong_input_is_answered_with_the_way_out(line: str, status: int, message: str, tmp_path: Path) -> None:
    answer = run(*line.split(), cwd=tmp_path)
    assert answer.returncode == status
    assert message in answer.stderr
    assert "Traceback" not in answer.stderr
    if status == 1:
        assert len(answer.stderr.splitlines()) == 1
    assert answer.stdout == ""


@pytest.mark.parametrize(
    "line",
    ["datagen", "datagen build", "datagen bench", "proxies", "proxies make", "model", "model train", "model bench step",
     "eval", "eval report"],
)  # fmt: skip
def test_every_command_tells_its_version(line: str, tmp_path: Path) -> None:
    answer = run(*line.split(), "--version", cwd=tmp_path)
    assert (answer.returncode, answer.stdout, answer.stderr) == (0, f"hyaline {version()}\n", "")
    assert re.fullmatch(r"\d+\.\d+\.\d+", version())


@pytest.mark.parametrize("line", ["datagen verify", "datagen peel", "proxies make", "proxies check"])
def test_a_dataset_may_stand_first_or_behind_its_flag(line: str, tmp_path: Path) -> None:
    first, flag = (run(*line.split(), *words, cwd=tmp_path) for words in (["here"], ["--dataset", "here"]))
    assert first.stderr == flag.stderr == "error: data/here: no dataset; make one with `datagen build --scene here`\n"
    assert first.returncode == flag.returncode == 1


@pytest.mark.parametrize("line", ["datagen verify", "datagen peel", "model train --method paper"])
def test_of_several_datasets_the_flag_chooses_one(line: str, tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / "data" / name).mkdir(parents=True)
        (tmp_path / "data" / name / "dataset.json").write_text("{}")
    answer = run(*line.split(), cwd=tmp_path)
    assert answer.stderr == "error: data: holds 2 datasets; choose one with --dataset: data/a, data/b\n"


def test_a_choice_far_from_all_gets_no_suggestion() -> None:
    with pytest.raises(HyalineError, match=r"^scene 'qqqq': there is none of that name; known are a, b$"):
        choose("scene", "qqqq", ["b", "a"])


def test_progress_passes_items_through(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track(iter("abc"), label="work", total=5, done=2)) == ["a", "b", "c"]
    assert "work: 5/5" in capsys.readouterr().err
