"""The scene of `peel`: closed objects within two concentric shells, with any number of triangles."""

import math

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras, look_at
from datagen.data.meshes import Mesh
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Material, Plastic, ThinDielectric

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
