"""The scene `glass_table`: a glass table top with solid glassware and textured things on it, in a room."""

from functools import partial

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.builtin import GAP, put_enlarged, slab, walk_along
from datagen.scene.description import CameraRig, Lobe, Scene, SceneObject, SoftEnvironment
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Plastic, SolidTexture
from datagen.scene.modelling import (
    Part,
    ball,
    curved,
    cylinder,
    deformed,
    filleted,
    knot,
    lathe,
    merged,
    moved,
    rotation,
    rounded_box,
    transformed,
    tube,
    turned,
    walled,
)

RUG_TOP = 0.009
TABLE_TOP = 0.74
GENEROUS = 1.3
"""Scale of the tableware, larger than life so that small pictures show its glass."""
_on_table = partial(put_enlarged, GENEROUS, TABLE_TOP)


def make() -> Scene:
    """The scene, not unwrapped or described yet."""
    return Scene(
        name="glass_table",
        objects=(*_room(), *_furniture(), *_glassware(), *_things()),
        environment=SoftEnvironment(
            zenith=(0.58, 0.66, 0.78),
            horizon=(0.56, 0.54, 0.52),
            ground=(0.24, 0.22, 0.20),
            lobes=(
                Lobe(direction=(0.8, -0.25, 0.85), radiance=(3.2, 2.55, 1.8), sharpness=8.0),
                Lobe(direction=(-0.5, -1.0, 0.5), radiance=(0.50, 0.72, 1.05), sharpness=5.0),
            ),
        ),
        cameras=CameraRig(
            target=(0.0, 0.06, 0.80),
            radius=1.4,
            elevation_deg=(8.0, 70.0),
            azimuth_deg=(-150.0, 60.0),
            fov_deg=45.0,
            # Training sees nearly everything that the walk sees: no method can know unseen surfaces.
            target_jitter=0.25,
            walk=walk_along(
                ((1.15, -1.25, 1.30), (0.0, 0.0, 0.80)),
                ((0.72, -0.62, 0.98), (-0.05, 0.02, 0.80)),
                ((0.20, -0.78, 0.86), (0.02, 0.10, 0.80)),
                ((-0.70, -1.05, 0.55), (0.05, 0.15, 0.70)),
                ((-0.90, -1.90, 0.95), (0.30, 0.40, 0.75)),
                ((0.60, -3.00, 1.80), (-0.20, 0.20, 0.80)),
                ((2.60, -1.70, 2.60), (-0.20, 0.10, 0.70)),
                ((2.10, 0.60, 1.10), (-0.10, 0.05, 0.78)),
            ),
        ),
    )


def _room() -> list[SceneObject]:
    planks = SolidTexture(pattern="wood", colors=((0.56, 0.40, 0.26), (0.36, 0.23, 0.13)), scale=0.19, axis="y")
    art = SolidTexture(pattern="checker", colors=((0.80, 0.62, 0.24), (0.10, 0.22, 0.34)), scale=0.36)
    weave = SolidTexture(pattern="checker", colors=((0.62, 0.55, 0.46), (0.24, 0.30, 0.40)), scale=0.30)
    rug = moved(cylinder(1.3, RUG_TOP - GAP, bevel=0.003, segments=96), (0.0, 0.1, GAP))
    return [
        slab("floor", (7.0, 7.0, 0.05), (0.6, -0.6, -0.025), Plastic(color=planks, roughness=0.35)),
        # The back wall extends behind the left one, so that no camera in the room sees out through the corner.
        slab("back_wall", (6.7, 0.08, 3.4), (0.65, 2.64, 1.701), Diffuse(color=(0.74, 0.68, 0.60))),
        slab("left_wall", (0.08, 6.65 - GAP, 3.4), (-2.66, -0.725 - GAP / 2, 1.701), Diffuse(color=(0.50, 0.60, 0.63))),
        slab("picture", (1.3, 0.03, 0.9), (0.75, 2.58, 1.55), Diffuse(color=art), bevel=0.005),
        SceneObject(name="rug", mesh=rug, material=Diffuse(color=weave)),
    ]


def _furniture() -> list[SceneObject]:
    green = Dielectric(ior=1.52, absorption=(8.0, 2.4, 5.0))
    oak = SolidTexture(pattern="wood", colors=((0.58, 0.37, 0.19), (0.33, 0.18, 0.08)), scale=0.035, axis="x")
    return [
        slab("table_top", (1.0, 0.7, 0.018), (0, 0, TABLE_TOP - 0.009), green, bevel=0.003),
        SceneObject(name="table_frame", mesh=_table_frame(), material=Plastic(color=oak, roughness=0.2)),
        SceneObject(name="chair", mesh=_chair(), material=Plastic(color=(0.06, 0.30, 0.32), roughness=0.15)),
    ]


def _table_frame() -> Mesh:
    low, high = RUG_TOP + GAP, TABLE_TOP - 0.018 - GAP
    leg = cylinder(0.016, high - low, top_radius=0.027, bevel=0.003)
    parts: list[Part] = [(leg, (x, y, low)) for x in (-0.42, 0.42) for y in (-0.27, 0.27)]
    for side in (-1, 1):
        parts.append((rounded_box((0.82, 0.018, 0.05), bevel=0.003), (0, side * 0.27, high - 0.035)))
        parts.append((rounded_box((0.018, 0.52, 0.05), bevel=0.003), (side * 0.42, 0, high - 0.035)))
    return merged(parts)


def _chair() -> Mesh:
    """A chair facing -y, its seat's centre above the origin; coarse proxies fill the holes of its slatted back."""
    board = rounded_box((0.42, 0.035, 0.022), bevel=0.006)
    parts: list[Part] = [(board, (0, y, 0.45)) for y in np.linspace(-0.18, 0.18, 8)]
    parts += [(rounded_box((0.025, 0.40, 0.035), bevel=0.005), (x, 0, 0.43)) for x in (-0.17, 0.17)]
    parts += [(cylinder(0.013, 0.435, top_radius=0.02), (x, -0.17, 0)) for x in (-0.17, 0.17)]
    for x in (-0.19, 0.19):
        path = np.array([(x, 0.20, 0.003), (x, 0.185, 0.25), (x, 0.185, 0.45), (x, 0.215, 0.75), (x, 0.26, 1.0)])
        parts.append(tube(curved([tuple(p) for p in path], count=16), 0.017, segments=20))
    for height, back in ((0.56, 0.193), (0.96, 0.25)):
        parts.append((rounded_box((0.38, 0.02, 0.05), bevel=0.006), (0, back, height)))
    slat = turned(rounded_box((0.026, 0.010, 0.40), bevel=0.004), (1, 0, 0), -8.2)
    parts += [(slat, (x, 0.2215, 0.76)) for x in np.linspace(-0.12, 0.12, 5)]
    return transformed(merged(parts), rotation((0, 0, 1), 14.0), (-0.22, 0.80, RUG_TOP + GAP))


def _glassware() -> list[SceneObject]:
    clear = Dielectric(ior=1.5)
    tumbler_side = filleted([(0, 0, 0), (0.033, 0, 0.006), (0.035, 0.050, 0), (0.0385, 0.105, 0)], segments=6)
    tumbler = lathe(walled(tumbler_side, wall=0.0028, floor=0.011))
    foot = filleted([(0, 0, 0), (0.036, 0, 0.0012), (0.036, 0.0026, 0.0012), (0.016, 0.0052, 0.02)])
    bowl = curved(
        [(0.0052, 0.012), (0.0038, 0.03), (0.0038, 0.075), (0.0075, 0.098), (0.030, 0.118), (0.0425, 0.150),
         (0.0405, 0.180), (0.0345, 0.212)],
        count=40,
    )  # fmt: skip
    wine_glass = lathe(walled([*foot, *map(tuple, bowl.tolist())], wall=0.0019, floor=0.1045), segments=72)
    return [
        _on_table("glass_ball", moved(ball(0.058, subdivisions=4), (0, 0, 0.058)), clear, 0.07, -0.18),
        _on_table("tumbler", tumbler, clear, 0.35, 0.03),
        _on_table("wine_glass", wine_glass, clear, -0.06, 0.0),
    ]


def _things() -> list[SceneObject]:
    stripes = SolidTexture(pattern="stripes", colors=((0.80, 0.76, 0.66), (0.62, 0.12, 0.09)), scale=0.026, axis="z")
    marble = SolidTexture(pattern="marble", colors=((0.78, 0.76, 0.74), (0.12, 0.20, 0.38)), scale=0.11)
    glaze = SolidTexture(pattern="speckle", colors=((0.85, 0.50, 0.12), (0.45, 0.10, 0.05)), scale=0.017)
    cloth = SolidTexture(pattern="stripes", colors=((0.16, 0.30, 0.52), (0.75, 0.70, 0.55)), scale=0.05, axis="x")
    body = filleted([(0, 0, 0), (0.036, 0, 0.006), (0.040, 0.092, 0)], segments=5)
    handle = curved([(0.0365, 0.022), (0.056, 0.024), (0.066, 0.047), (0.058, 0.070), (0.0372, 0.074)], count=24)
    path = np.stack([handle[:, 0], np.zeros(24), handle[:, 1]], axis=-1)
    mug = merged([lathe(walled(body, wall=0.0045, floor=0.006)), tube(path, 0.0048, segments=20)])
    outline = curved(
        [(0.030, 0.0), (0.052, 0.035), (0.060, 0.085), (0.040, 0.150), (0.020, 0.195), (0.027, 0.225)], count=32
    )
    vase = lathe(walled([(0.0, 0.0), *map(tuple, outline.tolist())], wall=0.004, floor=0.006), crease_deg=30)
    trefoil = np.add(knot(0.036, 0.015, count=180), (0, 0, 0.0236))
    brass = Conductor(color=(0.90, 0.66, 0.33), roughness=0.18)
    books = [
        ("book_blue", (0.21, 0.150, 0.030), 12.0, Diffuse(color=cloth)),
        ("book_red", (0.19, 0.135, 0.024), -7.0, Diffuse(color=(0.55, 0.09, 0.07))),
        ("book_green", (0.165, 0.120, 0.020), 22.0, Diffuse(color=(0.16, 0.34, 0.14))),
    ]
    stacked, height = [], 0.0
    for name, size, angle, material in books:
        book = moved(turned(rounded_box(size, bevel=0.002), (0, 0, 1), angle), (0, 0, height + size[2] / 2))
        stacked.append(_on_table(name, book, material, -0.31, 0.16))
        height += size[2] + GAP / GENEROUS
    pear = moved(deformed(ball(0.036), _pear), (0, 0, height))
    return [
        *stacked,
        _on_table("pear", pear, Plastic(color=glaze, roughness=0.12), -0.31, 0.16),
        _on_table("mug", turned(mug, (0, 0, 1), -60), Plastic(color=stripes, roughness=0.1), -0.30, -0.20),
        _on_table("vase", vase, Plastic(color=marble, roughness=0.08), 0.14, 0.20),
        _on_table("knot", tube(trefoil, 0.0085, segments=20, is_loop=True), brass, 0.36, -0.19),
    ]


def _pear(p: np.ndarray) -> np.ndarray:
    """A ball of radius 36 mm stretched upwards, its base at z = 0."""
    t = (p[:, 2:] / 0.036 + 1) / 2
    slim = 1 - 0.52 * t**2 * (3 - 2 * t)
    upright = np.concatenate([p[:, :2] * slim, 0.095 * t - 0.006 * np.exp(-((1 - t) / 0.02))], axis=-1)
    bent = upright + np.array([0.012, 0.004, 0.0]) * t**3
    return bent - np.array([0, 0, bent[:, 2].min()])
