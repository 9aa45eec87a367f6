"""Experiment files: grids of runs in TOML, each run equal to one command line of `model train`.

    about = "What the experiment shows, in one line."

    [[runs]]                              # a grid: every combination of the values that are lists
    dataset = ["glass_table", "vitrine"]
    method = "paper"                      # or several, which must all know the flags of the block
    extrinsics = ["none", "view", "sh"]   # a key is a flag of `model train` without its dashes
    zero-layer = [false, true]            # a flag without a value is given where true
    seed = [0, 1, 2]

Blocks add up; a run that two of them ask for is trained once. The files of the paper's tables lie in
`model/experiments/` and go by their names: `model sweep table1`.
"""

import dataclasses
import difflib
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.reading import load_toml
from datagen.disk.records import shown
from datagen.terminal.command import choose
from model.methods.table import METHODS
from model.run.train_flags import check_words, flags_of_method

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

KEPT_FLAGS = ("out", "name", "overwrite")
"""Those that no run of an experiment may set: its folder is the one that `model train` gives, and a run that was
stopped goes on."""

MAX_RUNS = 1000
"""Of an experiment: what asks for more has a slip in it, or would take a year."""

Value = bool | int | float | str


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """What a file asks for."""

    name: str
    """The file's, without its ending."""
    about: str
    runs: tuple[tuple[str, ...], ...]
    """Arguments of `model train`, all different, in the file's order; the last value of a block varies fastest."""


def list_experiments() -> list[str]:
    """The names of the experiments that come with the program."""
    return sorted(path.stem for path in EXPERIMENTS.glob("*.toml"))


def read_experiment(given: str, *, datasets: Sequence[str] = (), seeds: Sequence[int] = ()) -> Experiment:
    """An experiment, every run of which `model train` can parse.

    Args:
        given: a file, or the name of one that comes with the program.
        datasets: instead of the file's; none leaves them.
        seeds: likewise.

    Raises:
        HyalineError: no such file, not TOML, or a key or value that `model train` does not take, named with its place.
    """
    path = Path(given)
    if path.suffix != ".toml":
        path = EXPERIMENTS / f"{choose('experiment', given, list_experiments())}.toml"
    if not os.path.lexists(path):
        raise HyalineError(f"{path}: the file is missing; known without a file are {', '.join(list_experiments())}")
    content = load_toml(path)
    if unknown := sorted(set(content) - {"about", "runs"}):
        raise HyalineError(f"{path}: unknown key {shown(unknown[0])}; known are about and runs")
    about, blocks = content.get("about", ""), content.get("runs", [])
    if not isinstance(about, str):
        raise HyalineError(f"{path}: about is {shown(about)}; expected text")
    if not (isinstance(blocks, list) and blocks and all(isinstance(block, dict) for block in blocks)):
        raise HyalineError(f"{path}: has no runs; expected at least one block that begins with [[runs]]")
    replaced = {"dataset": list(datasets), "seed": list(seeds)}
    # In the block's order, so that seeds given here vary as those of the file would.
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
    """The fields of a record of choices, those of records in it among them."""
    values: dict[str, object] = {}
    for item in dataclasses.fields(record):  # pyright: ignore[reportArgumentType]
        value = getattr(record, item.name)
        values |= _flat(value) if dataclasses.is_dataclass(value) else {item.name: value}
    return values


def _grid(block: Mapping[str, object], *, where: str) -> list[tuple[tuple[str, ...], object]]:
    """The arguments of each run of a block, and what they mean."""
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
    place = list(block).index("method")
    runs = []
    for combination in itertools.product(*axes):
        words = tuple(itertools.chain(*combination[:place], *combination[place + 1 :]))
        runs.append((combination[place] + words, check_words(combination[place][0], words)))
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
        raise HyalineError(f"{where}: {key} cannot be set; a run's folder is the one that `model train` gives it")
    flags = flags_of_method(method)
    if key not in flags:
        near = difflib.get_close_matches(key[:100], list(flags), n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise HyalineError(
            f"{where}: unknown key {shown(key)}; {hint}expected a flag of `model train {method}` without its dashes"
        )


def _flag(key: str, value: object, method: str, where: str) -> tuple[str, ...]:
    """The arguments that give a flag its value."""
    is_switch = isinstance(_flat(check_words(method, ()))[flags_of_method(method)[key]], bool)
    if not isinstance(value, Value) or isinstance(value, bool) != is_switch:
        expected = "true or false" if is_switch else "a number or text, or a list of them"
        raise HyalineError(f"{where}: {key} is {shown(value)}; expected {expected}")
    if is_switch:
        return (f"--{key}",) if value else ()
    arguments = (f"--{key}", str(value))
    try:
        check_words(method, arguments)
    except HyalineError:
        raise HyalineError(
            f"{where}: {key} is {shown(value)}, which `model train` does not take; see `model train {method} --help`"
        ) from None
    return arguments
