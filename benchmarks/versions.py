"""This version beside an earlier commit: processor time of training steps and drawn views, by turns."""

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.terminal.command import say

ROOT = Path(__file__).parents[1]

STEPS, FRAMES = (20, 80), (2, 8)
"""A short and a long run; their difference has no start, no score and no end."""

DATASET = "data/glass_table"
SCENE = [
    "--preset",
    "tiny",
    "--resolution",
    "128",
    "--views",
    "24",
    "--spp",
    "4",
    "--test-views",
    "1",
    "--test-spp",
    "4",
]


@dataclass(frozen=True, kw_only=True)
class Version:
    """A working tree whose commands are run, with a dataset of its own, because formats change."""

    tree: Path
    folder: Path
    is_old: bool = False
    """Whether scene, dataset and run are flags instead of words."""

    def run(self, *words: str) -> float:
        """Processor seconds of a command with all its threads and children.

        Raises:
            HyalineError: it failed.
        """
        environment = os.environ | {"PYTHONPATH": str(self.tree)}
        process = subprocess.Popen(
            [sys.executable, "-m", *words],
            cwd=self.folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stderr is not None
        told = process.stderr.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            last = (told.strip().splitlines() or ["it printed no reason"])[-1]
            raise HyalineError(f"{self.tree}: `{' '.join(words)}` failed: {last}")
        return usage.ru_utime + usage.ru_stime

    def train(self, method: str, steps: int, *flags: str) -> float:
        plain = method.removesuffix("-best")
        words = ["--steps", str(steps), "--overwrite", "--out", f"runs/{method}", *flags]
        if not self.is_old:
            return self.run("model", "train", method, DATASET, *words)
        best = ["--preset", "best"] if plain != method else []
        return self.run("model", "train", plain, "--dataset", DATASET, *best, *words)

    def film(self, frames: int) -> float:
        old = ["render", "--path", "orbit", "--run"]
        drawn = ["--frames", str(frames), "--overwrite", "--out", "film.webp"]
        return self.run("model", *(old if self.is_old else ["film"]), "runs/light-path", *drawn)


def prepare(tree: Path, folder: Path) -> Version:
    """A version with its dataset."""
    folder.mkdir()
    version = Version(tree=tree, folder=folder)
    try:
        version.run("datagen", "build", "glass_table", *SCENE, "--out", DATASET)
    except HyalineError:
        version = Version(tree=tree, folder=folder, is_old=True)
        version.run("datagen", "build", "--scene", "glass_table", *SCENE, "--out", DATASET)
    return version


QUANTITIES: dict[str, tuple[tuple[int, int], Callable[[Version, int], float]]] = {
    "light-path, a step": (STEPS, lambda version, steps: version.train("light-path", steps)),
    "light-path, a step with 512² textures": (
        STEPS,
        lambda version, steps: version.train("light-path", steps, "--texture-size", "512"),
    ),
    "light-path, a drawn view of 128²": (FRAMES, lambda version, frames: version.film(frames)),
    "paper-best, a step": (STEPS, lambda version, steps: version.train("paper-best", steps)),
}


def compare_versions(commit: str, *, rounds: int) -> dict[str, list[tuple[float, float]]]:
    """Processor ms of each quantity in each round: of the commit, and of this working tree.

    Raises:
        HyalineError: the commit does not exist, or a command of either version failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        tree.mkdir()
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=False)
        if archive.returncode:
            raise HyalineError(f"--commit {commit}: {archive.stderr.decode().strip()}")
        subprocess.run(["tar", "-x"], cwd=tree, input=archive.stdout, check=True)
        say("building a dataset with each version")
        versions = [prepare(tree, Path(folder) / "before"), prepare(ROOT, Path(folder) / "after")]
        found: dict[str, list[tuple[float, float]]] = {name: [] for name in QUANTITIES}
        for turn in range(rounds):
            for name, ((short, long), measure) in QUANTITIES.items():
                before, after = (
                    1e3 * (measure(version, long) - measure(version, short)) / (long - short) for version in versions
                )
                found[name].append((before, after))
                say(f"round {turn + 1} of {rounds}: {name}: {before:,.0f} and {after:,.0f} CPU ms")
        return found


def versions_table(commit: str, found: dict[str, list[tuple[float, float]]]) -> str:
    """The medians and their ratio."""
    lines = [f"| CPU ms | {commit} | now | ratio |", "|---|---:|---:|---:|"]
    for name, pairs in found.items():
        before, after = (statistics.median(values) for values in zip(*pairs, strict=True))
        ratio = statistics.median(new / old for old, new in pairs)
        lines.append(f"| {name} | {before:,.0f} | {after:,.0f} | {ratio:.2f} |")
    return "\n".join(lines)
