"""Benchmark of growth: time and memory of peeling with resolution, layers, objects and triangles.

The scene has closed objects within two concentric shells, with any number of triangles; `peel` uses it, too.
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
from jaxtyping import Float

from benchmarks.harness import Machine, describe_machine
from datagen.data.cameras import Cameras, look_at
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Material, Plastic, ThinDielectric
from datagen.terminal.command import say, track

NUM_TRIANGLES = 315_000
"""Default triangles of all objects together."""

NUM_OBJECTS = 11

SHELLS = 2
"""Spheres around all else, each with a quarter of the triangles; what is within has the rest."""


def make_shells(num_triangles: int = NUM_TRIANGLES, num_objects: int = NUM_OBJECTS) -> tuple[Mesh, ...]:
    """Two concentric spheres around ellipsoids and rings that overlap; all closed, the same ones every time."""
    assert num_objects > SHELLS
    rng = np.random.default_rng(0)
    meshes = [_surface(num_triangles // 4, radii=np.full(3, radius), ring=0.0) for radius in (1.0, 0.93)]
    inner = num_objects - SHELLS
    # As many objects as there are, together they fill about the same part of the view.
    size = (9 / inner) ** (1 / 3)
    for index in range(inner):
        radii = size * rng.uniform(0.1, 0.3, 3)
        ring = size * 0.25 if index % 3 == 0 else 0.0
        mesh = _surface(num_triangles // (2 * inner), radii=0.3 * radii if ring else radii, ring=ring)
        way = rng.normal(size=3)
        offset = rng.uniform(0, 0.5) * way / np.linalg.norm(way)
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        meshes.append(
            Mesh(
                vertices=(mesh.vertices @ turn.T + offset).astype(np.float32),
                faces=mesh.faces,
                normals=(mesh.normals @ turn.T).astype(np.float32),
                uv=mesh.uv,
            )
        )
    return tuple(meshes)


def materials_of(meshes: tuple[Mesh, ...]) -> tuple[Material, ...]:
    """Materials: solid glass outside with a thin pane within it, around objects of all kinds."""
    grey = (0.6, 0.6, 0.6)
    kinds = (
        Diffuse(color=grey),
        Conductor(color=grey),
        Plastic(color=grey, ior=1.5, roughness=0.1),
        ThinDielectric(ior=1.5),
    )
    inner = (kinds[index % len(kinds)] for index in range(len(meshes) - SHELLS))
    return (Dielectric(ior=1.5), ThinDielectric(ior=1.5), *inner)


def random_cameras(count: int, size: int) -> Cameras:
    """Around the shells, which cover two thirds of the view; the same ones every time."""
    rng = np.random.default_rng(1)
    poses = []
    for _ in range(count):
        way = rng.normal(size=3)
        position = rng.uniform(2.3, 2.7) * way / np.linalg.norm(way)
        poses.append(look_at(position, rng.uniform(-0.3, 0.3, 3)))
    return Cameras(world_from_camera=np.stack(poses), fov_x=math.radians(50), width=size, height=size)


def _surface(num_triangles: int, *, radii: Float[np.ndarray, "3"], ring: float) -> Mesh:
    """An ellipsoid, or a ring of radius `ring` with that cross-section: a grid that closes upon itself, with a seam."""
    rows = max(3, round(math.sqrt(num_triangles / 4)))
    columns = 2 * rows
    around = np.arange(columns + 1) % columns * (2 * np.pi / columns)  # The seam's two sides are equal to the last bit.
    index = np.arange(rows + 1)
    down = index % rows * (2 * np.pi / rows) if ring else index * (np.pi / rows)
    sine, cosine = np.sin(down)[:, None], np.cos(down)[:, None]
    if not ring:
        sine[[0, -1]] = 0.0  # All points of a pole are one.
    side, up = np.cos(around)[None], np.sin(around)[None]
    unit = np.stack(np.broadcast_arrays(sine * side, sine * up, cosine), axis=-1).reshape(-1, 3)
    hub = np.stack(np.broadcast_arrays(side + 0 * sine, up + 0 * sine, 0 * sine), axis=-1).reshape(-1, 3) * ring
    scale = np.array([radii[0], radii[0], radii[2]]) if ring else radii
    normals = unit / scale
    faces = _grid(rows, columns, has_poles=not ring)
    uv = np.stack(np.broadcast_arrays(np.linspace(0, 1, columns + 1)[None], np.linspace(0, 1, rows + 1)[:, None]), -1)
    return Mesh(
        vertices=(hub + unit * scale).astype(np.float32),
        faces=faces.astype(np.int32),
        normals=(normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
        uv=uv.reshape(-1, 2).astype(np.float32),
    )


def _grid(rows: int, columns: int, *, has_poles: bool) -> np.ndarray:
    """Two triangles a cell, one where a side has shrunk to a pole."""
    index = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    lower, upper = np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)
    if has_poles:
        lower, upper = lower[:-1], upper[1:]
    return np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)])


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
    """Time and memory of one view, with one quantity multiplied."""

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
    """Measures every factor of every quantity."""
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
    """Loads a task's scene and peels its view repeatedly, after a warm-up; wall and CPU seconds of each."""
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
