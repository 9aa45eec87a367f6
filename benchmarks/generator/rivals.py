"""Other ways to get layers, each written as one would without much thought, to measure the product against."""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportAttributeAccessIssue=false

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.data.cameras import Cameras
from datagen.data.images import decode_radiance, encode_float_exr
from datagen.data.layers import UV_SCALE, Layers, quantize_uv
from datagen.data.meshes import Mesh
from datagen.render.mitsuba_scene import load_geometry_mitsuba
from datagen.trace.light_path import LightPaths, LightPathTracer
from datagen.trace.limits import Limits


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


class EmbreePeeler:
    """trimesh over embreex, all hits of every ray, sorted; no uv. Drops hits that are close together."""

    def __init__(self, meshes: tuple[Mesh, ...]) -> None:
        import trimesh

        self._heap = trimesh.util.concatenate([trimesh.Trimesh(m.vertices, m.faces, process=False) for m in meshes])
        self._object_id = np.repeat(np.arange(len(meshes)) + 1, [len(m.faces) for m in meshes]).astype(np.uint8)

    def peel(self, cameras: Cameras, view: int, num_layers: int) -> UInt8[np.ndarray, "layer h w"]:
        origin, directions = cameras[view].rays()
        directions = directions.reshape(-1, 3)
        origins = np.broadcast_to(origin, directions.shape)
        face, ray, points = self._heap.ray.intersects_id(origins, directions, multiple_hits=True, return_locations=True)
        order = np.lexsort((np.linalg.norm(points - origin, axis=1), ray))
        face, ray = face[order], ray[order]
        first = np.flatnonzero(np.diff(ray, prepend=-1))
        layer = np.arange(len(ray)) - np.repeat(first, np.diff(np.append(first, len(ray))))
        kept = layer < num_layers
        object_id = np.zeros((num_layers, len(directions)), np.uint8)
        object_id[layer[kept], ray[kept]] = self._object_id[face[kept]]
        return object_id.reshape(num_layers, cameras.height, cameras.width)


class StoredLayers:
    """One EXR a layer, u, v and object id as float32: the stored uv maps of the paper, read again."""

    def __init__(self, layers: Layers, folder: Path) -> None:
        self._paths = []
        for index, (uv, object_id) in enumerate(zip(layers.uv, layers.object_id, strict=True)):
            planes = np.moveaxis(uv / np.float32(UV_SCALE), -1, 0)
            channels = {"R": planes[0], "G": planes[1], "B": object_id.astype(np.float32)}
            self._paths.append(folder / f"layer_{index}.exr")
            # Not Mitsuba's writer, which (3.9.1) has waited for its own threads for ever.
            self._paths[-1].write_bytes(encode_float_exr(channels))

    def read(self) -> Layers:
        planes = [decode_radiance(path.read_bytes(), where=str(path)) for path in self._paths]
        stacked = np.stack(planes)
        return Layers(
            uv=quantize_uv(stacked[..., :2]),
            object_id=stacked[..., 2].astype(np.uint8),
            depth=np.zeros(stacked.shape[:-1], np.float32),
        )


def trace_eagerly(tracer: LightPathTracer, origins: np.ndarray, directions: np.ndarray, limits: Limits) -> LightPaths:
    """The product's light paths, but with the loop in Python and an evaluation after every bounce."""
    import drjit as dr

    plain = dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False), dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False)
    with plain[0], plain[1]:
        return tracer.trace(origins, directions, limits)
