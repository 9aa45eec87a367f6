"""The scene `drinks`: tinted drinks in glasses, with ice and a straw, on a table in a room.

Drinks extend into the walls of their glasses and have the lowest priority, ice has the highest.
"""

from functools import partial

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.builtin import GAP, put_enlarged, slab, walk_along
from datagen.scene.description import CameraRig, Lobe, Scene, SceneObject, SoftEnvironment
from datagen.scene.materials import Color, Dielectric, Diffuse, Plastic, SolidTexture
from datagen.scene.modelling import (
    ball,
    curved,
    cylinder,
    deformed,
    filled,
    filleted,
    lathe,
    merged,
    moved,
    resting,
    rotation,
    rounded_box,
    transformed,
    tube,
    turned,
    walled,
)

TABLE_TOP = 0.74
GENEROUS = 1.4
"""Scale of glasses and fruit, larger than life so that small pictures show them."""
REACH = 0.001
"""Metres that a drink extends into its glass, before it is enlarged."""
GLASS = Dielectric(ior=1.5)
ICE = Dielectric(ior=1.31, priority=1)
_on_table = partial(put_enlarged, GENEROUS, TABLE_TOP)


def make() -> Scene:
    """The scene, not unwrapped or described yet."""
    return Scene(
        name="drinks",
        objects=(*_room(), *_whisky(), *_lemonade(), *_wine(), *_carafe(), *_things()),
        environment=SoftEnvironment(
            zenith=(0.56, 0.63, 0.74),
            horizon=(0.60, 0.57, 0.54),
            ground=(0.26, 0.24, 0.22),
            lobes=(
                Lobe(direction=(0.9, -0.3, 0.8), radiance=(3.0, 2.45, 1.8), sharpness=8.0),
                Lobe(direction=(-0.6, -1.0, 0.5), radiance=(0.50, 0.68, 0.95), sharpness=5.0),
            ),
        ),
        cameras=CameraRig(
            target=(0.0, 0.02, 0.83),
            radius=1.05,
            elevation_deg=(8.0, 65.0),
            azimuth_deg=(-150.0, 60.0),
            fov_deg=45.0,
            target_jitter=0.25,
            walk=walk_along(
                ((0.90, -0.90, 1.25), (0.0, 0.0, 0.82)),
                ((0.50, -0.55, 1.00), (0.0, 0.02, 0.83)),
                ((0.05, -0.62, 0.90), (0.02, 0.05, 0.84)),
                ((-0.50, -0.60, 0.95), (0.05, 0.05, 0.82)),
                ((-0.75, -1.40, 1.05), (0.15, 0.20, 0.80)),
                ((0.45, -2.20, 1.60), (-0.10, 0.10, 0.80)),
                ((1.80, -1.20, 2.00), (-0.10, 0.05, 0.75)),
                ((1.50, 0.45, 1.10), (-0.05, 0.02, 0.82)),
            ),
        ),
    )


def _room() -> list[SceneObject]:
    boards = SolidTexture(pattern="wood", colors=((0.50, 0.36, 0.24), (0.30, 0.19, 0.11)), scale=0.17, axis="y")
    walnut = SolidTexture(pattern="wood", colors=((0.52, 0.34, 0.20), (0.28, 0.15, 0.08)), scale=0.045, axis="y")
    tiles = SolidTexture(pattern="checker", colors=((0.78, 0.72, 0.60), (0.16, 0.36, 0.42)), scale=0.30)
    print_ = SolidTexture(pattern="stripes", colors=((0.82, 0.60, 0.22), (0.56, 0.14, 0.12)), scale=0.28, axis="z")
    return [
        slab("floor", (6.4, 6.4, 0.05), (0.6, -0.6, -0.025), Plastic(color=boards, roughness=0.35)),
        slab("back_wall", (6.0, 0.08, 3.2), (0.6, 1.84, 1.601), Diffuse(color=(0.72, 0.66, 0.56))),
        slab("left_wall", (0.08, 6.0, 3.2), (-2.06, -1.25, 1.601), Diffuse(color=(0.46, 0.56, 0.50))),
        slab("picture", (0.03, 1.3, 0.9), (-2.00, -0.1, 1.45), Diffuse(color=print_), bevel=0.005),
        slab("tiles", (2.2, 0.03, 1.2), (0.1, 1.78, 1.25), Plastic(color=tiles, roughness=0.2), bevel=0.005),
        SceneObject(name="table", mesh=_table(), material=Plastic(color=walnut, roughness=0.2)),
    ]


def _table() -> Mesh:
    """A top, a slit above its four legs."""
    top = moved(rounded_box((1.15, 0.85, 0.036), bevel=0.006), (0, 0, TABLE_TOP - 0.018))
    leg = cylinder(0.018, TABLE_TOP - 0.038 - GAP, top_radius=0.03, bevel=0.003)
    return merged([top, *(moved(leg, (x, y, GAP)) for x in (-0.48, 0.48) for y in (-0.34, 0.34))])


def _whisky() -> list[SceneObject]:
    side = filleted([(0, 0, 0), (0.036, 0, 0.006), (0.039, 0.088, 0)], segments=6)
    vessel = {"wall": 0.003, "floor": 0.012}
    whisky = filled(side, **vessel, level=0.050, reach=REACH)
    cubes = [(0.012, 0.006, 0.047, (1, 0.4, 0.2), 24.0), (-0.013, -0.009, 0.043, (0.2, 1, 0.5), 38.0)]
    ice = [
        _on_table(f"whisky_ice_{index}", transformed(_ice(0.020), rotation(axis, angle), (x, y, z)), ICE, 0.20, -0.14)
        for index, (x, y, z, axis, angle) in enumerate(cubes)
    ]
    return [
        _on_table("tumbler", lathe(walled(side, **vessel)), GLASS, 0.20, -0.14),
        _on_table("whisky", lathe(whisky), _drink(1.36, (1.8, 9, 34)), 0.20, -0.14),
        *ice,
    ]


def _lemonade() -> list[SceneObject]:
    side = filleted([(0, 0, 0), (0.029, 0, 0.005), (0.034, 0.145, 0)], segments=6)
    vessel = {"wall": 0.0026, "floor": 0.011}
    lemonade = filled(side, **vessel, level=0.108, reach=REACH)
    bands = SolidTexture(pattern="stripes", colors=((0.85, 0.83, 0.78), (0.72, 0.10, 0.12)), scale=0.022, axis="z")
    # From above the floor out over the rim; in overlapping joints, since one long strip makes a bad atlas.
    line = np.linspace((-0.0160, 0.0, 0.0175), (0.0330, 0.002, 0.205), 61)
    straw = merged(
        [
            tube(line[max(0, start - 1) : start + 11], 0.0030 + 0.0002 * (start % 20 == 0), segments=20)
            for start in range(0, 60, 10)
        ]
    )
    cube = transformed(_ice(0.019), rotation((0.5, 1, 0.3), 33.0), (-0.012, 0.0, 0.104))
    return [
        _on_table("highball", lathe(walled(side, **vessel)), GLASS, -0.05, 0.02),
        _on_table("lemonade", lathe(lemonade), _drink(1.34, (15, 3, 11)), -0.05, 0.02),
        _on_table("lemonade_ice", cube, ICE, -0.05, 0.02),
        _on_table("straw", straw, Plastic(color=bands, roughness=0.2), -0.05, 0.02),
    ]


def _wine() -> list[SceneObject]:
    foot = filleted([(0, 0, 0), (0.034, 0, 0.0012), (0.034, 0.0026, 0.0012), (0.016, 0.0052, 0.02)])
    bowl = curved(
        [(0.0052, 0.012), (0.0038, 0.03), (0.0038, 0.065), (0.0075, 0.083), (0.028, 0.102), (0.0385, 0.132),
         (0.0370, 0.160), (0.0315, 0.188)],
        count=40,
    )  # fmt: skip
    side = [*foot, *map(tuple, bowl.tolist())]
    vessel = {"wall": 0.0022, "floor": 0.0895}
    wine = lathe(filled(side, **vessel, level=0.134, reach=REACH), segments=72)
    return [
        _on_table("wine_glass", lathe(walled(side, **vessel), segments=72), GLASS, 0.10, 0.14),
        _on_table("wine", wine, _drink(1.35, (6, 32, 26)), 0.10, 0.14),
    ]


def _carafe() -> list[SceneObject]:
    outline = curved(
        [(0.040, 0.0), (0.052, 0.03), (0.055, 0.07), (0.036, 0.125), (0.024, 0.16), (0.027, 0.205)], count=40
    )
    side = [(0.0, 0.0), *map(tuple, outline.tolist())]
    vessel = {"wall": 0.0030, "floor": 0.010}
    water = lathe(filled(side, **vessel, level=0.105, reach=REACH), segments=80)
    return [
        _on_table("carafe", lathe(walled(side, **vessel), segments=80, crease_deg=30), GLASS, -0.26, 0.15),
        _on_table("water", water, _drink(1.33, (0.4, 0.1, 0.1)), -0.26, 0.15),
    ]


def _things() -> list[SceneObject]:
    peel = SolidTexture(pattern="speckle", colors=((0.86, 0.66, 0.08), (0.70, 0.46, 0.04)), scale=0.008)
    zest = SolidTexture(pattern="speckle", colors=((0.84, 0.36, 0.05), (0.62, 0.20, 0.03)), scale=0.008)
    cloth = SolidTexture(pattern="checker", colors=((0.78, 0.74, 0.66), (0.20, 0.30, 0.50)), scale=0.06)
    board = SolidTexture(pattern="wood", colors=((0.70, 0.54, 0.34), (0.48, 0.32, 0.18)), scale=0.03, axis="x")
    height = 0.016
    lemon = turned(deformed(ball(0.029), _lemon), (0, 0, 1), 35)
    lime = turned(deformed(ball(0.024), _lemon), (0, 0, 1), 110)
    slab = turned(rounded_box((0.20, 0.13, height), bevel=0.004), (0, 0, 1), 12)
    napkin = turned(rounded_box((0.17, 0.17, 0.004), bevel=0.0012), (0, 0, 1), -18)
    return [
        _on_table("napkin", moved(napkin, (0, 0, 0.002)), Diffuse(color=cloth), -0.20, -0.20),
        _on_table("board", moved(slab, (0, 0, height / 2)), Plastic(color=board, roughness=0.3), 0.33, 0.17),
        _on_table("lemon", resting(lemon, (0, 0, height + GAP)), Plastic(color=peel, roughness=0.2), 0.37, 0.15),
        _on_table("orange", resting(ball(0.036), (0, 0, height + GAP)), Plastic(color=zest, roughness=0.2), 0.28, 0.19),
        _on_table("lime", resting(lime, (0, 0, 0.005)), Plastic(color=(0.16, 0.36, 0.06), roughness=0.2), -0.21, -0.19),
    ]


def _drink(ior: float, absorption: Color) -> Dielectric:
    """A drink; absorption in 1/m at the enlarged size."""
    return Dielectric(ior=ior, absorption=absorption, priority=-1)


def _ice(size: float) -> Mesh:
    """A cube with soft edges and hollow sides, around the origin."""
    cube = rounded_box((size, size, size), bevel=0.2 * size, segments=5)
    return deformed(cube, lambda p: p * (0.90 + 0.16 * np.linalg.norm(p, axis=-1, keepdims=True) / size))


def _lemon(p: np.ndarray) -> np.ndarray:
    """A ball stretched along x, with a tip at each end."""
    t = p[:, :1] / np.abs(p[:, 0]).max()
    return np.concatenate([p[:, :1] * (1.22 + 0.22 * t**8), p[:, 1:] * (1 - 0.10 * t**2)], axis=-1)
