"""Meshes that tests are made of."""

import numpy as np
import trimesh

from datagen.data.meshes import (
    Mesh,
    vertex_normals,
)


def mesh_of(shape: trimesh.Trimesh, seed: int = 0) -> Mesh:
    vertices, faces = np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32)
    uv = np.random.default_rng(seed).random((len(vertices), 2), np.float32)
    return Mesh(vertices=vertices, faces=faces, normals=vertex_normals(vertices, faces).astype(np.float32), uv=uv)


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
