"""Benchmark of growth: how the time and the memory of peeling grow with the size of the task.

One quantity grows at a time. Every point is measured in a process of its own, after a small view to warm up, so that
memory is what this point needs. A power law through each series says how steep it is: exponent 1 is linear.
"""

import dataclasses
import io
import json
import math
import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from benchmarks.generator.shells import SHELLS, make_shells, random_cameras
from benchmarks.harness import Machine, describe_machine
from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit
from datagen.terminal.command import say, track

Quantity = Literal["pixels", "layers", "objects", "triangles"]

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)

MAX_IDS = 255
"""Object ids and numbers of layers that are peeled have 8 bits."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One view to peel."""

    pixels: int = 256 * 256
    layers: int = 2
    objects: int = SHELLS + 3
    triangles: int = 40_000


@dataclass(frozen=True, kw_only=True)
class Point:
    """What one view needed, with one quantity multiplied."""

    quantity: Quantity
    factor: float
    value: int
    """The quantity itself."""
    wall_s: float
    """Median of the rounds."""
    cpu_s: float
    memory_mb: float
    """Peak beyond what the process had when warm: meshes, acceleration structure, layers."""


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Exponents of the power laws of one quantity."""

    quantity: Quantity
    wall: float
    cpu: float
    memory: float


@dataclass(frozen=True, kw_only=True)
class ScaleReport:
    """All points, and the laws through them."""

    machine: Machine
    points: tuple[Point, ...]
    growth: tuple[Growth, ...]


def bench_scale(
    factors: tuple[float, ...],
    quantities: tuple[Quantity, ...] = QUANTITIES,
    *,
    base: Task | None = None,
    rounds: int = 3,
) -> ScaleReport:
    """Measures every factor of every quantity.

    Raises:
        HyalineError: fewer than two factors, one below 1, or one that leads beyond 255 objects or layers.
    """
    if len(set(factors)) < 2 or min(factors, default=0) < 1:
        raise HyalineError(f"factors: are {', '.join(map(str, factors))}; expected two or more, none below 1")
    base = base or Task()
    wanted: list[tuple[Quantity, float]] = [
        (quantity, factor) for quantity in quantities for factor in sorted(set(factors))
    ]
    tasks = [
        dataclasses.replace(base, **{quantity: round(getattr(base, quantity) * factor)}) for quantity, factor in wanted
    ]
    for task in tasks:
        if max(task.objects, task.layers) > MAX_IDS:
            raise HyalineError(
                f"factors: lead to {task.objects} objects and {task.layers} layers; expected at most {MAX_IDS}, "
                "name smaller factors or other quantities"
            )
    points = []
    for (quantity, factor), task in track(
        list(zip(wanted, tasks, strict=True)), label="bench scale", total=len(wanted)
    ):
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            wall, cpu, memory = pool.submit(measure_task, task, rounds).result()
        value = getattr(task, quantity)
        points.append(Point(quantity=quantity, factor=factor, value=value, wall_s=wall, cpu_s=cpu, memory_mb=memory))
    return ScaleReport(machine=describe_machine(), points=tuple(points), growth=fit_growth(points))


def fit_growth(points: list[Point]) -> tuple[Growth, ...]:
    """The slope of each series in double logarithmic scale, by least squares."""
    found = []
    series: list[Quantity] = [point.quantity for point in points]
    for quantity in dict.fromkeys(series):
        mine = [point for point in points if point.quantity == quantity]
        x = np.log([point.value for point in mine])
        slopes = [
            float(np.polyfit(x, np.log([max(getattr(point, name), 1e-6) for point in mine]), 1)[0])
            for name in ("wall_s", "cpu_s", "memory_mb")
        ]
        found.append(Growth(quantity=quantity, wall=slopes[0], cpu=slopes[1], memory=slopes[2]))
    return tuple(found)


def measure_task(task: Task, rounds: int) -> tuple[float, float, float]:
    """Wall and cpu seconds (medians) and megabytes; in a process that has done nothing else."""
    peel_once(Task(pixels=64, layers=task.layers, triangles=400), rounds=1)
    before = _peak_mb(reset=True)
    walls, cpus = peel_once(task, rounds=rounds)
    return float(np.median(walls)), float(np.median(cpus)), max(_peak_mb(reset=False) - before, 0.1)


def peel_once(task: Task, *, rounds: int) -> tuple[list[float], list[float]]:
    """Loads a task's scene and peels its view so many times, after one to warm up; wall and cpu seconds of each."""
    meshes = make_shells(task.triangles, task.objects)
    cameras = random_cameras(1, max(1, round(math.sqrt(task.pixels))))
    from datagen.machine.mitsuba_variant import use_mitsuba

    use_mitsuba(quiet=True)
    from datagen.trace.peel import Peeler

    peeler = Peeler(meshes)
    peeler.peel(cameras, 0, task.layers)
    walls, cpus = [], []
    for _ in range(rounds):
        wall, cpu = time.perf_counter(), time.process_time()
        peeler.peel(cameras, 0, task.layers)
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return walls, cpus


def show_scale(report: ScaleReport, out: Path, *, as_json: bool) -> None:
    """Prints the laws on stdout and draws the figure."""
    _draw(report, out)
    say(f"the figure: {out}")
    if as_json:
        print(json.dumps(dataclasses.asdict(report), indent=2, allow_nan=False))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("quantity", "values", "wall ms", "MB", "wall grows as", "cpu grows as", "memory grows as")
    for law in report.growth:
        mine = [point for point in report.points if point.quantity == law.quantity]
        table.add_row(
            law.quantity,
            " ".join(str(point.value) for point in mine),
            " ".join(f"{1e3 * point.wall_s:.1f}" for point in mine),
            " ".join(f"{point.memory_mb:.0f}" for point in mine),
            *(f"n^{exponent:.2f}" for exponent in (law.wall, law.cpu, law.memory)),
        )
    Console(highlight=False, width=150).print(table)


def _peak_mb(*, reset: bool) -> float:
    """Peak of resident memory since the last reset; where the system cannot reset it (no Linux), since the start."""
    status, refs = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if status.is_file() and refs.exists():
        if reset:
            refs.write_text("5")
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _draw(report: ScaleReport, out: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2 * len(report.growth), 5.6), layout="constrained")
    axes = figure.subplots(2, len(report.growth), squeeze=False)
    for column, law in enumerate(report.growth):
        mine = [point for point in report.points if point.quantity == law.quantity]
        x = [point.value for point in mine]
        walls, memory = [1e3 * point.wall_s for point in mine], [point.memory_mb for point in mine]
        axes[0, column].loglog(x, walls, marker="o", label=f"n^{law.wall:.2f}")
        axes[1, column].loglog(x, memory, marker="o", label=f"n^{law.memory:.2f}")
        for row, label in enumerate(("ms a view", "MB")):
            axes[row, column].set(xlabel=law.quantity, ylabel=label)
            axes[row, column].legend()
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=120, format="png")
    commit(out, buffer.getvalue())
