"""Meshes that tests are made of."""

import dataclasses

import numpy as np
import trimesh
from jaxtyping import Int32

from datagen.data.meshes import Mesh, face_corners, mesh_from
from datagen.scene.atlas import _rasterise


def mesh_of(shape: trimesh.Trimesh, seed: int = 0) -> Mesh:
    vertices, faces = np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32)
    uv = np.random.default_rng(seed).random((len(vertices), 2), np.float32)
    return mesh_from(vertices, faces, uv=uv)


def box(size: tuple[float, float, float]) -> Mesh:
    shape = trimesh.creation.box(size)
    shape.unmerge_vertices()
    return mesh_of(shape)


def random_meshes(rng: np.random.Generator, count: int) -> tuple[Mesh, ...]:
    """Balls, boxes, tori and hulls, turned and thrown together so that they overlap."""
    meshes = []
    for index in range(count):
        shape = [
            lambda: trimesh.creation.icosphere(2, 0.5),
            lambda: trimesh.creation.box(rng.uniform(0.1, 1, 3)),
            lambda: trimesh.creation.torus(0.5, 0.15, 16, 12),
            lambda: trimesh.convex.convex_hull(rng.normal(size=(20, 3)) * 0.4),
        ][index % 4]()
        shape.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        shape.apply_translation(rng.uniform(-0.8, 0.8, 3))
        meshes.append(mesh_of(shape, seed=index))
    return tuple(meshes)


def inside_out(mesh: Mesh) -> Mesh:
    return dataclasses.replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, ::-1]), normals=-mesh.normals)


def corner_cosines(mesh: Mesh) -> np.ndarray:
    """Cosine between each face's normal and the shading normal at each of its corners (face, 3)."""
    a, b, c = np.moveaxis(face_corners(mesh).astype(np.float64), 1, 0)
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    return np.einsum("fi,fki->fk", flat, mesh.normals[mesh.faces])


def polygon_ply(corners: int, order: str, extra: bool) -> bytes:
    """A standing prism in binary as Blender writes one: its sides are quads, its ends polygons or triangle fans."""
    angles = np.arange(corners) * 2 * np.pi / corners
    ring = np.stack([np.cos(angles), np.zeros(corners), -np.sin(angles)], axis=-1)
    points = np.concatenate([ring, ring + np.array([0, 2, 0]), np.zeros((1, 3))])
    here, after = np.arange(corners), np.roll(np.arange(corners), -1)
    lists = [[a, b, corners + b, corners + a] for a, b in zip(here, after, strict=True)]
    lists += [(corners + here).tolist(), *([2 * corners, b, a] for a, b in zip(here, after, strict=True))]
    letter = "<" if order == "little" else ">"
    body = points.astype(f"{letter}f4").tobytes()
    for face in lists:
        body += bytes([7, len(face)]) if extra else bytes([len(face)])
        body += np.array(face, f"{letter}u4").tobytes() + (np.array([0.5], f"{letter}f4").tobytes() if extra else b"")
    header = (
        f"ply\nformat binary_{order}_endian 1.0\ncomment Created in Blender\nelement vertex {len(points)}\n"
        f"property float x\nproperty float y\nproperty float z\nelement face {len(lists)}\n"
    )
    header += "property uchar flags\n" if extra else ""
    header += "property list uchar uint vertex_indices\n"
    header += "property float quality\n" if extra else ""
    return header.encode() + b"end_header\n" + body


def chart_map(mesh: Mesh, size: int) -> Int32[np.ndarray, "tex_h tex_w"]:
    """Which chart covers each texel centre, counted from 0; -1 in the gutters. A chart is a connected piece of uv."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    # A crease splits vertices but no chart: points are the same where position and uv are.
    _, point = np.unique(np.concatenate([mesh.vertices, mesh.uv], axis=-1), axis=0, return_inverse=True)
    faces = point.reshape(-1)[mesh.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(int(point.max()) + 1,) * 2)
    _, label = connected_components(graph, directed=False)
    _, chart_of_face = np.unique(label[faces[:, 0]], return_inverse=True)
    charts = np.full(size * size, -1, np.int32)
    for face, texel, weights in _rasterise(mesh, size):
        inside = weights.min(axis=-1) >= 0
        charts[texel[inside]] = chart_of_face[face[inside]]
    return charts.reshape(size, size)


def gutter_violations(mesh: Mesh, size: int) -> int:
    """Pairs of neighbouring texels (of eight) that different charts cover."""
    charts = chart_map(mesh, size)
    count = 0
    for rows, columns in ((1, 0), (0, 1), (1, 1), (1, -1)):
        one = charts[: size - rows, max(0, -columns) : size - max(0, columns)]
        other = charts[rows:, max(0, columns) : size - max(0, -columns)]
        count += int(((one >= 0) & (other >= 0) & (one != other)).sum())
    return count
