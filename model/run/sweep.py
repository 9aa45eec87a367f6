"""Sweeps: all runs of an experiment, which is a file of command lines whose braces make grids.

    # What each layer is told of the camera.
    datagen build glass_table
    model train paper glass_table --extrinsics {view,none,sh} --seed {0,1,2}
    model predict $run --variant x2

A line with braces means several, as in a shell: `a{b,c}` is `ab` and `ac`. Lines of `datagen`, `proxies`, `python` and
`model fit` make what is trained on, and come first; then the runs of `model train`, in any order; then all other lines.
`$run` is the folder of each run of the last line of `model train` above. Runs and commands that several lines ask for
are done once. The experiments in `model/experiments/` are known by name, and so are folders of them: `model sweep
table1` is one of `model sweep paper-tables`.

Each run is trained in a process of its own, one per device or several side by side, or in a Slurm job of its own. A
sweep keeps no state: the runs' own folders show what is finished, so a sweep that was stopped or killed continues when
it is started again, and ends in the same bytes.
"""

import itertools
import math
import os
import queue
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from datagen.builder.choices import LaunchChoices
from datagen.data.paths import find_dataset, list_datasets
from datagen.disk.errors import DamagedError, HyalineError, shown
from datagen.disk.storage import read_regular, real_path
from datagen.machine.launch import own_command, raise_failures, run_in_jobs
from datagen.terminal.command import choose, next_command, say, tell
from model.methods.protocol import METHODS
from model.run.train_flags import flags_asked, folder_name, parse_train
from model.settings import RUNS

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

MAKERS = ("datagen", "proxies", "python")
"""Programs that make what runs are trained on."""
PROGRAMS = {name: name for name in (*MAKERS, "model", "eval")} | {"report": "eval", "hyaline-bench": "hyaline_bench"}
"""Programs, and the packages of their commands."""

MAX_RUNS = 1000
"""Upper limit on the lines that one line means; larger grids are probably mistakes."""
MAX_BYTES = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """The content of experiment files."""

    name: str
    needs: tuple[str, ...]
    """Commands that make the datasets and proxies of the runs."""
    runs: tuple[tuple[str, ...], ...]
    """Arguments of `model train`, all different, in the file's order; the last braces of a line vary fastest."""
    then: tuple[str, ...]
    """Commands on finished runs."""


def list_experiments() -> list[str]:
    """The names of the built-in experiments, and of folders of them."""
    return sorted(path.stem for path in EXPERIMENTS.rglob("*"))


def read_experiment(given: str, *, datasets: Sequence[str] = (), seeds: Sequence[int] = ()) -> Experiment:
    """An experiment; each of its runs can be parsed by `model train`.

    Args:
        given: a file, the name of a built-in experiment, or `-` for lines from stdin.
        datasets: replace the file's datasets, which are not made then, unless empty.
        seeds: replace the file's seeds, unless empty.
    """
    needs: dict[str, None] = {}
    runs: dict[str, tuple[str, ...]] = {}
    then: dict[str, None] = {}
    folders: list[Path] = []
    for where, line in _lines(given):
        commands = _expanded(line, where)
        if commands and commands[0][:2] == ["model", "train"]:
            folders = []
            for words in itertools.chain(*(_replaced(words[2:], datasets, seeds) for words in commands)):
                key, folder = _parsed(words, where)
                runs.setdefault(key, words)
                folders.append(folder)
            continue
        for program, *words in commands:
            choose(f"{where}: program", program, PROGRAMS)
            if any("$run" in word for word in words):
                of_runs = ([word.replace("$run", str(folder)) for word in words] for folder in folders)
                then |= dict.fromkeys(shlex.join([program, *filled]) for filled in of_runs)
            elif program not in MAKERS and [program, *words[:1]] != ["model", "fit"]:
                then[shlex.join([program, *words])] = None
            elif not datasets:
                needs[shlex.join([program, *words])] = None
    if not runs:
        raise HyalineError(f"{given}: has no runs; expected at least one line of `model train`")
    return Experiment(name=Path(given).stem, needs=tuple(needs), runs=tuple(runs.values()), then=tuple(then))


def _lines(given: str) -> Iterator[tuple[str, str]]:
    """All lines of an experiment with their places."""
    paths = [Path(given)]
    if given != "-" and not paths[0].suffix:
        choose("experiment", given, list_experiments())
        paths = sorted((EXPERIMENTS / given).glob("*.txt")) or [next(EXPERIMENTS.rglob(f"{given}.txt"))]
    for path in paths:
        data = sys.stdin.buffer.read(MAX_BYTES) if given == "-" else read_regular(path, at_most=MAX_BYTES)
        try:
            lines = data.decode().splitlines()
        except UnicodeDecodeError as error:
            raise DamagedError(f"{path}: not text ({error.reason})") from None
        yield from ((f"{path}: line {number}", line) for number, line in enumerate(lines, start=1))


def _expanded(line: str, where: str) -> list[list[str]]:
    """The words of all command lines that a line means; none of a comment."""
    try:
        words = shlex.split(line, comments=True)
    except ValueError:
        raise HyalineError(f"{where}: is {shown(line)}; expected a command line") from None
    parts = [re.split(r"\{([^{}]*)\}", word) for word in words]
    count = math.prod(choices.count(",") + 1 for word in parts for choices in word[1::2])
    if count > MAX_RUNS:
        raise HyalineError(f"{where}: means {shown(count)} lines; expected at most {MAX_RUNS:,}")
    choices = [[part.split(",") if place % 2 else [part] for place, part in enumerate(word)] for word in parts]
    alternatives = [["".join(each) for each in itertools.product(*word)] for word in choices]
    return [list(each) for each in itertools.product(*alternatives)] if words else []


def _replaced(words: Sequence[str], datasets: Sequence[str], seeds: Sequence[int]) -> Iterator[tuple[str, ...]]:
    """The arguments of `model train` with each of these datasets and seeds, unless there are none."""
    method, *flags = words or [""]
    own = [flags.pop(0)] if flags and not flags[0].startswith("-") else []
    dropped = {"--seed"} if seeds else set[str]()
    dropped |= {"--dataset", "--scene"} if datasets else set()
    pairs = itertools.pairwise(["", *flags])
    flags = [word for before, word in pairs if not dropped & {before, word.partition("=")[0]}]
    for dataset in [[name] for name in datasets] or [own]:
        for seed in [["--seed", str(seed)] for seed in seeds] or [[]]:
            yield (method, *dataset, *flags, *seed)


def _parsed(words: tuple[str, ...], where: str) -> tuple[str, Path]:
    """What is the same of two lines that ask for the same run, and the run's folder."""
    method, *flags = words
    choose(f"{where}: method", method, METHODS.names())
    try:
        asked = parse_train(method, tuple(flags))
        made = None if list_datasets() else "glass_table"  # It will be, by default.
        dataset = real_path(find_dataset(asked.dataset or made)).name
    except HyalineError as error:
        raise HyalineError(f"{where}: {error}") from None
    folder = asked.run.out or RUNS / dataset / folder_name(method, asked)
    return repr((method, dataset, folder, flags_asked(asked))), folder


# Running them


def sweep(
    experiment: Annotated[str, list_experiments],
    /,
    *,
    dataset: tuple[str, ...] = (),
    seed: tuple[int, ...] = (),
    jobs: int = 1,
    dry_run: bool = False,
    cluster: LaunchChoices = LaunchChoices(),  # noqa: B008
) -> None:
    """Train all runs of an experiment file, one process per GPU (or one on the CPU); finished runs are skipped.

    The datasets and proxies that the file names are made first. With --launcher slurm, each run is a Slurm job.

    Args:
        experiment: A file of command lines, whose name ends with .txt (see model/run/sweep.py), - for lines from
            stdin, or the name of one that comes with hyaline.
        dataset: Train on this existing dataset instead of the file's. May be repeated.
        seed: Train with this seed instead of the file's. May be repeated.
        jobs: Parallel processes on each GPU, or on the CPU, whose cores they share. For the highest throughput, use as
            many as fit in memory (about 4 GB each); a run's numbers then differ by rounding.
        dry_run: Print all commands, and do nothing.
    """
    asked = read_experiment(experiment, datasets=dataset, seeds=seed)
    if dry_run:
        for line in (*asked.needs, *map(command_line, asked.runs), *asked.then):
            tell(line)
        return say(f"sweep {asked.name}: {len(asked.runs)} runs")
    run_commands(asked, asked.needs)
    if cluster.launcher is None:
        failures = run_experiment(asked, devices=find_devices(jobs))
    else:  # A job for each run; that of a finished run ends at once.
        trainings = {command_line(words): ["train", *words] for words in asked.runs}
        failures = run_in_jobs("model", trainings, RUNS / "jobs", cluster.launcher, cluster.parameters())
    total = len(asked.runs)
    say(f"sweep {asked.name}: {total - len(failures)} of {total} runs are finished")
    raise_failures(f"sweep {asked.name}", failures, total)
    run_commands(asked, asked.then, shows=True)
    next_command("eval report")


def run_experiment(experiment: Experiment, *, devices: Sequence[str | None]) -> dict[str, str]:
    """Trains every run that is not finished, and continues past those that fail.

    Args:
        devices: one process runs on each at a time, so a device that is named twice runs two; None is the CPU, whose
            cores its processes share evenly.

    Returns:
        Why runs failed, by their command lines, in the experiment's order.
    """
    free: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    for device in devices:
        free.put(device)
    threads = share_of_cores(devices.count(None))
    children, is_stopped = set[subprocess.Popen[str]](), threading.Event()

    def one_run(place: int) -> str:
        device = free.get()
        environment = threads if device is None else {"CUDA_VISIBLE_DEVICES": device}
        try:
            mark = f"[{place + 1}/{len(experiment.runs)}]"
            return _train_in_child(experiment.runs[place], mark, environment, children, is_stopped)
        finally:
            free.put(device)

    with ThreadPoolExecutor(len(devices)) as pool:
        try:
            reasons = list(pool.map(one_run, range(len(experiment.runs))))
        except BaseException:
            # A signal: waiting runs never start, running ones save their work, and the pool waits for them.
            pool.shutdown(wait=False, cancel_futures=True)
            is_stopped.set()
            for child in tuple(children):
                child.terminate()
            raise
    return {command_line(words): reason for words, reason in zip(experiment.runs, reasons, strict=True) if reason}


def command_line(arguments: Sequence[str]) -> str:
    """The command line of one run of an experiment."""
    return shlex.join(["model", "train", *arguments])


def run_commands(experiment: Experiment, commands: Sequence[str], *, shows: bool = False) -> None:
    """Runs commands of an experiment one after the other; finished work is theirs to skip. `shows`: prints theirs, too.

    Raises:
        HyalineError: a command failed.
    """
    for command in commands:
        say(command)
        program, *words = shlex.split(command)
        start = [sys.executable] if program == "python" else own_command(PROGRAMS[program])
        sys.stdout.flush()
        stdout = None if shows else subprocess.DEVNULL
        if status := subprocess.run([*start, *words], stdout=stdout, check=False).returncode:
            raise HyalineError(
                f"sweep {experiment.name}: `{command}` ended with status {status}, for the reason above; "
                "fix it and run the same command again to continue"
            )


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
    from datagen.machine.processes import num_cores  # Not before: it brings NumPy, and help is printed from here.

    threads = str(max(1, num_cores() // jobs))
    return {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}


def _train_in_child(
    arguments: Sequence[str],
    place: str,
    environment: Mapping[str, str],
    children: set[subprocess.Popen[str]],
    is_stopped: threading.Event,
) -> str:
    """Runs `model train` to its end, and passes its messages on, prefixed with `place`; why it failed, or nothing."""
    device = environment.get("CUDA_VISIBLE_DEVICES")
    say(f"{place} {command_line(arguments)}" + ("" if device is None else f" (CUDA device {device})"))
    child = subprocess.Popen(
        [*own_command("model"), "train", *arguments],
        env=os.environ | environment,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    children.add(child)
    if is_stopped.is_set():  # Others were told to stop while this one started.
        child.terminate()
    assert child.stderr is not None
    last = error = ""
    for line in child.stderr:
        last = line.strip() or last
        error = last if last.startswith("error: ") else error
        if not last.startswith("next: "):
            say(f"{place} {line.rstrip()}")
    status = child.wait()
    children.discard(child)
    ended = f"ended by signal {-status}" if status < 0 else f"exit status {status}"
    return (error.removeprefix("error: ") or f"{ended}; its last message: {last or 'none'}") if status else ""
