"""Benchmark of peeling: the product's tracer against a plain loop, all hits by Embree, and stored layers."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from benchmarks.generator.rivals import EagerPeeler, EmbreePeeler, StoredLayers, trace_eagerly
from benchmarks.generator.shells import NUM_TRIANGLES, make_shells, materials_of, random_cameras
from benchmarks.harness import BenchReport, Candidate, Check, Gate, machine_ceilings, measure
from datagen.data.cameras import Cameras
from datagen.data.layers import Layers
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.render.mitsuba_scene import is_scalar
from datagen.trace.light_path import LightPaths, LightPathTracer
from datagen.trace.peel import Peeler
from datagen.trace.surface_tables import Limits

Engine = Literal["mitsuba-eager", "mitsuba-fused", "trimesh", "exr", "light-path-loop", "light-path"]

ENGINES: tuple[Engine, ...] = get_args(Engine)

GATES = (
    Gate(name="fused tracing", baseline="mitsuba-eager", candidate="mitsuba-fused", at_least=1.7),
    Gate(name="fused light paths", baseline="light-path-loop", candidate="light-path", at_least=2),
)

NUM_CAMERAS = 10
"""Random views that the checks look at; the first of them is timed."""

SAME_OBJECTS = 0.98
"""Share of the pixels for which both must list the same objects: `spawn_ray` loses surfaces that lie close together."""

LIGHT_LIMITS = Limits(max_branches=2, max_vertices=8, max_depth=16)


def bench_peel(
    *,
    size: int = 512,
    num_layers: int = 6,
    triangles: float = 1.0,
    rounds: int = 7,
    engines: tuple[Engine, ...] = ENGINES,
) -> BenchReport:
    """Measures one view of the shells. Call `use_mitsuba` first.

    Args:
        triangles: a factor on the scene's 315,000.

    Raises:
        HyalineError: Mitsuba runs as scalar_rgb.
    """
    if is_scalar():
        raise HyalineError("bench peel: Mitsuba runs as scalar_rgb; `datagen doctor` names the libLLVM to install")
    meshes, cameras = make_shells(round(triangles * NUM_TRIANGLES)), random_cameras(NUM_CAMERAS, size)
    peeler = Peeler(meshes)
    tracer = LightPathTracer(meshes, materials_of(meshes))
    origin, directions = cameras[0].rays()
    directions = directions.reshape(-1, 3)
    origins = np.broadcast_to(origin, directions.shape)
    with tempfile.TemporaryDirectory(prefix="hyaline-bench-") as folder:
        first, _ = peeler.peel(cameras, 0, num_layers)
        stored = StoredLayers(first, Path(folder)) if "exr" in engines else None
        eager = EagerPeeler(meshes) if "mitsuba-eager" in engines else None
        embree = EmbreePeeler(meshes) if "trimesh" in engines else None
        runs: dict[Engine, tuple[Callable[[], object], str]] = {
            "mitsuba-eager": (lambda: eager and eager.peel(cameras, 0, num_layers), "Python loop with spawn_ray"),
            "mitsuba-fused": (lambda: peeler.peel(cameras, 0, num_layers), "datagen/trace/peel.py"),
            "trimesh": (lambda: embree and embree.peel(cameras, 0, num_layers), "embreex, all hits, no uv"),
            "exr": (lambda: stored and stored.read(), "decodes stored layers, no depth"),
            "light-path-loop": (
                lambda: trace_eagerly(tracer, origins, directions, LIGHT_LIMITS),
                "an evaluation a bounce",
            ),
            "light-path": (lambda: tracer.trace(origins, directions, LIGHT_LIMITS), "datagen/trace/light_path.py"),
        }
        agreement: dict[str, object] = {"triangles": sum(len(mesh.faces) for mesh in meshes)}
        agreement["hits kept"] = int((first.object_id > 0).sum())
        if embree:
            same = (embree.peel(cameras, 0, num_layers) == first.object_id).all(axis=0)
            agreement["trimesh: pixels with the right objects"] = f"{same.mean():.6f}"
        checks = [
            Check(name="same objects", run=lambda: compare_objects(meshes, peeler, cameras, num_layers)),
        ]
        if "exr" in engines:
            checks.append(Check(name="stored layers are the peeled ones", run=lambda: _is_stored(first, stored)))
        if "light-path-loop" in engines and "light-path" in engines:
            checks.append(Check(name="same light paths", run=lambda: _compare_paths(tracer, origins, directions)))
        return measure(
            "bench peel",
            [Candidate(name=name, run=runs[name][0], note=runs[name][1]) for name in ENGINES if name in engines],
            checks=checks,
            gates=GATES,
            ceilings=machine_ceilings(),
            settings={"size": size, "layers": num_layers, "triangles": triangles},
            facts=agreement,
            rounds=rounds,
        )


def compare_objects(meshes: tuple[Mesh, ...], peeler: Peeler, cameras: Cameras, num_layers: int) -> tuple[bool, str]:
    """Whether the tracer lists the objects that the plain loop lists, but for the surfaces that the loop loses."""
    eager, shares = EagerPeeler(meshes), []
    for view in range(len(cameras.world_from_camera)):
        found = peeler.peel(cameras, view, num_layers)[0].object_id
        shares.append((found == eager.peel(cameras, view, num_layers).object_id).all(axis=0).mean())
    share = float(np.mean(shares))
    return share >= SAME_OBJECTS, f"{share:.2%} of the pixels; expected at least {SAME_OBJECTS:.0%}"


def _is_stored(layers: Layers, stored: StoredLayers | None) -> tuple[bool, str]:
    assert stored is not None
    read = stored.read()
    same = np.array_equal(read.object_id, layers.object_id) and np.array_equal(read.uv, layers.uv)
    return same, "every uv and object id came back" if same else "what was read is not what was written"


def _compare_paths(tracer: LightPathTracer, origins: np.ndarray, directions: np.ndarray) -> tuple[bool, str]:
    one: LightPaths = tracer.trace(origins, directions, LIGHT_LIMITS)
    other = trace_eagerly(tracer, origins, directions, LIGHT_LIMITS)
    same = (one.object_id == other.object_id).all(axis=(0, 1))
    return bool(same.all()), f"{int((~same).sum())} of {len(same)} rays meet other objects"
