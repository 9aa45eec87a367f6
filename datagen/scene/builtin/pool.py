"""The scene `pool`: rippled water in a tiled basin in the sun, with clear and frosted glass in it."""

from functools import partial

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.builtin import GAP, put_on, slab, walk_along
from datagen.scene.description import CameraRig, Card, Scene, SceneObject, SoftEnvironment
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Plastic, RoughDielectric, SolidTexture
from datagen.scene.modelling import (
    ball,
    deformed,
    filleted,
    grid_faces,
    lathe,
    merged,
    moved,
    rounded_box,
    shaded,
    tube,
    turned,
    walled,
)

INNER, WALL, RIM, BOTTOM = 0.80, 0.05, 0.33, 0.20
"""The basin in metres: inner width, thickness of its walls, height of its rim and of its bottom."""
LEVEL = 0.30
REACH = 0.004
"""Metres that the water extends into walls and bottom: coincident faces would lose layers."""
_in_basin = partial(put_on, BOTTOM)


def make() -> Scene:
    """The scene, not unwrapped or described yet."""
    return Scene(
        name="pool",
        objects=(*_basin(), *_glass(), *_things()),
        environment=SoftEnvironment(
            zenith=(0.20, 0.34, 0.62),
            horizon=(0.66, 0.72, 0.80),
            ground=(0.20, 0.18, 0.16),
            cards=(
                Card(
                    direction=(-0.45, 0.62, 1.0), size_deg=(20.0, 20.0), radiance=(24.0, 21.5, 17.0), softness_deg=10.0
                ),
                Card(direction=(1.0, 0.5, 0.35), size_deg=(26.0, 40.0), radiance=(1.6, 1.8, 2.0), softness_deg=8.0),
            ),
        ),
        cameras=CameraRig(
            target=(0.0, 0.0, 0.30),
            radius=0.95,
            elevation_deg=(14.0, 68.0),
            azimuth_deg=(-170.0, -10.0),
            fov_deg=45.0,
            target_jitter=0.2,
            walk=walk_along(
                ((0.85, -1.00, 1.10), (0.0, 0.0, 0.30)),
                ((0.40, -0.62, 0.86), (0.0, 0.05, 0.28)),
                ((-0.12, -0.52, 0.62), (0.05, 0.10, 0.30)),
                ((-0.80, -0.90, 0.85), (0.05, 0.0, 0.28)),
                ((-0.90, -1.65, 1.20), (0.15, 0.1, 0.28)),
                ((0.50, -1.90, 1.70), (-0.1, 0.1, 0.28)),
                ((1.50, -1.10, 1.30), (-0.1, 0.0, 0.30)),
                ((1.25, -0.20, 1.15), (0.0, 0.0, 0.30)),
            ),
        ),
    )


def _basin() -> list[SceneObject]:
    tiles = SolidTexture(
        pattern="checker", colors=((0.82, 0.83, 0.80), (0.16, 0.42, 0.50)), scale=0.20, origin=(0.0, 0.0, 0.07)
    )
    slabs = SolidTexture(pattern="speckle", colors=((0.56, 0.52, 0.46), (0.40, 0.36, 0.31)), scale=0.05)
    outer = INNER + 2 * WALL
    parts = [moved(rounded_box((outer - 0.02, outer - 0.02, BOTTOM - GAP), bevel=0.004), (0, 0, (BOTTOM + GAP) / 2))]
    for turn in range(4):
        # Each wall ends slightly inside the next one's side.
        wall = moved(rounded_box((outer - WALL + 0.002, WALL, RIM - GAP), bevel=0.006), (-WALL / 2, 0, (RIM + GAP) / 2))
        parts.append(turned(moved(wall, (0, (INNER + WALL) / 2, 0)), (0, 0, 1), 90 * turn))
    return [
        slab("ground", (7.0, 7.0, 0.05), (0, 0, -0.025), Diffuse(color=slabs)),
        SceneObject(name="basin", mesh=merged(parts), material=Plastic(color=tiles, roughness=0.15)),
    ]


def _glass() -> list[SceneObject]:
    clear = Dielectric(ior=1.5)
    frosted = RoughDielectric(ior=1.5, roughness=0.15, absorption=(1.0, 5.0, 6.0))
    outline = filleted([(0, 0, 0), (0.055, 0, 0.01), (0.062, 0.15, 0)], segments=6)
    tumbler = lathe(walled(outline, wall=0.006, floor=0.02), segments=96)
    block = turned(rounded_box((0.10, 0.10, 0.30), bevel=0.008), (0, 0, 1), 28)
    water = Dielectric(ior="water", absorption=(1.1, 0.25, 0.12), priority=-1)
    return [
        SceneObject(name="water", mesh=_water(), material=water),
        _in_basin("glass_ball", ball(0.115), clear, -0.12, -0.10),
        _in_basin("frosted_block", block, frosted, 0.19, 0.14),
        SceneObject(name="tumbler", mesh=moved(tumbler, (0.435, -0.18, RIM + GAP)), material=clear),
    ]


def _things() -> list[SceneObject]:
    veins = SolidTexture(pattern="marble", colors=((0.70, 0.24, 0.14), (0.86, 0.66, 0.42)), scale=0.07)
    coral = Plastic(color=veins, roughness=0.12)
    pebbles = [(0.22, -0.20, 0.045, (0.08, 0.10, 0.11)), (0.12, -0.27, 0.032, (0.62, 0.36, 0.10)),
               (-0.28, 0.16, 0.05, (0.16, 0.22, 0.16))]  # fmt: skip
    loop = np.linspace(0, 2 * np.pi, 128, endpoint=False)
    ring = np.stack([0.075 * np.cos(loop), 0.075 * np.sin(loop), 0 * loop], axis=-1)
    brass = Conductor(color=(0.90, 0.66, 0.34), roughness=0.12)
    return [
        *(
            _in_basin(
                f"pebble_{index}", deformed(ball(r), lambda p: p * [1.25, 0.95, 0.62]), Plastic(color=color), x, y
            )
            for index, (x, y, r, color) in enumerate(pebbles)
        ),
        _in_basin("coral_ball", ball(0.05), coral, -0.02, 0.22),
        _in_basin("ring", tube(ring, 0.011, segments=20, is_loop=True), brass, 0.02, 0.02),
    ]


def _water() -> Mesh:
    """The block of water under its ripples, closed."""
    count = 60
    line = np.linspace(-INNER / 2 - REACH, INNER / 2 + REACH, count)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    top = np.stack([x, y, LEVEL + _ripples(x, y)], axis=-1)
    bottom = np.stack([x, y, np.full_like(x, BOTTOM - REACH)], axis=-1)
    at = np.arange(count * count).reshape(count, count)
    surface = grid_faces(count, count)
    border = np.concatenate([at[:-1, 0], at[-1, :-1], at[:0:-1, -1], at[0, :0:-1]])
    following, below = np.roll(border, -1), count * count
    sides = np.concatenate(
        [np.stack([border, border + below, following], axis=-1),
         np.stack([following, border + below, following + below], axis=-1)]
    )  # fmt: skip
    faces = np.concatenate([surface, surface[:, ::-1] + below, sides])
    return shaded(np.concatenate([top, bottom]), faces, crease_deg=40)


def _ripples(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rings around the glass ball and two crossing swells."""
    distance = np.hypot(x + 0.12, y + 0.10)
    rings = 0.0026 * np.cos(2 * np.pi * distance / 0.115) * np.exp(-distance / 0.40)
    swells = 0.0026 * np.sin(2 * np.pi * (0.9 * x + 0.5 * y) / 0.15) + 0.0022 * np.sin(2 * np.pi * (y - 0.6 * x) / 0.12)
    return rings + swells
