"""Tests that hostile files are refused in one line or accepted with exact counts, and that none is the end of anything.

Most are refused by a line that names the file, and nearly always the key of the value that is wrong. The others are in
outcomes.tsv, with what is accepted of them or what the line names instead. After a change,
`pytest plugins/tests/reliability/test_hostile_files.py --rewrite-outcomes` writes that file again; read the difference.
"""

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

OUTCOMES = Path(__file__).with_name("outcomes.tsv")
CHILD = Path(__file__).resolve().parents[3] / "tests" / "support" / "hostile" / "try_all.py"
STEP = 16
"""A quick run tries every sixteenth file."""
MOST_BYTES = 2 << 30


@dataclass(frozen=True, kw_only=True)
class Tried:
    """What came of each file, by its name."""

    outcomes: dict[str, str]
    places: dict[str, str]
    """The same in short: `accepted` with counts, `refused` with what is named; nothing where that is the file."""
    keys: list[bool]
    """Of each refusal of one wrong value, whether the value's key is named."""
    ended: dict[str, str]
    """How commands ended that were given a tenth of the files."""
    peak: int
    """Most bytes of memory that were held."""


@pytest.fixture(scope="module")
def step(request: pytest.FixtureRequest, is_full: bool) -> int:
    return 1 if is_full or request.config.getoption("--rewrite-outcomes") else STEP


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory, step: int) -> Tried:
    """A child reads them; its cache is nowhere near its home."""
    out = tmp_path_factory.mktemp("hostile") / "out.jsonl"
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache"))}
    command = [sys.executable, str(CHILD), str(out), str(step)]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=7200, check=False).stderr
    lines = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    assert lines and "peak" in lines[-1], f"the reader died of {lines[-1:]}: {said[-2000:]}"
    outcomes = {line["name"]: line["outcome"] for line in lines if "outcome" in line}
    begun = [line for line in lines if "begin" in line]
    places = {line["name"]: _place(outcomes[line["name"]], line["path"]) for line in begun}
    keys = [
        _names_key(outcomes[line["name"]], line["path"], line["key"])
        for line in begun
        if line["key"] and not places[line["name"]]
    ]
    ended = {line["name"]: line["ended"] for line in lines if "ended" in line}
    return Tried(outcomes=outcomes, places=places, keys=keys, ended=ended, peak=lines[-1]["peak"])


def _place(outcome: str, path: str) -> str:
    """What a refusal names, or what was accepted; nothing for a refusal that names the file."""
    kind, _, said = outcome.partition(": ")
    if kind != "refused":
        return outcome
    return "" if path in said else f"refused: {said.split(': ')[0]}"


def _names_key(outcome: str, path: str, key: str) -> bool:
    return re.search(rf"\b{re.escape(key)}\b", outcome.replace(path, "")) is not None


@pytest.mark.promise("R6", "R7")
def test_every_hostile_file_ends_as_the_table_says(tried: Tried, step: int, request: pytest.FixtureRequest) -> None:
    outcomes = tried.outcomes
    if request.config.getoption("--rewrite-outcomes"):
        OUTCOMES.write_text("".join(f"{name}\t{place}\n" for name, place in tried.places.items() if place))
    wrong = [
        f"{name}: {outcome}" for name, outcome in outcomes.items() if not outcome.startswith(("refused", "accept"))
    ]
    assert not wrong, f"{len(wrong)} of {len(outcomes)}:\n" + "\n".join(wrong)
    expected = dict(line.split("\t", 1) for line in OUTCOMES.read_text().splitlines())
    if step > 1:
        expected = {name: place for name, place in expected.items() if name in outcomes}
    assert len(outcomes) * step >= 1400
    different = [
        f"{name}: {outcomes.get(name)}; expected {expected.get(name, 'a refusal that names the file')}"
        for name in sorted(outcomes.keys() | expected.keys())
        if tried.places.get(name) != expected.get(name, "")
    ]
    assert not different, f"{len(different)}:\n" + "\n".join(different[:40])
    share = 0.6 if step == 1 else 0.4  # A sample of some thirty.
    assert sum(tried.keys) > share * len(tried.keys), f"{sum(tried.keys)} of {len(tried.keys)} name the key"
    assert tried.peak < MOST_BYTES, f"{tried.peak >> 20} MB were held"


@pytest.mark.promise("R6", "R7")
def test_commands_end_as_the_readers_do(tried: Tried, step: int) -> None:
    assert len(tried.ended) * step > 120
    wrong = {name: end for name, end in tried.ended.items() if not end.startswith(("refused: error: ", "accepted: "))}
    assert not wrong
    silent = {
        name: tried.outcomes[name]
        for name, end in tried.ended.items()
        if end.startswith("accepted: ")
        and not tried.outcomes[name].startswith("accepted: ")
        # Its pictures are of the run as it was; the command reads the run alone.
        and "its pictures are by another run" not in tried.outcomes[name]
    }
    assert not silent
