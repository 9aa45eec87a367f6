"""Benchmark of peeling: the product's tracers against plain loops."""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportAttributeAccessIssue=false

import numpy as np

from benchmarks.harness import BenchReport, Candidate, Check, Gate, measure
from datagen.data.cameras import Cameras
from datagen.data.layers import Layers, quantize_uv
from datagen.data.meshes import Mesh
from datagen.render.mitsuba_scene import load_geometry_mitsuba
from datagen.scene.description import Scene
from datagen.trace.light_path import LightPathTracer, TracedPaths
from datagen.trace.peel import Peeler
from datagen.trace.surface_tables import Limits


class EagerPeeler:
    """Mitsuba in a Python loop: intersect, evaluate, spawn the next ray; loses and repeats some hits."""

    def __init__(self, meshes: tuple[Mesh, ...]) -> None:
        import drjit as dr
        import mitsuba as mi

        shapes = load_geometry_mitsuba(meshes).shapes()
        # As Mitsuba comes: without the robust intersections that the product asks for, which cost time.
        self._scene = mi.load_dict({"type": "scene", **{shape.id(): shape for shape in shapes}}, False, False)
        registry = np.array(dr.reinterpret_array(mi.UInt32, self._scene.shapes_dr()))
        self._id_by_registry = np.zeros(registry.max() + 1, np.uint8)
        self._id_by_registry[registry] = np.arange(len(meshes)) + 1

    def peel(self, cameras: Cameras, view: int, num_layers: int) -> Layers:
        import drjit as dr
        import mitsuba as mi

        origin, directions = cameras[view].rays()
        columns = (mi.Float(np.ascontiguousarray(directions[..., axis].ravel())) for axis in range(3))
        ray = mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(*columns))
        active, way = mi.Bool(True), mi.Float(0)
        image = (num_layers, cameras.height, cameras.width)
        uv, object_id, depth = np.zeros((*image, 2), np.float32), np.zeros(image, np.uint8), np.zeros(image, np.float32)
        for layer in range(num_layers):
            si = self._scene.ray_intersect(ray, active)
            active &= si.is_valid()
            way += dr.select(active, si.t, 0)
            shape = dr.select(active, dr.reinterpret_array(mi.UInt32, si.shape), 0)
            u, v, t = (dr.select(active, value, 0) for value in (si.uv.x, si.uv.y, way))
            ray = si.spawn_ray(ray.d)
            dr.eval(active, way, shape, u, v, t, ray)
            uv[layer] = np.stack([np.array(u), np.array(v)], axis=-1).reshape(*image[1:], 2)
            object_id[layer] = self._id_by_registry[np.array(shape)].reshape(image[1:])
            depth[layer] = np.array(t).reshape(image[1:])
        return Layers(uv=quantize_uv(uv), object_id=object_id, depth=depth)


def trace_eagerly(tracer: LightPathTracer, origins: np.ndarray, directions: np.ndarray, limits: Limits) -> TracedPaths:
    """The product's light paths, but with the loop in Python and an evaluation after every bounce."""
    import drjit as dr

    plain = dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False), dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False)
    with plain[0], plain[1]:
        return tracer.trace(origins, directions, limits)


GATES = (
    Gate(name="fused tracing", baseline="mitsuba-eager", candidate="mitsuba-fused", at_least=1.7),
    Gate(name="fused light paths", baseline="light-path-loop", candidate="light-path", at_least=2),
)

SAME_OBJECTS = 0.98
"""Share of the pixels for which both must list the same objects: `spawn_ray` loses surfaces that lie close together."""

LIGHT_LIMITS = Limits(max_branches=2, max_vertices=8, max_depth=16)


def bench_peel(scene: Scene, cameras: Cameras, *, num_layers: int = 6, rounds: int = 7) -> BenchReport:
    """Measures the first view of a scene; all are checked. Call `use_mitsuba` first."""
    meshes = tuple(item.mesh for item in scene.objects)
    peeler, eager = Peeler(meshes), EagerPeeler(meshes)
    tracer = LightPathTracer(meshes, tuple(item.material for item in scene.objects))
    origin, directions = cameras[0].rays()
    directions = directions.reshape(-1, 3)
    origins = np.broadcast_to(origin, directions.shape)
    first, _ = peeler.peel(cameras, 0, num_layers)
    return measure(
        "bench peel",
        [
            Candidate(
                name="mitsuba-eager",
                run=lambda: eager.peel(cameras, 0, num_layers),
                note="Python loop with spawn_ray",
            ),
            Candidate(
                name="mitsuba-fused",
                run=lambda: peeler.peel(cameras, 0, num_layers),
                note="datagen/trace/peel.py",
            ),
            Candidate(
                name="light-path-loop",
                run=lambda: trace_eagerly(tracer, origins, directions, LIGHT_LIMITS),
                note="an evaluation a bounce",
            ),
            Candidate(
                name="light-path",
                run=lambda: tracer.trace(origins, directions, LIGHT_LIMITS),
                note="datagen/trace/light_path.py",
            ),
        ],
        checks=[
            Check(name="same objects", run=lambda: compare_objects(meshes, peeler, cameras, num_layers)),
            Check(name="same light paths", run=lambda: _compare_paths(tracer, origins, directions)),
        ],
        gates=GATES,
        settings={"scene": scene.name, "size": cameras.width, "layers": num_layers},
        facts={
            "triangles": sum(len(mesh.faces) for mesh in meshes),
            "hits kept": int((first.object_id > 0).sum()),
        },
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


def _compare_paths(tracer: LightPathTracer, origins: np.ndarray, directions: np.ndarray) -> tuple[bool, str]:
    one = tracer.trace(origins, directions, LIGHT_LIMITS)
    other = trace_eagerly(tracer, origins, directions, LIGHT_LIMITS)
    same = (one.object_id == other.object_id).all(axis=(0, 1))
    return bool(same.all()), f"{int((~same).sum())} of {len(same)} rays meet other objects"
