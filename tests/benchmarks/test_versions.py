"""Tests the comparison with an earlier version: what it keeps, what it says of rows that fail, what its child notes."""

import json
import sys
from pathlib import Path

import pytest
from support.synthetic import write_synthetic_dataset

from benchmarks import versions
from benchmarks.versions import MEASURES, Values, Version, compare_versions, demo_commands
from datagen.disk.errors import HyalineError

ROOT = Path(__file__).parents[2]
BEFORE, NOW = "1111111", "2222222"
DEMO = "`make demo` after set-up, CPU s"


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Replaces measurements by known values, and lists those that are asked for: the measure and the commit.

    A round's values are 1 to 3 times as large as the first's; the version of today takes half of them.
    """
    called: list[tuple[str, str]] = []
    numbers = {name: 1.0 + place for place, name in enumerate(
        ("light-path", "view", "train", "512²", "paper-best", "plain", "dispersive", "scenes", "build", "first line")
    )}  # fmt: skip

    def measure(name: str) -> versions.Measure:
        def measured(version: Version) -> Values:
            called.append((name, version.folder.name))
            turn = called.count((name, version.folder.name))
            is_now = version.folder.name == NOW
            return {key: turn * (0.5 if is_now else 1.0) * value for key, value in numbers.items()}

        return measured

    monkeypatch.setattr(versions, "ROOT", tmp_path)
    monkeypatch.setattr(versions, "MEASURES", {name: measure(name) for name in MEASURES})
    monkeypatch.setattr(versions, "find_commit", lambda name: NOW if name == "HEAD" else BEFORE)
    monkeypatch.setattr(versions, "has_changes", lambda: False)
    monkeypatch.setattr(versions.Comparison, "prepare", lambda _: None)

    def find_version(folder: Path, commit: str, python: Path) -> Version:
        (folder / commit).mkdir(parents=True, exist_ok=True)
        return Version(tree=folder, folder=folder / commit, python=python)

    monkeypatch.setattr(versions, "find_version", find_version)
    return called


def rows_of(table: str) -> dict[str, list[str]]:
    lines = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
    return {cells[0]: cells[1:] for cells in lines[1:]}


def test_the_table_has_medians_and_ratios_with_their_range(calls: list[tuple[str, str]]) -> None:
    rows = rows_of(compare_versions("v1", rounds=3, python=Path(sys.executable)))
    assert len(rows) == len(versions.ROWS)
    assert rows["`light-path` step, CPU ms"] == ["2,000", "1,000", "0.50 (0.50 to 0.50)"]
    assert rows["the same, relative to 128²"] == ["4.00", "4.00", "1.00 (1.00 to 1.00)"]
    assert calls[:4] == [("datagen", BEFORE), ("datagen", NOW), ("light-path", BEFORE), ("light-path", NOW)]
    second = calls[2 * len(MEASURES) :]
    assert second[:2] == [("datagen", NOW), ("datagen", BEFORE)]  # Each version is first in every second round.


def test_a_later_call_measures_only_what_is_missing(calls: list[tuple[str, str]]) -> None:
    first = compare_versions("v1", rounds=1, python=Path(sys.executable))
    assert compare_versions("v1", rounds=1, python=Path(sys.executable)) == first
    assert len(calls) == 2 * len(MEASURES)
    compare_versions("v1", rounds=2, python=Path(sys.executable))
    assert len(calls) == 4 * len(MEASURES)


def test_the_demo_is_measured_once_and_only_if_asked_for(
    calls: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    called = []

    def call(version: Version, *words: str) -> float:
        called.append((version.folder.parent.name, words[1]))
        return 3.0 if "light-path" in words else 1.0

    monkeypatch.setattr(Version, "call", call)
    commands = demo_commands(ROOT / "Makefile")
    (folder := versions.ROOT / "build" / "compare" / f"{BEFORE}-{NOW}").mkdir(parents=True)
    (folder / "Makefile").write_text((ROOT / "Makefile").read_text())
    assert rows_of(compare_versions("v1", rounds=1, python=Path(sys.executable)))[DEMO] == ["-", "-", "-"]
    rows = rows_of(compare_versions("v1", rounds=2, python=Path(sys.executable), demo=True))
    assert rows[DEMO] == [str(len(commands) + 2)] * 2 + ["1.00 (1.00 to 1.00)"]
    assert rows["`light-path` in it, CPU s"][0] == "3" and rows["`datagen build` in it, CPU s"][0] == "1"
    assert called[:4] == [(BEFORE, "datagen"), (NOW, "datagen"), (BEFORE, "proxies"), (NOW, "proxies")]
    assert len(called) == 2 * len(commands) == 2 * len(versions.ONCE)
    assert commands[0] == ["datagen", "build", "--scene", "glass_table"] and commands[-1] == ["eval", "report"]
    assert all(words[0] in ("datagen", "proxies", "model", "eval") for words in commands)


def test_a_row_that_a_version_cannot_have_gives_the_reason_and_takes_no_other_with_it(
    calls: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails_before(version: Version) -> Values:
        calls.append(("paths", version.folder.name))
        if version.folder.name == BEFORE:
            raise HyalineError("ImportError: cannot import name 'default_light_path'")
        return {"plain": 1e-6, "dispersive": 2e-6}

    monkeypatch.setitem(versions.MEASURES, "paths", fails_before)
    table = compare_versions("v1", rounds=3, python=Path(sys.executable))
    rows = rows_of(table)
    assert rows["light paths, CPU µs a ray"] == ["-", "1.00", "-"]
    assert rows["`paper-best` step, CPU ms"][2] == "0.50 (0.50 to 0.50)"
    assert table.splitlines()[-1] == f"paths, {BEFORE}: ImportError: cannot import name 'default_light_path'"
    assert calls.count(("paths", BEFORE)) == 1
    calls.clear()
    compare_versions("v1", rounds=3, python=Path(sys.executable))
    assert calls == [("paths", BEFORE)]


def test_a_commit_that_does_not_exist_is_named() -> None:
    with pytest.raises(HyalineError, match="--commit 0000000: fatal: Needed a single revision"):
        versions.find_commit("0000000")


@pytest.mark.full
def test_the_child_notes_the_first_line_each_step_and_each_view(tmp_path: Path) -> None:
    version = Version(tree=ROOT, folder=tmp_path, python=Path(sys.executable))
    (line,) = version.watch("first-line", "datagen", "scenes")["first line"]
    assert 0 < line <= 1.5 * version.call("-m", "datagen", "scenes") + 0.5
    write_synthetic_dataset(tmp_path / "data" / "synthetic", resolution=16)
    words = ["model", "train", "paper", "data/synthetic", "--steps", "4", "--batch", "64", "--hidden", "8"]
    stamps = version.watch("steps", "3", *words, "--out", "some")
    assert len(stamps["steps"]) == 3 and not (tmp_path / "some" / "weights.pt").exists()
    stamps = version.watch("views", *words, "--out", "all")
    assert len(stamps["steps"]) == 4 and (tmp_path / "all" / "weights.pt").exists()
    record = json.loads((tmp_path / "all" / "predictions.json").read_text())
    assert len(stamps["views"]) == len(record["files"])
    assert stamps["steps"] == sorted(stamps["steps"]) and stamps["steps"][-1] < stamps["views"][0]


@pytest.mark.parametrize("kind", ["first-line", pytest.param("views", marks=pytest.mark.full)])
def test_a_command_that_fails_gives_its_last_line(kind: str, tmp_path: Path) -> None:
    version = Version(tree=ROOT, folder=tmp_path, python=Path(sys.executable))
    with pytest.raises(HyalineError, match="data/absent: no dataset"):
        version.watch(kind, "model", "train", "paper", "data/absent")


def test_threads_are_a_versions_own_unless_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    words = ["-c", f"import os; open({str(tmp_path / 'told')!r}, 'w').write(os.environ.get('OMP_NUM_THREADS', 'own'))"]
    for threads, told in ((0, "own"), (1, "1")):
        Version(tree=tmp_path, folder=tmp_path, python=Path(sys.executable), threads=threads).call(*words)
        assert (tmp_path / "told").read_text() == told
