"""The scene `prism_bench`: prisms, a lens, cut crystal and frosted glass in a hard beam in the dark."""

from functools import partial

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.builtin import GAP, put_on, slab, walk_along
from datagen.scene.description import CameraRig, Card, Scene, SceneObject, SoftEnvironment
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Plastic, RoughDielectric, SolidTexture
from datagen.scene.modelling import (
    ball,
    convex_hull,
    cylinder,
    filleted,
    knot,
    lathe,
    merged,
    moved,
    rounded_box,
    shaded,
    transformed,
    tube,
    turned,
    walled,
)

BENCH_TOP = 0.75
SHEET = 0.005
"""Height of the sheet of card on the bench, which catches the light."""
_on_bench = partial(put_on, BENCH_TOP + SHEET)
FLINT = Dielectric(ior="sf11", dispersion="measured")
CRYSTAL = Dielectric(ior="f2", dispersion="measured")
FANCY = Dielectric(ior=1.62, dispersion=4.0)
"""Disperses five times as much as flint glass (0.78), so that colours separate over a short distance."""


def make() -> Scene:
    """The scene, not unwrapped or described yet."""
    return Scene(
        name="prism_bench",
        objects=(*_bench(), *_glass(), *_things()),
        environment=SoftEnvironment(
            zenith=(0.015, 0.02, 0.03),
            horizon=(0.03, 0.036, 0.05),
            ground=(0.02, 0.02, 0.02),
            cards=(
                # The beam comes from behind, so that glass directs its light towards the viewer.
                Card(
                    direction=(-0.80, 0.75, 0.52), size_deg=(8.0, 44.0), radiance=(24.0, 22.5, 20.0), softness_deg=0.8
                ),
                Card(direction=(0.3, 0.2, 1.0), size_deg=(40.0, 24.0), radiance=(0.5, 0.55, 0.65), softness_deg=6.0),
                Card(direction=(1.0, 0.1, 0.25), size_deg=(12.0, 44.0), radiance=(0.7, 1.0, 1.5)),
                Card(direction=(-1.0, -0.45, 0.3), size_deg=(9.0, 40.0), radiance=(1.3, 1.0, 0.7)),
            ),
        ),
        cameras=CameraRig(
            target=(0.0, 0.0, BENCH_TOP + 0.05),
            radius=0.66,
            elevation_deg=(9.0, 62.0),
            azimuth_deg=(-165.0, -15.0),
            fov_deg=45.0,
            target_jitter=0.2,
            walk=walk_along(
                ((0.62, -0.70, 1.10), (0.0, 0.0, 0.80)),
                ((0.22, -0.36, 0.93), (-0.04, 0.02, 0.80)),
                ((-0.10, -0.50, 0.86), (0.05, 0.05, 0.80)),
                ((-0.55, -0.62, 0.95), (0.05, 0.0, 0.78)),
                ((-0.60, -1.15, 1.25), (0.10, 0.05, 0.78)),
                ((0.40, -1.30, 1.55), (-0.05, 0.05, 0.78)),
                ((1.00, -0.75, 1.05), (-0.05, 0.0, 0.80)),
                ((0.80, -0.10, 1.25), (0.0, 0.0, 0.80)),
            ),
        ),
    )


def _bench() -> list[SceneObject]:
    walnut = SolidTexture(pattern="wood", colors=((0.24, 0.14, 0.08), (0.11, 0.06, 0.035)), scale=0.07, axis="y")
    below = BENCH_TOP - 0.06
    floor = moved(cylinder(4.0, 0.05, bevel=0.004, segments=128), (0, 0, -0.05))
    sheet = turned(rounded_box((0.86, 0.70, SHEET - GAP), bevel=0.0008), (0, 0, 1), -6)
    sheet = moved(sheet, (0, 0, BENCH_TOP + (SHEET + GAP) / 2))
    return [
        SceneObject(name="floor", mesh=floor, material=Diffuse(color=(0.06, 0.065, 0.08))),
        slab("bench", (1.9, 1.4, 0.06), (0, 0, BENCH_TOP - 0.03), Plastic(color=walnut, roughness=0.3), bevel=0.006),
        SceneObject(name="sheet", mesh=sheet, material=Diffuse(color=(0.72, 0.71, 0.69))),
        slab("foot", (1.2, 0.8, below - 2 * GAP), (0, 0, below / 2), Diffuse(color=(0.10, 0.11, 0.13)), bevel=0.006),
    ]


def _glass() -> list[SceneObject]:
    goblet_side = filleted([(0, 0, 0), (0.034, 0, 0.002), (0.040, 0.016, 0.004), (0.047, 0.105, 0)], segments=2)
    tumbler = lathe(walled(goblet_side, wall=0.005, floor=0.022), segments=14, crease_deg=8)
    frosted = cylinder(0.030, 0.115, bevel=0.004, segments=72)
    lying = turned(moved(prism(0.062, 0.15), (0, 0, -0.075)), (1, 0, 0), 90)
    round_ball = ball(0.058, subdivisions=2)
    crystal_ball = shaded(round_ball.vertices.astype(np.float64), round_ball.faces, crease_deg=3)  # Of flat facets.
    return [
        _on_bench("prism", turned(prism(0.085, 0.16), (0, 0, 1), 53), FANCY, -0.13, 0.12),
        _on_bench("prism_lying", turned(lying, (0, 0, 1), -30), FLINT, 0.00, -0.24),
        _on_bench("lens", turned(_lens(0.062, 0.075), (0, 0, 1), -48), Dielectric(ior="bk7"), 0.01, 0.20),
        _on_bench("brilliant", transformed(brilliant(), 0.052 * np.eye(3), (0, 0, 0)), DIAMOND, 0.13, -0.11),
        _on_bench("crystal_ball", crystal_ball, CRYSTAL, 0.13, 0.04),
        _on_bench("tumbler", tumbler, CRYSTAL, 0.29, 0.04),
        _on_bench("frosted", frosted, RoughDielectric(ior=1.5, roughness=0.12, absorption=(9.0, 2.0, 3.5)), 0.17, 0.20),
    ]


DIAMOND = Dielectric(ior="diamond", dispersion="measured")


def _things() -> list[SceneObject]:
    stripes = SolidTexture(pattern="stripes", colors=((0.85, 0.82, 0.74), (0.08, 0.09, 0.12)), scale=0.022, axis="z")
    path = knot(0.040, 0.016, count=320)
    block = turned(rounded_box((0.05, 0.05, 0.11), bevel=0.004), (0, 0, 1), 30)
    brass = Conductor(color=(0.92, 0.68, 0.36), roughness=0.15)
    red = Plastic(color=(0.62, 0.05, 0.04), roughness=0.08)
    return [
        _on_bench("screen", _screen(), Diffuse(color=(0.03, 0.03, 0.035)), -0.23, 0.20),
        _on_bench("knot", tube(path, 0.009, segments=32, is_loop=True), brass, 0.33, -0.13),
        _on_bench("striped_block", block, Plastic(color=stripes, roughness=0.1), -0.34, 0.00),
        _on_bench("red_ball", ball(0.036), red, 0.20, -0.24),
    ]


def _screen() -> Mesh:
    """A board across the beam with a slit in front of the prism; the colours fall into its shadow."""
    height, slit, sill = 0.175, 0.045, 0.12
    left = moved(rounded_box((0.32, 0.008, height), bevel=0.002), (-0.16 - slit / 2, 0, height / 2))
    right = moved(rounded_box((0.08, 0.008, height), bevel=0.002), (0.04 + slit / 2, 0, height / 2))
    lintel = rounded_box((slit + 0.01, 0.006, height - sill), bevel=0.002)
    return turned(merged([left, right, moved(lintel, (0, 0, (height + sill) / 2 - 0.001))]), (0, 0, 1), 46.8)


def prism(side: float, height: float) -> Mesh:
    """An upright column over an equilateral triangle centred on the origin."""
    angles = np.radians([90, 210, 330])
    corners = side / np.sqrt(3) * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return convex_hull(np.array([(x, y, z) for x, y in corners for z in (0.0, height)]), crease_deg=2)


def _lens(radius: float, curvature: float) -> Mesh:
    """A biconvex lens upright on its rim, its axis along y."""
    angle = np.linspace(0, np.arcsin(radius / curvature), 32)
    bulge = curvature * (np.cos(angle) - np.cos(angle[-1])) + 0.0025
    outline = [(curvature * np.sin(a), z) for a, z in zip(angle, bulge)]
    below = [(r, -z) for r, z in outline]
    profile = [(float(r), float(z)) for r, z in [*below, *outline[::-1]]]
    return turned(lathe(profile, segments=128), (1, 0, 0), 90)


def brilliant() -> Mesh:
    """A round brilliant with girdle radius 1, lying on its table with its point up.

    Source: Tolkowsky 1919: a table of 53 % of the girdle, a crown of 34.5 degrees, a pavilion of 40.75 degrees.
    """
    crown, pavilion, table, girdle = np.radians(34.5), np.radians(40.75), 0.53, 0.04
    points = [(0.0, 0.0, -girdle - np.tan(pavilion))]
    for k in range(8):
        angle, half = k * np.pi / 4, np.pi / 8
        points.append((*_around(table, angle), (1 - table) * np.tan(crown)))
        points += [(*_around(1.0, angle + half * j), z) for j in (0, 1) for z in (0.0, -girdle)]
        # Stars and halves: the corners between the facets of crown and pavilion.
        points.append((*_around(0.775, angle + half), (1 - 0.775 * np.cos(half)) * np.tan(crown)))
        points.append((*_around(0.24, angle + half), -girdle - (1 - 0.24 * np.cos(half) ** 0.5) * np.tan(pavilion)))
    return turned(convex_hull(np.array(points, np.float64), crease_deg=2), (1, 0, 0), 180)


def _around(radius: float, angle: float) -> tuple[float, float]:
    return float(radius * np.cos(angle)), float(radius * np.sin(angle))
