"""This version beside an earlier commit: processor time of their commands, by turns, kept from call to call."""

import dataclasses
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks.harness import describe_machine
from benchmarks.versions_child import RAYS
from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit
from datagen.terminal.command import say

ROOT = Path(__file__).parents[1]
CHILD = Path(__file__).with_name("versions_child.py")

FIRST_STEPS, LAST_STEP = 10, 40
"""Steps that are not measured, since kernels are compiled and caches filled, and the last one that is."""
FIRST_BUNDLES = 3
"""The same for bundles of light paths."""

PLAIN, DISPERSIVE = "data/glass_table", "data/dispersive"
SIZE = "--preset tiny --resolution 128 --views 24 --spp 4 --test-views 2 --test-spp 4"
SMALL = "--preset tiny --resolution 128 --views 4 --spp 2 --test-views 1 --test-spp 2"
DISPERSION = 0.5
"""20 over an Abbe number of 40."""

Values = dict[str, float]
"""Processor seconds by name."""


@dataclass(frozen=True, kw_only=True)
class Version:
    """A commit's tree, and a folder with datasets of its own, because formats change."""

    tree: Path
    folder: Path
    python: Path
    """Interpreter of an environment with the version's libraries."""
    has_flags: bool = False
    """Scene, dataset and run are flags instead of words."""
    threads: int = 0
    """OpenMP threads of each process; 0: as many as the version takes by itself."""

    def call(self, *words: str) -> float:
        """Processor seconds of a Python with these words, with all its threads and children.

        Raises:
            HyalineError: it failed; with its last line.
        """
        environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
        environment |= {"PYTHONPATH": str(self.tree), "PYTHONUNBUFFERED": "1"}
        if self.threads:
            environment["OMP_NUM_THREADS"] = str(self.threads)
        process = subprocess.Popen(
            [self.python, "-P", *words],
            cwd=self.folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stderr is not None
        with process.stderr as errors:
            printed = errors.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise HyalineError((printed.strip().splitlines() or [f"ended with status {process.returncode}"])[-1])
        return usage.ru_utime + usage.ru_stime

    def watch(self, *words: str) -> dict[str, list[float]]:
        """The report of `versions_child.py`: processor seconds at the end of each part."""
        with tempfile.TemporaryDirectory() as folder:
            report = Path(folder) / "report.json"
            self.call(str(CHILD), str(report), *words)
            return json.loads(report.read_text())

    def build(self, scene: str, out: str, size: str) -> list[str]:
        """The words of a build."""
        return ["datagen", "build", *(["--scene"] if self.has_flags else []), scene, *size.split(), "--out", out]

    def train(self, method: str, out: str, steps: int, *flags: str) -> list[str]:
        """The words of a training."""
        plain = method.removesuffix("-best")
        words = ["--steps", str(steps), "--out", f"runs/glass_table/{out}", *flags]
        if not self.has_flags:
            return ["model", "train", method, PLAIN, *words]
        return ["model", "train", plain, "--dataset", PLAIN, *(["--preset", "best"] if plain != method else []), *words]

    def steps(self, method: str, *flags: str) -> float:
        """A training step."""
        words = self.train(method, "steps", LAST_STEP + 1, *flags, "--overwrite")
        return mean_step(self.watch("steps", str(LAST_STEP), *words)["steps"], FIRST_STEPS)

    def paths(self, dataset: str) -> float:
        """The light paths of a ray."""
        return mean_step(self.watch("paths", dataset)["paths"], FIRST_BUNDLES) / RAYS


def mean_step(stamps: list[float], first: int) -> float:
    """Seconds between two stamps, in the mean from `first` on."""
    return (stamps[-1] - stamps[first]) / (len(stamps) - 1 - first)


def measure_run(version: Version) -> Values:
    """A whole run of light-path, and the same command again."""
    words = version.train("light-path", "light-path", LAST_STEP)
    stamps = version.watch("views", *words, "--overwrite")
    # The first view records kernels.
    values = {"light-path": mean_step(stamps["steps"], FIRST_STEPS), "view": mean_step(stamps["views"], 0)}
    return values | {"train": version.call("-m", *words)}


def measure_datagen(version: Version) -> Values:
    build = version.build("glass_table", PLAIN, SIZE)
    return {"scenes": version.call("-m", "datagen", "scenes"), "build": version.call("-m", *build)}


def measure_first_line(version: Version) -> Values:
    """The slowest of four commands."""
    commands = {
        "datagen scenes": ["datagen", "scenes"],
        "datagen build": version.build("glass_table", "data/fresh", SIZE),
        "model train": version.train("light-path", "fresh", LAST_STEP),
        "eval report": ["eval", "report"],
    }
    return {"first line": max(version.watch("first-line", *words)["first line"][0] for words in commands.values())}


def measure_demo(place: int, version: Version) -> Values:
    """One command of `make demo`, given its index; index 0 starts from an empty folder."""
    demo = dataclasses.replace(version, folder=version.folder / "demo")
    commands = demo_commands(version.tree / "Makefile")
    if place >= len(commands):
        raise HyalineError(f"its demo has only {len(commands)} commands")
    if place == 0:
        shutil.rmtree(demo.folder, ignore_errors=True)
        demo.folder.mkdir()
    return {" ".join(commands[place]): demo.call("-m", *commands[place])}


def demo_commands(makefile: Path) -> list[list[str]]:
    """The words of the commands of a Makefile's `demo`, as `python -m` takes them."""
    recipe = re.search(r"^demo:.*\n((?:\t.*\n)+)", makefile.read_text(), re.M)
    if recipe is None:
        raise HyalineError(f"{makefile}: has no demo")
    lines = [line.strip().removeprefix("$(BIN)/").split() for line in recipe[1].splitlines()]
    return [["eval", *words] if words == ["report"] else words for words in lines]


Measure = Callable[[Version], Values]

MEASURES: dict[str, Measure] = {
    "datagen": measure_datagen,
    "light-path": measure_run,
    "first line": measure_first_line,
    "512²": lambda version: {"512²": version.steps("light-path", "--texture-size", "512")},
    "paper-best": lambda version: {"paper-best": version.steps("paper-best")},
    "paths": lambda version: {"plain": version.paths(PLAIN), "dispersive": version.paths(DISPERSIVE)},
}
"""What is measured together; one that fails takes no other with it."""

ONCE: dict[str, Measure] = {f"demo, command {place + 1}": partial(measure_demo, place) for place in range(7)}
"""The commands of `make demo`, which take an hour: once, in turns, and only if asked for."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A line of the table."""

    title: str
    needs: tuple[str, ...]
    """Measures."""
    value: Callable[[Values], float]
    digits: int = 2


def of(name: str, scale: float = 1.0) -> Callable[[Values], float]:
    return lambda values: scale * values[name]


def of_demo(command: str) -> Callable[[Values], float]:
    return lambda values: sum(seconds for words, seconds in values.items() if words.startswith(command))


ROWS = (
    Row(title="`light-path` step, CPU ms", needs=("light-path",), value=of("light-path", 1e3), digits=0),
    Row(title="`light-path` step with 512² textures, CPU ms", needs=("512²",), value=of("512²", 1e3), digits=0),
    Row(
        title="the same, relative to 128²",
        needs=("light-path", "512²"),
        value=lambda values: values["512²"] / values["light-path"],
    ),
    Row(title="drawing a 128² view with `light-path`, CPU s", needs=("light-path",), value=of("view")),
    Row(title="`paper-best` step, CPU ms", needs=("paper-best",), value=of("paper-best", 1e3), digits=0),
    Row(title="light paths, CPU µs a ray", needs=("paths",), value=of("plain", 1e6)),
    Row(title="light paths through dispersive glass, CPU µs a ray", needs=("paths",), value=of("dispersive", 1e6)),
    Row(
        title="the same, relative to plain glass",
        needs=("paths",),
        value=lambda values: values["dispersive"] / values["plain"],
    ),
    Row(title="`datagen scenes`, CPU s", needs=("datagen",), value=of("scenes")),
    Row(title="finished `datagen build`, CPU s", needs=("datagen",), value=of("build")),
    Row(title="finished `model train light-path`, CPU s", needs=("light-path",), value=of("train")),
    Row(title="first line of output, slowest of four commands, CPU s", needs=("first line",), value=of("first line")),
    Row(
        title="`make demo` after set-up, CPU s", needs=tuple(ONCE), value=lambda values: sum(values.values()), digits=0
    ),
    Row(title="`datagen build` in it, CPU s", needs=tuple(ONCE), value=of_demo("datagen build"), digits=0),
    Row(title="`light-path` in it, CPU s", needs=tuple(ONCE), value=of_demo("model train light-path"), digits=0),
)


class Comparison:
    """The measurements of two versions in a folder, which a later call continues."""

    def __init__(self, folder: Path, commits: tuple[str, str], python: Path, threads: int) -> None:
        pythons = python, Path(sys.executable)
        found = [find_version(folder, *each) for each in zip(commits, pythons, strict=True)]
        self.versions = [dataclasses.replace(version, threads=threads) for version in found]
        self.threads = threads
        self.commits = commits
        self.reasons: dict[tuple[str, int], str] = {}
        """Why a measure failed, by its name and the place of the version; a later call tries again."""
        self._file = folder / (f"measured-{threads}-threads.json" if threads else "measured.json")
        self._kept: dict[str, Values] = json.loads(self._file.read_text()) if self._file.is_file() else {}

    def values(self, turn: int, name: str, place: int) -> Values:
        """A version's values of a measure in a round; empty if they are not known."""
        return self._kept.get(f"{turn} {name} {self.commits[place]}", {})

    def measure(self, turn: int, name: str, place: int) -> None:
        """Measures what is not known yet."""
        if self.values(turn, name, place) or (name, place) in self.reasons:
            return
        say(f"round {turn + 1}: {name}, {self.commits[place]}")
        try:
            values = (MEASURES | ONCE)[name](self.versions[place])
        except HyalineError as error:
            self.reasons[name, place] = str(error)
            say(f"failed: {error}")
            return
        self._kept[f"{turn} {name} {self.commits[place]}"] = values
        commit(self._file, json.dumps(self._kept, indent=1).encode())

    def prepare(self) -> None:
        """Builds the datasets that are missing; a version for which that fails has no row."""
        for place, version in enumerate(self.versions):
            try:
                version.call("-m", *version.build("glass_table", PLAIN, SIZE))
                write_dispersive(version.folder)
                version.call("-m", *version.build("scene", DISPERSIVE, SMALL))
            except HyalineError as error:
                say(f"{self.commits[place]}: no dataset: {error}")
                self.reasons |= {(name, place): f"no dataset: {error}" for name in (*MEASURES, *ONCE)}


def find_version(folder: Path, commit: str, python: Path) -> Version:
    """A commit's tree in `folder`, unpacked there if it is not."""
    place = folder / commit
    tree = place / "tree"
    if not tree.is_dir():
        partial = place / "partial"
        partial.mkdir(parents=True, exist_ok=True)
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True)
        subprocess.run(["tar", "-x"], cwd=partial, input=archive.stdout, check=True)
        partial.rename(tree)
    command = [python, "-P", "-m", "datagen", "build", "--help"]
    shown = subprocess.run(
        command, cwd=place, env=os.environ | {"PYTHONPATH": str(tree)}, capture_output=True, text=True
    )
    return Version(
        tree=tree, folder=place, python=python, has_flags=re.search(r"^\W*--scene\b", shown.stdout, re.M) is not None
    )


def write_dispersive(folder: Path) -> None:
    """The scene of the glass table with dispersive glass, in `folder`/scene."""
    if (folder / "scene").is_dir():
        return
    partial = folder / "scene.partial"
    shutil.copytree(folder / PLAIN / "scene", partial, dirs_exist_ok=True)
    scene = json.loads((partial / "scene.json").read_text())
    for item in scene["objects"]:
        if item["material"]["type"] == "Dielectric":
            item["material"]["dispersion"] = DISPERSION
    (partial / "scene.json").write_text(json.dumps(scene))
    partial.rename(folder / "scene")


def find_commit(name: str) -> str:
    """A commit's short hash.

    Raises:
        HyalineError: no commit has this name.
    """
    words = ["git", "rev-parse", "--short=7", "--verify", f"{name}^{{commit}}"]
    found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode:
        raise HyalineError(f"--commit {name}: {found.stderr.strip()}")
    return found.stdout.strip()


def has_changes() -> bool:
    """True if files of the working tree differ from the commit that is checked out."""
    return subprocess.run(["git", "diff", "--quiet", "HEAD"], cwd=ROOT, check=False).returncode != 0


def compare_versions(name: str, *, rounds: int, python: Path, threads: int = 0, demo: bool = False) -> str:
    """The table of a commit and of the commit that is checked out, after measuring what an earlier call has not.

    Args:
        demo: measure `make demo`, too.
        threads: OpenMP threads of each process; 0: as many as each version takes by itself.
        python: interpreter of an environment with the earlier commit's libraries.

    Raises:
        HyalineError: the commit does not exist.
    """
    commits = find_commit(name), find_commit("HEAD")
    if has_changes():
        say(f"measures {commits[1]} as committed, without the changes of the working tree")
    folder = ROOT / "build" / "compare" / "-".join(commits)
    comparison = Comparison(folder, commits, python, threads)
    say(f"{folder}: keeps what is measured; the same command continues")
    comparison.prepare()
    for turn in range(rounds):
        for name in (*MEASURES, *(ONCE if demo and turn == 0 else ())):
            for place in (0, 1) if turn % 2 == 0 else (1, 0):
                comparison.measure(turn, name, place)
    return versions_table(comparison, rounds=rounds)


def versions_table(comparison: Comparison, *, rounds: int) -> str:
    """Medians over the rounds, their ratio with its range, and the reasons of rows that a version cannot have."""
    machine = describe_machine()
    threads = f"OMP_NUM_THREADS={comparison.threads}" if comparison.threads else "threads as each version takes them"
    before, now = comparison.commits
    lines = [
        f"{machine.cpu}, {machine.cores} cores, {threads}; processor time, medians of up to {rounds} rounds",
        "",
        f"| | {before} | {now} | ratio (range) |",
        "|---|---:|---:|---:|",
    ]
    for row in ROWS:
        found = [_values(comparison, row, place, rounds) for place in (0, 1)]
        cells = [f"{statistics.median(values.values()):,.{row.digits}f}" if values else "-" for values in found]
        ratios = [found[1][turn] / found[0][turn] for turn in found[0].keys() & found[1].keys()]
        ratio = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})" if ratios else "-"
        lines.append(f"| {row.title} | {' | '.join(cells)} | {ratio} |")
    reasons = [f"{name}, {comparison.commits[place]}: {why}" for (name, place), why in comparison.reasons.items()]
    return "\n".join(lines + ([""] if reasons else []) + reasons)


def _values(comparison: Comparison, row: Row, place: int, rounds: int) -> Mapping[int, float]:
    """A row's values of a version, by round."""
    found = {}
    for turn in range(rounds):
        parts = [comparison.values(turn, name, place) for name in row.needs]
        if all(parts):
            found[turn] = row.value({key: value for part in parts for key, value in part.items()})
    return found
