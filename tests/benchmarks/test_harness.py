"""Tests that benches check before they time, take turns, judge by ratios, and end with the right status."""

import json

import pytest

from benchmarks.harness import BenchReport, Candidate, Check, Gate, machine_ceilings, measure, show
from datagen.disk.errors import HyalineError


class Clock:
    """A clock that only those move who say how long they take: no load on this machine shows in it."""

    def __init__(self) -> None:
        self.wall = 0.0

    def perf_counter(self) -> float:
        self.wall += 1e-6  # Looking at it takes a moment, too, or calls without work would be repeated for ever.
        return self.wall

    def process_time(self) -> float:
        return 0.0

    def sleep(self, seconds: float) -> None:
        self.wall += seconds


clock = Clock()


@pytest.fixture(autouse=True)
def _clock(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "real_clock" not in request.fixturenames:
        monkeypatch.setattr("benchmarks.harness.time", clock)


@pytest.fixture
def real_clock() -> None:
    """The machine's own clock."""


def sleeper(name: str, milliseconds: float, calls: float = 1.0) -> Candidate:
    return Candidate(name=name, run=lambda: clock.sleep(1e-3 * milliseconds), calls=calls)


def report(at_least: float) -> BenchReport:
    gates = [Gate(name="speed-up", baseline="slow", candidate="fast", at_least=at_least)]
    return measure("sleep", [sleeper("slow", 12), sleeper("fast", 3)], gates=gates, rounds=3)


def test_candidates_take_turns_after_their_warm_up() -> None:
    calls: list[str] = []

    def logged(name: str) -> Candidate:
        return Candidate(name=name, run=lambda: (calls.append(name), clock.sleep(0.003)))

    measure("turns", [logged("A"), logged("B")], rounds=4)
    assert "".join(calls) == "AABB" + 4 * "AB"


def test_a_gate_that_is_met_passes_and_one_that_is_missed_exits_with_status_1(
    capsys: pytest.CaptureFixture[str],
) -> None:
    show(report(at_least=2), as_json=False)
    assert "gate passed: speed-up" in capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        show(report(at_least=9), as_json=False)
    assert end.value.code == 1
    printed = capsys.readouterr()
    assert "gate FAILED: speed-up" in printed.out
    assert "expected at least 9" in printed.err


def test_stdout_is_json_alone_also_when_a_gate_is_missed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        show(report(at_least=9), as_json=True)
    parsed = json.loads(capsys.readouterr().out)
    assert parsed["passed"] is False
    assert parsed["gates"][0]["ratio"] == pytest.approx(4, rel=0.01)
    slow, fast = parsed["timings"]
    assert slow["wall"]["low"] <= slow["wall"]["median"] <= slow["wall"]["high"]
    assert slow["cpu"]["median"] < 0.5 * slow["wall"]["median"]  # Who sleeps needs no processor.
    assert fast["wall"]["first"] > 0


def test_where_a_check_fails_nothing_is_timed(capsys: pytest.CaptureFixture[str]) -> None:
    def run() -> None:
        raise AssertionError("timed in spite of the check")

    check = Check(name="answers", run=lambda: (False, "3 pixels differ"))
    failed = measure("wrong", [Candidate(name="A", run=run)], checks=[check])
    assert failed.timings == ()
    with pytest.raises(SystemExit) as end:
        show(failed, as_json=False)
    assert end.value.code == 1
    assert "wrong: answers: 3 pixels differ" in capsys.readouterr().err


def test_a_gate_counts_how_many_calls_the_task_takes() -> None:
    gates = [Gate(name="g", baseline="many", candidate="once", at_least=5)]
    found = measure("calls", [sleeper("many", 3, calls=10), sleeper("once", 3)], gates=gates, rounds=3)
    assert found.gates[0].ratio == pytest.approx(10, rel=0.01)


def test_a_gate_whose_candidate_did_not_run_says_so() -> None:
    gates = [Gate(name="g", baseline="A", candidate="B", at_least=5)]
    verdict = measure("part", [sleeper("A", 3)], gates=gates, rounds=3).gates[0]
    assert verdict.passed
    assert verdict.ratio is None
    assert "B did not run" in verdict.detail


def test_short_calls_are_repeated_within_their_turn() -> None:
    count = [0]

    def run() -> None:
        count[0] += 1

    measure("short", [Candidate(name="A", run=run)], rounds=3)
    assert count[0] > 100


def test_too_few_rounds_and_equal_names_are_refused() -> None:
    with pytest.raises(HyalineError, match="rounds: is 2; expected at least 3"):
        measure("few", [sleeper("A", 1)], rounds=2)
    with pytest.raises(HyalineError, match="expected different names"):
        measure("same", [sleeper("A", 1), sleeper("A", 1)])


@pytest.mark.usefixtures("real_clock")
def test_the_machines_ceilings_are_plausible() -> None:
    matmul, copy, gather = machine_ceilings()
    assert 1 < matmul.value < 1e5
    assert 0.5 < copy.value < 1e4
    assert 0.1 < gather.value < 1e4
