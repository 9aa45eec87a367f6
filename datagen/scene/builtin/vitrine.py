"""The scene `vitrine`: small sculptures in a brass-framed case of thin glass, on a plinth in a gallery."""

from functools import partial

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.builtin import GAP, put_on, slab, walk_along
from datagen.scene.description import CameraRig, Lobe, Scene, SceneObject, SoftEnvironment
from datagen.scene.materials import Conductor, Diffuse, Plastic, SolidTexture, ThinDielectric
from datagen.scene.modelling import (
    ball,
    curved,
    deformed,
    filleted,
    knot,
    lathe,
    merged,
    moved,
    rounded_box,
    sheet,
    tube,
    turned,
    walled,
)

PLINTH_TOP = 0.90
WIDTH, DEPTH, HEIGHT = 0.86, 0.52, 0.52
"""Size of the case between the axes of its bars, in metres."""
BAR = 0.014
_inside = partial(put_on, PLINTH_TOP)


def make() -> Scene:
    """The scene, not unwrapped or described yet."""
    return Scene(
        name="vitrine",
        objects=(*_room(), *_case(), *_sculptures()),
        environment=SoftEnvironment(
            zenith=(0.66, 0.70, 0.76),
            horizon=(0.58, 0.55, 0.52),
            ground=(0.24, 0.22, 0.21),
            lobes=(
                Lobe(direction=(0.75, -0.45, 0.9), radiance=(3.3, 2.7, 2.0), sharpness=8.0),
                Lobe(direction=(-0.6, -1.0, 0.35), radiance=(0.45, 0.65, 1.00), sharpness=5.0),
            ),
        ),
        cameras=CameraRig(
            target=(0.0, 0.0, 1.12),
            radius=1.45,
            elevation_deg=(5.0, 60.0),
            azimuth_deg=(-150.0, 60.0),
            fov_deg=45.0,
            target_jitter=0.3,
            walk=walk_along(
                ((1.00, -1.05, 1.45), (0.0, 0.0, 1.12)),
                ((0.45, -0.60, 1.22), (-0.05, 0.0, 1.08)),
                ((-0.25, -0.62, 1.05), (0.05, 0.02, 1.05)),
                ((-0.95, -0.95, 0.95), (0.10, 0.05, 1.05)),
                ((-0.40, -2.20, 1.40), (0.25, 0.30, 1.10)),
                ((1.60, -2.40, 2.20), (-0.10, 0.10, 1.00)),
                ((1.90, 0.50, 1.30), (-0.10, 0.00, 1.12)),
                ((0.80, 0.90, 1.75), (0.00, -0.05, 1.10)),
            ),
        ),
    )


def _room() -> list[SceneObject]:
    terrazzo = SolidTexture(pattern="speckle", colors=((0.58, 0.56, 0.53), (0.28, 0.20, 0.17)), scale=0.055)
    ash = SolidTexture(pattern="wood", colors=((0.62, 0.47, 0.32), (0.40, 0.27, 0.16)), scale=0.06, axis="x")
    varnish = Plastic(color=ash, roughness=0.2)
    first = SolidTexture(pattern="stripes", colors=((0.75, 0.30, 0.16), (0.82, 0.70, 0.46)), scale=0.30, axis="x")
    second = SolidTexture(pattern="marble", colors=((0.12, 0.28, 0.42), (0.85, 0.78, 0.62)), scale=0.45)
    outline = curved([(0.09, 0.0), (0.19, 0.20), (0.21, 0.45), (0.11, 0.78), (0.07, 0.92), (0.10, 1.02)], count=24)
    urn = lathe(walled([(0.0, 0.0), *map(tuple, outline.tolist())], wall=0.012, floor=0.02), segments=72, crease_deg=30)
    bands = SolidTexture(pattern="stripes", colors=((0.72, 0.66, 0.52), (0.10, 0.30, 0.28)), scale=0.17, axis="z")
    return [
        slab("floor", (7.0, 7.0, 0.05), (0.6, -0.6, -0.025), Plastic(color=terrazzo, roughness=0.3)),
        slab("back_wall", (6.2, 0.08, 3.4), (0.7, 2.24, 1.701), Diffuse(color=(0.70, 0.66, 0.60))),
        slab("left_wall", (0.08, 6.2, 3.4), (-2.26, -0.95, 1.701), Diffuse(color=(0.66, 0.44, 0.36))),
        slab("painting_stripes", (0.9, 0.03, 1.2), (-0.55, 2.18, 1.55), Diffuse(color=first), bevel=0.005),
        slab("painting_marble", (0.03, 1.4, 0.9), (-2.20, 0.15, 1.50), Diffuse(color=second), bevel=0.005),
        SceneObject(name="urn", mesh=moved(urn, (1.15, 1.45, GAP)), material=Plastic(color=bands, roughness=0.2)),
        slab("plinth", (1.0, 0.66, PLINTH_TOP - GAP), (0, 0, (PLINTH_TOP + GAP) / 2), varnish, bevel=0.008),
    ]


def _case() -> list[SceneObject]:
    base = PLINTH_TOP + GAP + BAR / 2
    brass = Conductor(color=(0.86, 0.66, 0.36), roughness=0.22)
    return [
        SceneObject(name="case_frame", mesh=moved(_frame(), (0, 0, base)), material=brass),
        SceneObject(name="case_panes", mesh=moved(_panes(), (0, 0, base)), material=ThinDielectric(ior=1.5)),
    ]


def _frame() -> Mesh:
    """Twelve bars of three thicknesses that end inside each other, so that no two faces lie in one plane."""
    x, y = WIDTH / 2, DEPTH / 2
    post = rounded_box((BAR, BAR, HEIGHT + BAR), bevel=0.002)
    parts = [moved(post, (i * x, j * y, HEIGHT / 2)) for i in (-1, 1) for j in (-1, 1)]
    along_x = rounded_box((WIDTH, BAR - 0.002, BAR - 0.002), bevel=0.002)
    along_y = rounded_box((BAR - 0.003, DEPTH, BAR - 0.003), bevel=0.002)
    for z in (0, HEIGHT):
        parts += [moved(along_x, (0, side * y, z)) for side in (-1, 1)]
        parts += [moved(along_y, (side * x, 0, z)) for side in (-1, 1)]
    return merged(parts)


def _panes() -> Mesh:
    """Four walls and a lid: sheets with their front outside and a gap to the bars."""
    inset = BAR / 2 + GAP
    x, y, z = WIDTH / 2 - inset, DEPTH / 2 - inset, HEIGHT - inset
    width, depth, height = (2 * x, 0, 0), (0, 2 * y, 0), (0, 0, z - inset)
    cells = (4, 4)
    return merged(
        [
            sheet((-x, -DEPTH / 2, inset), width, height, cells=cells),
            sheet((x, DEPTH / 2, inset), (-2 * x, 0, 0), height, cells=cells),
            sheet((WIDTH / 2, -y, inset), depth, height, cells=cells),
            sheet((-WIDTH / 2, y, inset), (0, -2 * y, 0), height, cells=cells),
            sheet((-x, -y, HEIGHT), width, depth, cells=cells),
        ]
    )


def _sculptures() -> list[SceneObject]:
    chess = SolidTexture(pattern="checker", colors=((0.80, 0.74, 0.60), (0.10, 0.10, 0.14)), scale=0.048)
    veined = SolidTexture(pattern="marble", colors=((0.10, 0.30, 0.22), (0.75, 0.80, 0.70)), scale=0.16)
    spots = SolidTexture(pattern="speckle", colors=((0.86, 0.62, 0.10), (0.30, 0.08, 0.20)), scale=0.030)
    path = knot(0.068, 0.028, lobes=5, count=220)
    upright = turned(tube(path, 0.0125, segments=20, is_loop=True), (1, 0, 0), 78)
    heights = [(0.048, float(z)) for z in np.linspace(0, 0.34, 48)]
    pillar = deformed(lathe([(0.0, 0.0), *heights, (0.0, 0.34)], segments=64), _twist)
    bowl_side = filleted([(0, 0, 0), (0.040, 0, 0.004), (0.046, 0.012, 0.02), (0.105, 0.075, 0.03), (0.112, 0.10, 0)])
    bowl = lathe(walled(bowl_side, wall=0.006, floor=0.008), segments=72)
    balls = ((0.060, 0.060), (0.046, 0.150), (0.034, 0.217), (0.024, 0.266))
    totem = merged([moved(ball(radius, subdivisions=3), (0, 0, z)) for radius, z in balls])
    gem = deformed(ball(0.072, subdivisions=1), lambda p: p * [1, 1, 1.25], crease_deg=5)
    egg = deformed(ball(0.055), lambda p: p * (1 - 1.6 * p[:, 2:]) * [1, 1, 1.32])
    return [
        _inside("knot", upright, Plastic(color=(0.72, 0.12, 0.08), roughness=0.08), 0.16, 0.09),
        _inside("pillar", pillar, Plastic(color=(0.03, 0.34, 0.40), roughness=0.15), -0.10, 0.13),
        _inside("bowl", bowl, Plastic(color=veined, roughness=0.1), 0.07, -0.11),
        _inside("totem", totem, Plastic(color=spots, roughness=0.15), -0.30, 0.04),
        _inside("gem", turned(gem, (1, 0.3, 0), 25), Conductor(color=(0.92, 0.60, 0.48), roughness=0.25), 0.32, -0.08),
        _inside("egg", egg, Plastic(color=chess, roughness=0.1), -0.16, -0.12),
    ]


def _twist(p: np.ndarray) -> np.ndarray:
    """A cylinder made square with soft edges, a third of a turn from bottom to top, with a waist."""
    t = p[:, 2] / 0.34
    radius = np.maximum(np.hypot(p[:, 0], p[:, 1]), 1e-9)
    cosines = p[:, :2] / radius[:, None]
    square = np.maximum((cosines**6).sum(axis=-1), 0.1) ** (-1 / 6)  # 1 to 2^(1/3), except on the axis, where all is 0.
    scale = square * (1 - 0.35 * np.sin(np.pi * t))
    cos, sin = np.cos(np.radians(120) * t), np.sin(np.radians(120) * t)
    return np.stack(
        [scale * (cos * p[:, 0] - sin * p[:, 1]), scale * (sin * p[:, 0] + cos * p[:, 1]), p[:, 2]], axis=-1
    )
