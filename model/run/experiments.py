"""Experiments: files of command lines, whose braces make grids.

    # What each layer is told of the camera.
    datagen build glass_table
    model train paper glass_table --extrinsics {view,none,sh} --seed {0,1,2}
    model predict $run --variant x2

A line with braces means several, as in a shell: `a{b,c}` is `ab` and `ac`. Lines of `datagen`, `proxies`, `python` and
`model fit` make what is trained on, and come first; then the runs of `model train`, in any order; then all other lines.
`$run` is the folder of each run of the last line of `model train` above. Runs and commands that several lines ask for
are done once.

The experiments in `model/experiments/` are known by name, and so are folders of them: `model sweep table1` is one of
`model sweep paper-tables`.
"""

import itertools
import math
import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.disk.errors import DamagedError, HyalineError, shown
from datagen.disk.storage import read_regular
from datagen.terminal.command import choose
from model.methods.table import METHODS
from model.run.train_flags import folder_name, parse_train
from model.settings import RUNS

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

MAKERS = ("datagen", "proxies", "python")
"""Programs that make what runs are trained on."""
PROGRAMS = (*MAKERS, "model", "report", "hyaline-bench")

MAX_RUNS = 1000
"""Upper limit on an experiment's runs, and on the lines that one means; larger grids are probably mistakes."""
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
            if len(runs) > MAX_RUNS:
                raise HyalineError(f"{where}: more than {MAX_RUNS:,} runs; split the experiment into several files")
            continue
        for program, *words in commands:
            choose(f"{where}: program", program, PROGRAMS)
            if "$run" in words:
                of_runs = ([str(folder) if word == "$run" else word for word in words] for folder in folders)
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
    if seeds and "--seed" in flags:
        place = flags.index("--seed")
        del flags[place : place + 2]
    for dataset in [[name] for name in datasets] or [own]:
        for seed in [["--seed", str(seed)] for seed in seeds] or [[]]:
            yield (method, *dataset, *flags, *seed)


def _parsed(words: tuple[str, ...], where: str) -> tuple[str, Path]:
    """What is the same of two lines that ask for the same run, and the run's folder."""
    method, *flags = words
    choose(f"{where}: method", method, METHODS.names())
    try:
        asked = parse_train(method, tuple(flags))
    except HyalineError as error:
        raise HyalineError(f"{where}: {error}") from None
    dataset = Path(asked.dataset or "glass_table").name
    return repr((method, asked)), asked.run.out or RUNS / dataset / folder_name(method, asked)
