"""Sweeps: grids of runs from experiment files in TOML, each run equal to one command line of `model train`.

    about = "What the experiment shows, in one line."

    [[runs]]                              # a grid: every combination of the values that are lists
    dataset = ["glass_table", "vitrine"]
    method = "paper"                      # or several, which must all know the flags of the block
    extrinsics = ["none", "view", "sh"]   # a key is a flag of `model train` without its dashes
    zero-layer = [false, true]            # a switch
    seed = [0, 1, 2]

Blocks add up; a run that is in two of them is trained once. The files of the paper's tables are in `model/experiments/`
and are known by name: `model sweep table1`.

Each run is trained in a process of its own, one per device or several side by side, or in a Slurm job of its own
(`model/run/jobs.py`). A sweep keeps no state: the runs' own folders show what is finished, so a sweep that was stopped
or killed continues when it is started again, and ends in the same bytes.
"""

import dataclasses
import difflib
import itertools
import math
import os
import queue
import shlex
import subprocess
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.records import load_toml, shown
from datagen.machine.launch import LaunchChoices, own_command
from datagen.machine.mitsuba_variant import num_cores
from datagen.terminal.command import choose, say
from datagen.terminal.parsing import flags_of
from model.methods.table import METHODS
from model.run.train_flags import flags_of_method, parse_train

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

KEPT_FLAGS = ("out", "label", "overwrite", *flags_of(LaunchChoices))
"""Flags that an experiment may not set: runs go to the default folder of `model train`, stopped runs resume, and where
runs are trained is for `model sweep` to say."""

MAX_RUNS = 1000
"""Upper limit on an experiment's runs; larger grids are probably mistakes."""

Value = bool | int | float | str


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """The content of an experiment file."""

    name: str
    """The file's name without its extension."""
    about: str
    runs: tuple[tuple[str, ...], ...]
    """Arguments of `model train`, all different, in the file's order; the last value of a block varies fastest."""


def list_experiments() -> list[str]:
    """The names of the built-in experiments."""
    return sorted(path.stem for path in EXPERIMENTS.glob("*.toml"))


def read_experiment(given: str, *, datasets: Sequence[str] = (), seeds: Sequence[int] = ()) -> Experiment:
    """An experiment; each of its runs can be parsed by `model train`.

    Args:
        given: a file, or the name of a built-in experiment.
        datasets: replace the file's datasets, unless empty.
        seeds: replace the file's seeds, unless empty.
    """
    path = Path(given)
    if path.suffix != ".toml":
        path = EXPERIMENTS / f"{choose('experiment', given, list_experiments())}.toml"
    if not os.path.lexists(path):
        raise HyalineError(f"{path}: the file is missing; built-in experiments are {', '.join(list_experiments())}")
    content = load_toml(path)
    if unknown := sorted(set(content) - {"about", "runs"}):
        raise HyalineError(f"{path}: unknown key {shown(unknown[0])}; known are about and runs")
    about, blocks = content.get("about", ""), content.get("runs", [])
    if not isinstance(about, str):
        raise HyalineError(f"{path}: about is {shown(about)}; expected text")
    if not (isinstance(blocks, list) and blocks and all(isinstance(block, dict) for block in blocks)):
        raise HyalineError(f"{path}: has no runs; expected at least one [[runs]] block")
    replaced = {"dataset": list(datasets), "seed": list(seeds)}
    # In the block's order, so that the given seeds vary like the file's.
    asked = [block | {key: values for key, values in replaced.items() if values} for block in blocks]
    if (count := sum(map(_count_runs, asked))) > MAX_RUNS:
        raise HyalineError(
            f"{path}: asks for {shown(count)} runs; expected at most {MAX_RUNS:,}, split it into several files"
        )
    runs: dict[str, tuple[str, ...]] = {}
    for place, block in enumerate(asked):
        for arguments, parsed in _grid(block, where=f"{path}: runs[{place}]"):
            runs.setdefault(repr((arguments[0], parsed)), arguments)
    return Experiment(name=path.stem, about=about, runs=tuple(runs.values()))


def _flat(record: object) -> dict[str, object]:
    """The fields of a record of choices, including those of nested records."""
    values: dict[str, object] = {}
    for item in dataclasses.fields(record):  # pyright: ignore[reportArgumentType]
        value = getattr(record, item.name)
        values |= _flat(value) if dataclasses.is_dataclass(value) else {item.name: value}
    return values


def _grid(block: Mapping[str, object], *, where: str) -> list[tuple[tuple[str, ...], object]]:
    """The arguments of each run of a block, raw and parsed."""
    if "method" not in block:
        raise HyalineError(f'{where}: key "method" is missing; expected the name of one, such as method = "paper"')
    methods = [choose(f"{where}: method", str(method), METHODS.names()) for method in _values(block, "method", where)]
    axes: list[list[tuple[str, ...]]] = []
    for key in block:
        if key == "method":
            axes.append([(method,) for method in methods])
            continue
        for method in methods:
            _check_key(key, method, where)
        axes.append([_flag(key, value, methods[0], where) for value in _values(block, key, where)])
    runs = []
    for combination in itertools.product(*axes):
        by_key = dict(zip(block, combination, strict=True))
        (method,), dataset = by_key.pop("method"), by_key.pop("dataset", ())
        words = (*dataset, *itertools.chain(*by_key.values()))
        runs.append(((method, *words), parse_train(method, words)))
    return runs


def _count_runs(block: Mapping[str, object]) -> int:
    return math.prod(len(values) for values in block.values() if isinstance(values, list))


def _values(block: Mapping[str, object], key: str, where: str) -> list[object]:
    given = block[key]
    values = given if isinstance(given, list) else [given]
    if not values:
        raise HyalineError(f"{where}: {key} is an empty list; expected at least one value")
    return values


def _check_key(key: str, method: str, where: str) -> None:
    if key in KEPT_FLAGS:
        raise HyalineError(f"{where}: {key} cannot be set in an experiment; leave it out")
    flags = flags_of_method(method)
    if key not in (*flags, "dataset"):
        near = difflib.get_close_matches(key[:100], list(flags), n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise HyalineError(
            f"{where}: unknown key {shown(key)}; {hint}expected a flag of `model train {method}` without its dashes"
        )


def _flag(key: str, value: object, method: str, where: str) -> tuple[str, ...]:
    """The arguments that set a flag to a value."""
    if key == "dataset":
        return (str(value),)
    is_switch = isinstance(_flat(parse_train(method, ()))[flags_of_method(method)[key]], bool)
    if not isinstance(value, Value) or isinstance(value, bool) != is_switch:
        expected = "true or false" if is_switch else "a number or text, or a list of them"
        raise HyalineError(f"{where}: {key} is {shown(value)}; expected {expected}")
    if is_switch:
        return (f"--{key}" if value else f"--no-{key}",)
    arguments = (f"--{key}", str(value))
    try:
        parse_train(method, arguments)
    except HyalineError:
        raise HyalineError(
            f"{where}: {key} is {shown(value)}, which `model train` does not take; see `model train {method} --help`"
        ) from None
    return arguments


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A run that was not finished."""

    command: str
    reason: str
    """Its last error, or the signal that ended it."""


class Children:
    """The running processes, including any that start while they are being stopped."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._living: set[subprocess.Popen[str]] = set()
        self._is_stopped = False

    def add(self, child: subprocess.Popen[str]) -> None:
        with self._lock:
            self._living.add(child)
            if self._is_stopped:
                child.terminate()

    def remove(self, child: subprocess.Popen[str]) -> None:
        with self._lock:
            self._living.discard(child)

    def stop(self) -> None:
        with self._lock:
            self._is_stopped = True
            for child in self._living:
                child.terminate()


def command_line(arguments: Sequence[str]) -> str:
    """The command line of one run of an experiment."""
    return shlex.join(["model", "train", *arguments])


def run_experiment(experiment: Experiment, *, devices: Sequence[str | None]) -> tuple[Failure, ...]:
    """Trains every run that is not finished, and continues past those that fail.

    Args:
        devices: one process runs on each at a time, so a device that is named twice runs two; None is the CPU, whose
            cores its processes share evenly.

    Returns:
        The runs that failed, in the experiment's order.
    """
    free: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    for device in devices:
        free.put(device)
    children = Children()
    total = len(experiment.runs)
    threads = share_of_cores(devices.count(None))

    def one_run(place: int) -> Failure | None:
        device = free.get()
        environment = threads if device is None else {"CUDA_VISIBLE_DEVICES": device}
        try:
            return _train_in_child(experiment.runs[place], f"[{place + 1}/{total}]", environment, children)
        finally:
            free.put(device)

    with ThreadPoolExecutor(len(devices)) as pool:
        try:
            results = list(pool.map(one_run, range(total)))
        except BaseException:
            # A signal: waiting runs never start, running ones save their work, and the pool waits for them.
            pool.shutdown(wait=False, cancel_futures=True)
            children.stop()
            raise
    return tuple(failure for failure in results if failure is not None)


def find_devices(jobs: int) -> tuple[str | None, ...]:
    """The CUDA devices, named as in CUDA_VISIBLE_DEVICES, or None for the CPU; each repeated `jobs` times."""
    import torch

    if jobs < 1:
        raise HyalineError(f"jobs: is {jobs}; expected at least 1")
    count = torch.cuda.device_count()
    if count == 0:
        return (None,) * jobs
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return tuple(visible.split(",")[:count] if visible else map(str, range(count))) * jobs


def share_of_cores(jobs: int) -> dict[str, str]:
    """Environment variables that limit the threads of each of several CPU processes; empty for a single one."""
    if jobs < 2:
        return {}
    threads = str(max(1, num_cores() // jobs))
    return {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}


def raise_failures(experiment: Experiment, failures: Sequence[Failure]) -> None:
    """Reports how many runs are finished, and raises a HyalineError if any failed."""
    total = len(experiment.runs)
    say(f"sweep {experiment.name}: {total - len(failures)} of {total} runs are finished")
    for failure in failures:
        say(f"failed: {failure.command}: {failure.reason}")
    if failures:
        raise HyalineError(
            f"sweep {experiment.name}: {len(failures)} of {total} runs failed, for the reasons above; "
            "fix them and run the same command again to continue"
        )


def _train_in_child(
    arguments: Sequence[str], place: str, environment: Mapping[str, str], children: Children
) -> Failure | None:
    """Runs `model train` to its end, and passes its messages on, prefixed with `place`."""
    command = command_line(arguments)
    device = environment.get("CUDA_VISIBLE_DEVICES")
    say(f"{place} {command}" + ("" if device is None else f" (CUDA device {device})"))
    child = subprocess.Popen(
        [*own_command("model"), "train", *arguments],
        env=os.environ | environment,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    children.add(child)
    assert child.stderr is not None
    last = error = ""
    for line in child.stderr:
        last = line.strip() or last
        error = last if last.startswith("error: ") else error
        if not last.startswith("next: "):
            say(f"{place} {line.rstrip()}")
    status = child.wait()
    children.remove(child)
    if status == 0:
        return None
    ended = f"ended by signal {-status}" if status < 0 else f"exit status {status}"
    return Failure(
        command=command, reason=error.removeprefix("error: ") or f"{ended}; its last message: {last or 'none'}"
    )
