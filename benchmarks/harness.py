"""How speed is measured: candidates are checked, then timed in turns in one process, and judged only by their ratios.

A bench names its candidates, its checks and its gates; `measure` runs them and `show` prints what came out:

1. The checks run. Where one fails nothing is timed: a fast wrong answer has no speed.
2. Each candidate is called twice to warm up; the very first call, with whatever it compiles, is reported apart.
3. The candidates take turns (A B C A B C ...), so that other load on the machine affects all of them equally.
4. A gate compares two candidates round by round and passes when the median ratio is large enough. No gate is on
   seconds, which say more about the machine than about the code.

Imports neither Mitsuba nor torch.
"""

import gc
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.machine.processes import num_cores
from datagen.terminal.command import fail, say

MIN_ROUNDS = 3
"""Fewer have no quartiles."""

MIN_BLOCK_S = 0.002
"""Calls shorter than this are repeated within their turn, so that the clock's own cost does not count."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One way to do the task; `run` must not return before the work is done."""

    name: str
    run: Callable[[], object]
    calls: float = 1.0
    """How many such calls the whole task takes; gates compare the time of one call times this."""
    note: str = ""
    """A remark for the reader in a few words."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """A condition for meaningful speed; `run` returns whether it holds, and what it saw."""

    name: str
    run: Callable[[], tuple[bool, str]]


@dataclass(frozen=True, kw_only=True)
class Gate:
    """`candidate` must be at least `at_least` times as fast as `baseline`."""

    name: str
    baseline: str
    candidate: str
    at_least: float


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """The times of one call over all rounds."""

    first: float
    """The very first call, compiling included."""
    median: float
    low: float
    """Lower quartile."""
    high: float
    """Upper quartile."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """One candidate's times; `cpu` adds up all threads of the process."""

    name: str
    note: str
    calls: float
    wall: Seconds
    cpu: Seconds


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The result of a check or a gate."""

    name: str
    passed: bool
    detail: str
    ratio: float | None = None
    """A gate's ratio, the median over the rounds; None for a check."""


@dataclass(frozen=True, kw_only=True)
class BenchReport:
    """All that a bench found."""

    title: str
    settings: dict[str, object]
    facts: dict[str, object]
    """Counts and estimates besides the times."""
    machine: str
    """As `describe_machine` does; figures of two machines are never compared."""
    checks: tuple[Verdict, ...]
    timings: tuple[Timing, ...]
    """In the order of the candidates; empty where a check failed."""
    gates: tuple[Verdict, ...]

    @property
    def passed(self) -> bool:
        return all(verdict.passed for verdict in self.checks + self.gates)


def measure(
    title: str,
    candidates: Sequence[Candidate],
    *,
    checks: Sequence[Check] = (),
    gates: Sequence[Gate] = (),
    settings: Mapping[str, object] | None = None,
    facts: Mapping[str, object] | None = None,
    rounds: int = 7,
) -> BenchReport:
    """Runs the checks, times the candidates in turns, and evaluates the gates.

    Args:
        rounds: turns of every candidate, warm-up apart.
    """
    if rounds < MIN_ROUNDS:
        raise HyalineError(f"rounds: is {rounds}; expected at least {MIN_ROUNDS}")
    names = [candidate.name for candidate in candidates]
    if len(set(names)) < len(names):
        raise HyalineError(f"bench {title}: candidates are called {', '.join(names)}; expected different names")
    checked = []
    for check in checks:
        say(f"{title}: checking {check.name}")
        passed, detail = check.run()
        checked.append(Verdict(name=check.name, passed=bool(passed), detail=detail))
    timings: tuple[Timing, ...] = ()
    judged: tuple[Verdict, ...] = ()
    if all(verdict.passed for verdict in checked):
        walls, cpus = _time_by_turns(title, candidates, rounds)
        timings = tuple(
            Timing(name=one.name, note=one.note, calls=one.calls, wall=_seconds(wall), cpu=_seconds(cpu))
            for one, wall, cpu in zip(candidates, walls, cpus, strict=True)
        )
        series = {one.name: one.calls * wall[1:] for one, wall in zip(candidates, walls, strict=True)}
        judged = tuple(_judge(gate, series) for gate in gates)
    return BenchReport(
        title=title,
        settings={**(settings or {}), "rounds": rounds},
        facts=dict(facts or {}),
        machine=describe_machine(),
        checks=tuple(checked),
        timings=timings,
        gates=judged,
    )


def show(report: BenchReport) -> None:
    """Prints the report on stdout; exits with status 1 when a check or a gate failed."""
    _print_tables(report)
    if not report.passed:
        failed = [verdict for verdict in report.checks + report.gates if not verdict.passed]
        fail("; ".join(f"{report.title}: {verdict.name}: {verdict.detail}" for verdict in failed))


def describe_machine() -> str:
    """The processor, the cores that this process may use, and the threads of each library that was loaded, or that the
    environment asks for."""
    wanted = (
        "OMP_NUM_THREADS",
        "OMP_WAIT_POLICY",
        "GOMP_SPINCOUNT",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMBA_NUM_THREADS",
    )
    threads = {name: os.environ[name] for name in wanted if name in os.environ}
    # Only what the bench itself has loaded: asking must not start another library's threads.
    for library, ask in (("numba", "get_num_threads"), ("torch", "get_num_threads"), ("drjit", "thread_count")):
        if (loaded := sys.modules.get(library)) is not None:
            threads[library] = str(getattr(loaded, ask)())
    told = ", ".join(f"{name} {count}" for name, count in threads.items()) or "as each library likes"
    return f"{_cpu_name()}, {num_cores()} cores; threads: {told}"


def _time_by_turns(title: str, candidates: Sequence[Candidate], rounds: int) -> tuple[list[np.ndarray], ...]:
    """Seconds of (first call, every round) of each candidate: wall and cpu."""
    walls, cpus = ([np.zeros(1 + rounds) for _ in candidates] for _ in range(2))
    repeats = []
    for index, candidate in enumerate(candidates):
        say(f"{title}: warming up {candidate.name}")
        walls[index][0], cpus[index][0] = _time(candidate, 1)
        again, _ = _time(candidate, 1)
        repeats.append(max(1, math.ceil(MIN_BLOCK_S / max(again, 1e-7))))
    was_collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        for turn in range(1, rounds + 1):
            say(f"{title}: round {turn} of {rounds}")
            for index, candidate in enumerate(candidates):
                walls[index][turn], cpus[index][turn] = _time(candidate, repeats[index])
    finally:
        if was_collecting:
            gc.enable()
    return walls, cpus


def _time(candidate: Candidate, repeats: int) -> tuple[float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(repeats):
        candidate.run()
    return (time.perf_counter() - wall) / repeats, (time.process_time() - cpu) / repeats


def _seconds(times: np.ndarray) -> Seconds:
    low, median, high = np.quantile(times[1:], [0.25, 0.5, 0.75])
    return Seconds(first=float(times[0]), median=float(median), low=float(low), high=float(high))


def _judge(gate: Gate, series: Mapping[str, np.ndarray]) -> Verdict:
    # Neighbours in time are compared, so a slow minute of the machine cancels out.
    ratios = series[gate.baseline] / np.maximum(series[gate.candidate], 1e-12)
    low, ratio, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    detail = (
        f"{gate.candidate} is {ratio:.2f} times as fast as {gate.baseline} (quartiles {low:.2f} to "
        f"{high:.2f}); expected at least {gate.at_least:g}"
    )
    return Verdict(name=gate.name, passed=bool(ratio >= gate.at_least), detail=detail, ratio=float(ratio))


def _print_tables(report: BenchReport) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=140)
    settings = ", ".join(f"{name} {value}" for name, value in report.settings.items())
    console.print(f"{report.title}: {settings}", markup=False)
    console.print(report.machine, markup=False)
    for name, value in report.facts.items():
        console.print(f"{name}: {value}", markup=False)
    if report.timings:
        table = Table("", "wall ms", "quartiles", "cpu ms", "first call ms", "note")
        for column in table.columns[1:5]:
            column.justify = "right"
        for one in report.timings:
            spread = f"{1e3 * one.wall.low:.2f} to {1e3 * one.wall.high:.2f}"
            numbers = [one.wall.median, one.cpu.median, one.wall.first]
            wall, cpu, first = (f"{1e3 * value:.2f}" for value in numbers)
            table.add_row(one.name, wall, spread, cpu, first, one.note)
        console.print(table)
    for kind, verdicts in (("check", report.checks), ("gate", report.gates)):
        for verdict in verdicts:
            word = "passed" if verdict.passed else "FAILED"
            console.print(f"{kind} {word}: {verdict.name}: {verdict.detail}", markup=False, soft_wrap=True)


def _cpu_name() -> str:
    path = Path("/proc/cpuinfo")
    if path.is_file():
        for line in path.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
