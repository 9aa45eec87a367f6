"""The scene of `peel`: closed objects within two concentric shells, with any number of triangles."""

import math

import numpy as np

from datagen.data.cameras import Cameras, look_at
from datagen.data.meshes import Mesh
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Material, Plastic, ThinDielectric
from datagen.scene.modelling import ball, transformed, tube

SHELLS = 1.0, 0.93
"""Radii of the spheres around all else, each with a quarter of the triangles."""

INNER = 9
"""Objects within them."""


def make_shells(subdivisions: int = 6) -> tuple[Mesh, ...]:
    """Two concentric spheres around ellipsoids and rings that overlap; all closed, the same ones every time.

    Args:
        subdivisions: of the shells; four times the triangles for each. By default all together have 350,000.
    """
    rng = np.random.default_rng(0)
    meshes = [ball(radius, subdivisions=subdivisions) for radius in SHELLS]
    segments = 2**subdivisions
    angles = np.arange(5 * segments // 2) * (2 * np.pi / (5 * segments // 2))
    circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    for index in range(INNER):
        radii = rng.uniform(0.1, 0.3, 3)
        way = rng.normal(size=3)
        offset = rng.uniform(0, 0.5) * way / np.linalg.norm(way)
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        is_ring = index % 3 == 0
        inner = (
            tube(0.25 * circle, 0.3 * radii[0], segments=segments, is_loop=True)
            if is_ring
            else ball(1.0, subdivisions=subdivisions - 1)
        )
        meshes.append(transformed(inner, turn if is_ring else turn @ np.diag(radii), offset.tolist()))
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
    inner = (kinds[index % len(kinds)] for index in range(len(meshes) - len(SHELLS)))
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
