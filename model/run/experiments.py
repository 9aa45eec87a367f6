"""Experiments: grids of runs from files in TOML, each run equal to one command line of `model train`.

    about = "What the experiment shows, in one line."

    datasets = ["one", "two"]             # of blocks that name none
    [[runs]]                              # a grid: every combination of the values that are lists
    dataset = ["glass_table", "vitrine"]
    method = "paper"                      # or several, which must all know the flags of the block
    extrinsics = ["none", "view", "sh"]   # a key is a flag of `model train` without its dashes
    zero-layer = [false, true]            # a switch
    seed = [0, 1, 2]
    needs = ["datagen build {dataset}"]   # commands that make what the runs train on
    then = ["model predict {run} --variant x2"]   # commands on each finished run
    parts = ["table1"]                    # experiments of their own that the block belongs to

    [presets.demo]                        # sizes of the experiment, the usual one first; the size's name
    [presets.tiny]                        # takes the place of {preset} in datasets and commands
    only = ["one-{preset}"]               # the datasets that are left; without the key, all
    methods.paper.steps = 70              # the methods that are left, and flags of each; without the key, all
    steps = 50                            # other keys are flags that every block gets

Blocks add up; a run that is in two of them is trained once, and so are commands. The experiments in
`model/experiments/` are known by name, and so are their parts: `model sweep paper-tables`, `model sweep table1`.
"""

import dataclasses
import difflib
import itertools
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from datagen.disk.errors import HyalineError
from datagen.disk.records import load_toml, shown
from datagen.terminal.command import choose
from model.methods.table import METHODS
from model.run.train_flags import Asked, flags_of_method, folder_name, parse_train
from model.settings.run_flags import RUNS

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

KEPT_FLAGS = ("out", "label", "overwrite")
"""Flags that an experiment may not set: runs go to the default folder of `model train`, stopped runs resume, and where
runs are trained is for `model sweep` to say."""

PROGRAMS = ("datagen", "proxies", "model", "hyaline-bench", "python")
"""What `needs` and `then` may call."""

LISTS = ("parts", "needs", "then")
"""Keys of a block that are no axes of its grid."""

STEP_CPU_MS = {
    "paper": 46, "paper-best": 49, "light-path": 110, "mlp-first": 38, "authors-code": 59,
    "dnr": 212, "dnr-authors": 229, "dnr-layers": 246, "deepvoxels": 1450,
}  # fmt: skip
"""CPU milliseconds of a training step with the method's own batch, by method.

Measured once each by `model train METHOD glass_table --costs` on the demo's glass_table (128 x 128), with one thread of
a busy AMD EPYC with two cores: the difference of `cpu_seconds` between two runs of N steps, 10 and 50 for most, over
that of their steps, so that loading and compiling do not count. Version 0.2.0; expect 30 % more or less.
"""

MAX_RUNS = 1000
"""Upper limit on an experiment's runs; larger grids are probably mistakes."""

Value = bool | int | float | str


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """The content of an experiment file."""

    name: str
    """The file's name without its extension."""
    about: str
    needs: tuple[str, ...]
    """Commands that make the datasets and proxies of the runs."""
    runs: tuple[tuple[str, ...], ...]
    """Arguments of `model train`, all different, in the file's order; the last value of a block varies fastest."""
    then: tuple[str, ...]
    """Commands on finished runs."""


def list_experiments() -> list[str]:
    """The names of the built-in experiments and of their parts."""
    return sorted({name for path in EXPERIMENTS.glob("*.toml") for name in (path.stem, *_parts_of(path))})


def read_experiment(
    given: str, *, datasets: Sequence[str] = (), seeds: Sequence[int] = (), preset: str | None = None
) -> Experiment:
    """An experiment; each of its runs can be parsed by `model train`.

    Args:
        given: a file, or the name of a built-in experiment.
        datasets: replace the file's datasets, unless empty.
        seeds: replace the file's seeds, unless empty.
        preset: one of the file's presets; None: its first, if it has any.
    """
    path, part = Path(given), None
    if path.suffix != ".toml":
        choose("experiment", given, list_experiments())
        path = EXPERIMENTS / f"{given}.toml"
        if not path.exists():
            path, part = next(file for file in EXPERIMENTS.glob("*.toml") if given in _parts_of(file)), given
    if not os.path.lexists(path):
        raise HyalineError(f"{path}: the file is missing; built-in experiments are {', '.join(list_experiments())}")
    content = load_toml(path)
    if unknown := sorted(set(content) - {"about", "datasets", "presets", "runs"}):
        raise HyalineError(f"{path}: unknown key {shown(unknown[0])}; known are about, datasets, presets and runs")
    about, blocks = content.get("about", ""), content.get("runs", [])
    if not isinstance(about, str):
        raise HyalineError(f"{path}: about is {shown(about)}; expected text")
    if not (isinstance(blocks, list) and blocks and all(isinstance(block, dict) for block in blocks)):
        raise HyalineError(f"{path}: has no runs; expected at least one [[runs]] block")
    if datasets_of_file := _texts(content, "datasets", str(path)):
        blocks = [{"dataset": datasets_of_file} | block for block in blocks]
    chosen, size = _find_preset(content.get("presets", {}), preset, path)
    only, methods = size.pop("only", None), _methods_of(size, path)
    replaced = size | {key: list(values) for key, values in (("dataset", datasets), ("seed", seeds)) if values}
    # In the block's order, so that the given seeds vary like the file's.
    asked = [_of_preset(block, chosen, only) | replaced for block in blocks]
    if (count := sum(map(_count_runs, asked))) > MAX_RUNS:
        raise HyalineError(
            f"{path}: asks for {shown(count)} runs; expected at most {MAX_RUNS:,}, split it into several files"
        )
    runs: dict[str, tuple[str, ...]] = {}
    needs: dict[str, None] = {}
    then: dict[str, None] = {}
    for place, block in enumerate(asked):
        where = f"{path}: runs[{place}]"
        commands = {key: _texts(block, key, where) for key in LISTS}
        if (part is not None and part not in commands["parts"]) or (only and block.get("dataset") == []):
            continue
        flags = {key: value for key, value in block.items() if key not in commands}
        for arguments, parsed in _grid(flags, methods, where=where):
            runs.setdefault(repr((arguments[0], parsed)), arguments)
            if not datasets:
                needs |= dict.fromkeys(_filled(commands["needs"], arguments[0], parsed, chosen, f"{where}: needs"))
            then |= dict.fromkeys(_filled(commands["then"], arguments[0], parsed, chosen, f"{where}: then"))
    return Experiment(
        name=part or path.stem, about=about, needs=tuple(needs), runs=tuple(runs.values()), then=tuple(then)
    )


def _find_preset(presets: object, asked: str | None, path: Path) -> tuple[str | None, dict[str, object]]:
    """The name of the preset, and its keys with that in place of {preset}."""
    if not (isinstance(presets, dict) and all(isinstance(flags, dict) for flags in presets.values())):
        raise HyalineError(f"{path}: presets is {shown(presets)}; expected tables such as [presets.tiny]")
    if asked is None:
        asked = next(iter(presets), None)
    elif not presets:
        raise HyalineError(f"{path}: has no presets; leave out --preset")
    return (None, {}) if asked is None else (asked, _of_preset(presets[choose("preset", asked, presets)], asked))


def _methods_of(size: dict[str, object], path: Path) -> dict[str, dict[str, object]] | None:
    """Takes the flags of each method from a preset; None if it leaves all methods."""
    methods = size.pop("methods", None)
    if methods is None:
        return None
    if not (isinstance(methods, dict) and all(isinstance(flags, dict) for flags in methods.values())):
        raise HyalineError(f"{path}: methods is {shown(methods)}; expected a table of each method's flags")
    return {choose(f"{path}: method", method, METHODS.names()): flags for method, flags in methods.items()}


def _of_preset(block: dict[str, object], preset: str | None, only: object = None) -> dict[str, object]:
    """A block with the preset's name in place of {preset}, and of its datasets those in `only`."""

    def filled(value: object) -> object:
        if isinstance(value, list):
            return [filled(item) for item in value]
        return value.replace("{preset}", preset) if isinstance(value, str) and preset is not None else value

    block = {key: filled(value) for key, value in block.items()}
    if isinstance(only, list) and "dataset" in block:
        datasets = block["dataset"] if isinstance(block["dataset"], list) else [block["dataset"]]
        block["dataset"] = [dataset for dataset in datasets if dataset in only]
    return block


def _parts_of(path: Path) -> set[str]:
    return {
        part for block in cast(list[dict[str, list[str]]], load_toml(path)["runs"]) for part in block.get("parts", ())
    }


def _texts(block: Mapping[str, object], key: str, where: str) -> list[str]:
    texts = block.get(key, [])
    if not (isinstance(texts, list) and all(isinstance(text, str) for text in texts)):
        raise HyalineError(f"{where}: {key} is {shown(texts)}; expected a list of texts")
    return texts


def _filled(commands: Sequence[str], method: str, asked: Asked, preset: str | None, where: str) -> list[str]:
    """Commands with the dataset and the folder of a run in place of {dataset} and {run}.

    {scene} is the dataset's name without the preset: glass_table for glass_table-tiny.
    """
    dataset = asked.dataset or "glass_table"
    run = RUNS / Path(dataset).name / folder_name(method, asked)
    filled = [
        command.replace("{dataset}", shlex.quote(dataset))
        .replace("{scene}", shlex.quote(Path(dataset).name.removesuffix(f"-{preset}")))
        .replace("{run}", shlex.quote(str(run)))
        for command in commands
    ]
    for command in filled:
        try:
            (program, *_) = shlex.split(command)
        except ValueError:
            raise HyalineError(f"{where} is {shown(command)}; expected a command line") from None
        choose(f"{where}: program", program, PROGRAMS)
    return filled


def _flat(record: object) -> dict[str, object]:
    """The fields of a record of choices, including those of nested records."""
    values: dict[str, object] = {}
    for item in dataclasses.fields(record):  # pyright: ignore[reportArgumentType]
        value = getattr(record, item.name)
        values |= _flat(value) if dataclasses.is_dataclass(value) else {item.name: value}
    return values


def _grid(
    block: Mapping[str, object], of_methods: Mapping[str, Mapping[str, object]] | None, *, where: str
) -> list[tuple[tuple[str, ...], Asked]]:
    """The arguments of each run of a block, raw and parsed.

    Args:
        of_methods: the methods that are left, and further flags of each; None for all methods.
    """
    if "method" not in block:
        raise HyalineError(f'{where}: key "method" is missing; expected the name of one, such as method = "paper"')
    methods = [choose(f"{where}: method", str(method), METHODS.names()) for method in _values(block, "method", where)]
    methods = [method for method in methods if of_methods is None or method in of_methods]
    if not methods:
        return []
    own = {method: (of_methods or {}).get(method, {}) for method in methods}
    further = {method: _further_flags(method, flags, where) for method, flags in own.items()}
    axes: list[list[tuple[str, ...]]] = []
    for key in block:
        if key == "method":
            axes.append([(method,) for method in methods])
            continue
        for method in methods:
            _check_key(key, method, where)
        axes.append([_flag(key, value, methods[0], where) for value in _values(block, key, where)])
    runs: list[tuple[tuple[str, ...], Asked]] = []
    for combination in itertools.product(*axes):
        by_key = dict(zip(block, combination, strict=True))
        (method,), dataset = by_key.pop("method"), by_key.pop("dataset", ())
        for_all = (words for key, words in by_key.items() if key not in own[method])
        words = (*dataset, *itertools.chain(*for_all), *further[method])
        runs.append(((method, *words), parse_train(method, words)))
    return runs


def _further_flags(method: str, flags: Mapping[str, object], where: str) -> tuple[str, ...]:
    for key in flags:
        _check_key(key, method, where)
    return tuple(itertools.chain(*(_flag(key, value, method, where) for key, value in flags.items())))


def _count_runs(block: Mapping[str, object]) -> int:
    return math.prod(len(values) for key, values in block.items() if isinstance(values, list) and key not in LISTS)


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


def estimate_cpu_hours(experiment: Experiment) -> float | None:
    """CPU hours of all runs, from measured steps; None if a method's step was not measured."""
    seconds = 0.0
    for method, *words in experiment.runs:
        if method not in STEP_CPU_MS:
            return None
        asked = parse_train(method, tuple(words))
        usual = asked.method.usual(asked.run.geometry).optimisation()
        seconds += asked.optimisation.steps * asked.optimisation.batch / usual.batch * STEP_CPU_MS[method] / 1000
    return seconds / 3600
