"""Benchmark of peeling: the product's two engines against a plain loop, all hits by Embree, and stored layers."""

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
from datagen.data.meshes import Mesh, face_corners
from datagen.disk.errors import HyalineError
from datagen.render.mitsuba_scene import is_scalar
from datagen.trace.light_path import LightPaths, LightPathTracer
from datagen.trace.peel import Peeler
from datagen.trace.raster import Rasterizer

Engine = Literal["mitsuba-eager", "mitsuba-fused", "raster", "trimesh", "exr", "light-path-loop", "light-path"]

ENGINES: tuple[Engine, ...] = get_args(Engine)

GATES = (
    Gate(name="fused tracing", baseline="mitsuba-eager", candidate="mitsuba-fused", at_least=1.7),
    Gate(name="rasterising", baseline="mitsuba-eager", candidate="raster", at_least=4.5),
    Gate(name="rasterising against all hits", baseline="trimesh", candidate="raster", at_least=25),
    Gate(name="rasterising against stored layers", baseline="exr", candidate="raster", at_least=2),
    Gate(name="fused light paths", baseline="light-path-loop", candidate="light-path", at_least=2),
)

NUM_CAMERAS = 10
"""Random views that the checks look at; the first of them is timed."""

PARITY_LAYERS = 200
"""More layers than any ray of the scene has hits."""

MIN_ANGLE = 2e-6
"""A ray that passes an edge within so many radians, some 30 steps of its float32 direction (a thousandth of a pixel at
512 x 512), is in no general position."""

MIN_GAP = 1e-5
"""Nor is a ray with two hits within so many metres."""

LIGHT_LIMITS = {"max_branches": 2, "max_vertices": 8, "max_depth": 16}


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
    peeler, rasterizer = Peeler(meshes), Rasterizer(meshes)
    tracer = LightPathTracer(meshes, materials_of(meshes))
    origin, directions = cameras[0].rays()
    directions = directions.reshape(-1, 3)
    origins = np.broadcast_to(origin, directions.shape)
    with tempfile.TemporaryDirectory(prefix="hyaline-bench-") as folder:
        first, _ = rasterizer.peel(cameras, 0, num_layers)
        stored = StoredLayers(first, Path(folder)) if "exr" in engines else None
        eager = EagerPeeler(meshes) if "mitsuba-eager" in engines else None
        embree = EmbreePeeler(meshes) if "trimesh" in engines else None
        runs: dict[Engine, tuple[Callable[[], object], str]] = {
            "mitsuba-eager": (lambda: eager and eager.peel(cameras, 0, num_layers), "Python loop with spawn_ray"),
            "mitsuba-fused": (lambda: peeler.peel(cameras, 0, num_layers), "datagen/trace/peel.py"),
            "raster": (lambda: rasterizer.peel(cameras, 0, num_layers), "datagen/trace/raster.py"),
            "trimesh": (lambda: embree and embree.peel(cameras, 0, num_layers), "embreex, all hits, no uv"),
            "exr": (lambda: stored and stored.read(), "decodes stored layers, no depth"),
            "light-path-loop": (
                lambda: trace_eagerly(tracer, origins, directions, **LIGHT_LIMITS),
                "an evaluation a bounce",
            ),
            "light-path": (lambda: tracer.trace(origins, directions, **LIGHT_LIMITS), "datagen/trace/light_path.py"),
        }
        agreement: dict[str, object] = {"triangles": sum(len(mesh.faces) for mesh in meshes)}
        agreement["hits kept"] = int((first.object_id > 0).sum())
        if eager:
            same = (eager.peel(cameras, 0, num_layers).object_id == first.object_id).all(axis=0)
            agreement["mitsuba-eager: pixels with the right objects"] = f"{same.mean():.6f}"
        if embree:
            same = (embree.peel(cameras, 0, num_layers) == first.object_id).all(axis=0)
            agreement["trimesh: pixels with the right objects"] = f"{same.mean():.6f}"
        checks = [
            Check(name="same objects", run=lambda: compare_engines(meshes, peeler, rasterizer, cameras, num_layers)),
            Check(name="even parity", run=lambda: check_parity(meshes, rasterizer, cameras)),
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


def compare_engines(
    meshes: tuple[Mesh, ...], peeler: Peeler, rasterizer: Rasterizer, cameras: Cameras, num_layers: int
) -> tuple[bool, str]:
    """Whether tracing and rasterising find the same objects on every ray in general position, of every view."""
    views = len(cameras.world_from_camera)
    different, wrong, steps = 0, [], []
    for view in range(views):
        traced, _ = peeler.peel(cameras, view, num_layers)
        drawn, _ = rasterizer.peel(cameras, view, num_layers)
        pixels = np.argwhere((traced.object_id != drawn.object_id).any(axis=0))
        different += len(pixels)
        origin, directions = cameras[view].rays()
        wrong += [(view, *pixel) for pixel in pixels.tolist() if is_general(meshes, origin, directions[tuple(pixel)])]
        same = traced.object_id == drawn.object_id
        steps.append(np.abs(traced.uv.astype(np.int32) - drawn.uv)[same].ravel())
    share = np.quantile(np.concatenate(steps), [0.99, 1.0]) / 65535
    detail = (
        f"{different} of {views * cameras.width * cameras.height} pixels differ, {len(wrong)} of them in general "
        f"position; uv differ by {share[0]:.1e} (99 %) and {share[1]:.1e} (all)"
    )
    if wrong:
        detail += f"; first (view, row, column): {wrong[0]}"
    return not wrong, detail


def check_parity(meshes: tuple[Mesh, ...], rasterizer: Rasterizer, cameras: Cameras) -> tuple[bool, str]:
    """Whether every ray leaves each closed object as often as it enters it."""
    odd = 0
    for view in range(len(cameras.world_from_camera)):
        layers, has_more = rasterizer.rasterize(cameras, view, PARITY_LAYERS)
        odd += int(has_more.sum())
        parity = np.zeros((len(meshes) + 1, *has_more.shape), np.bool_)
        for object_id in layers.object_id[: int((layers.object_id > 0).any(axis=(1, 2)).sum())]:
            np.logical_xor.at(parity, (object_id, *np.indices(object_id.shape)), True)
        odd += int(parity[1:].any(axis=0).sum())
    return odd == 0, f"{odd} pixels with an odd number of hits of an object, in {len(cameras.world_from_camera)} views"


def is_general(meshes: tuple[Mesh, ...], origin: np.ndarray, direction: np.ndarray) -> bool:
    """By brute force in float64: the ray passes no edge closely, and no two of its hits are at one distance."""
    corners = np.concatenate([face_corners(mesh) for mesh in meshes]).astype(np.float64) - origin.astype(np.float64)
    d = direction.astype(np.float64)
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    edges = normals @ d
    total = edges.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Of each face the angle to the nearest of its sides, negative where the ray passes it outside.
        angle = (np.sign(total)[:, None] * edges / np.linalg.norm(normals, axis=-1)).min(axis=-1)
        t = np.einsum("fc,fc->f", a, normals[:, 0]) / total
    ahead = np.nan_to_num(t, nan=-1.0) > 0
    if (ahead & (np.abs(angle) <= MIN_ANGLE)).any():
        return False
    gaps: np.ndarray = np.diff(np.sort(t[ahead & (angle > 0)]))
    return bool((gaps > MIN_GAP).all())


def _is_stored(layers: Layers, stored: StoredLayers | None) -> tuple[bool, str]:
    assert stored is not None
    read = stored.read()
    same = np.array_equal(read.object_id, layers.object_id) and np.array_equal(read.uv, layers.uv)
    return same, "every uv and object id came back" if same else "what was read is not what was written"


def _compare_paths(tracer: LightPathTracer, origins: np.ndarray, directions: np.ndarray) -> tuple[bool, str]:
    one: LightPaths = tracer.trace(origins, directions, **LIGHT_LIMITS)
    other = trace_eagerly(tracer, origins, directions, **LIGHT_LIMITS)
    same = (one.object_id == other.object_id).all(axis=(0, 1))
    return bool(same.all()), f"{int((~same).sum())} of {len(same)} rays meet other objects"
