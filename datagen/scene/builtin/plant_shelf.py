"""The scene `plant_shelf`: two plants of some hundred leaves, glass and small things on a shelf."""

from collections.abc import Callable

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.builtin import GAP, put_on, slab, walk_along
from datagen.scene.description import CameraRig, Lobe, Scene, SceneObject, SoftEnvironment
from datagen.scene.materials import Dielectric, Diffuse, Material, Plastic, SolidTexture
from datagen.scene.modelling import (
    ball,
    curved,
    cylinder,
    deformed,
    filleted,
    lathe,
    leaf,
    merged,
    moved,
    rotation,
    rounded_box,
    transformed,
    tube,
    turned,
    walled,
)

WALL_Y = 0.45
LEVELS = (0.12, 0.55, 1.0)
"""Heights of the boards' upper sides."""
BOARD = 0.022


def make() -> Scene:
    """The scene, not unwrapped or described yet."""
    return Scene(
        name="plant_shelf",
        objects=(*_room(), *_plants(), *_glass(), *_things()),
        environment=SoftEnvironment(
            zenith=(0.66, 0.72, 0.80),
            horizon=(0.62, 0.60, 0.57),
            ground=(0.28, 0.26, 0.24),
            lobes=(
                Lobe(direction=(0.7, -0.9, 0.9), radiance=(3.0, 2.45, 1.75), sharpness=7.0),
                Lobe(direction=(-0.9, -0.6, 0.4), radiance=(0.40, 0.55, 0.75), sharpness=4.0),
            ),
        ),
        cameras=CameraRig(
            target=(0.16, 0.05, 0.84),
            radius=2.0,
            elevation_deg=(-8.0, 50.0),
            azimuth_deg=(-140.0, -40.0),
            fov_deg=45.0,
            target_jitter=0.25,
            walk=walk_along(
                ((1.20, -1.55, 1.35), (0.10, 0.10, 0.85)),
                ((0.30, -1.05, 1.20), (0.05, 0.20, 0.95)),
                ((-0.10, -0.75, 0.80), (0.05, 0.20, 0.70)),
                ((-0.85, -0.80, 0.60), (0.10, 0.20, 0.72)),
                ((-1.90, -0.90, 1.00), (0.20, 0.10, 0.85)),
                ((-1.00, -3.60, 1.60), (0.15, 0.20, 0.85)),
                ((1.40, -2.60, 2.50), (0.15, 0.20, 0.75)),
                ((2.30, -0.60, 1.10), (0.20, 0.15, 0.90)),
            ),
        ),
    )


def _room() -> list[SceneObject]:
    planks = SolidTexture(pattern="wood", colors=((0.60, 0.46, 0.32), (0.42, 0.29, 0.18)), scale=0.17, axis="x")
    pine = SolidTexture(pattern="wood", colors=((0.66, 0.48, 0.29), (0.46, 0.30, 0.16)), scale=0.05, axis="z")
    return [
        slab("floor", (9.0, 8.0, 0.05), (0.0, -3.4, -0.025), Plastic(color=planks, roughness=0.3)),
        slab("wall", (9.0, 0.08, 3.4), (0.0, WALL_Y + 0.04, 1.701), Diffuse(color=(0.52, 0.64, 0.63))),
        SceneObject(name="shelf", mesh=_shelf(), material=Plastic(color=pine, roughness=0.25)),
    ]


def _shelf() -> Mesh:
    """Three boards, set 1 cm into two side boards that are slightly deeper."""
    side = rounded_box((0.024, 0.32, 1.03), bevel=0.003)
    board = rounded_box((1.16, 0.30, BOARD), bevel=0.003)
    return merged(
        [
            *(moved(side, (x, 0.22, GAP + 1.03 / 2)) for x in (-0.582, 0.582)),
            *(moved(board, (0, 0.22, level - BOARD / 2)) for level in LEVELS),
        ]
    )


def _plants() -> list[SceneObject]:
    leafy = SolidTexture(pattern="marble", colors=((0.09, 0.30, 0.07), (0.34, 0.52, 0.14)), scale=0.10)
    fronds = SolidTexture(pattern="stripes", colors=((0.20, 0.46, 0.10), (0.42, 0.60, 0.18)), scale=0.05, axis="z")
    clay = SolidTexture(pattern="speckle", colors=((0.58, 0.26, 0.15), (0.40, 0.16, 0.09)), scale=0.03)
    zigzag = SolidTexture(pattern="checker", colors=((0.78, 0.76, 0.70), (0.10, 0.28, 0.42)), scale=0.05)
    earth = Diffuse(color=(0.10, 0.065, 0.04))
    big, small = (0.92, 0.0, GAP), (-0.30, 0.20, LEVELS[2] + GAP)
    return [
        SceneObject(name="fig_pot", mesh=moved(_pot(0.15, 0.28), big), material=Plastic(color=clay, roughness=0.4)),
        SceneObject(name="fig_soil", mesh=moved(_soil(0.15, 0.28), big), material=earth),
        SceneObject(name="fig", mesh=moved(_fig(), _above_soil(big, 0.28)), material=Plastic(color=leafy)),
        SceneObject(name="fern_pot", mesh=moved(_pot(0.075, 0.12), small), material=Plastic(color=zigzag)),
        SceneObject(name="fern_soil", mesh=moved(_soil(0.075, 0.12), small), material=earth),
        SceneObject(name="fern", mesh=moved(_fern(), _above_soil(small, 0.12)), material=Plastic(color=fronds)),
    ]


def _pot(radius: float, height: float) -> Mesh:
    side = filleted([(0, 0, 0), (0.72 * radius, 0, 0.006), (radius, height, 0)], segments=4)
    return lathe(walled(side, wall=0.06 * radius, floor=0.06 * radius), segments=72)


def _soil(radius: float, height: float) -> Mesh:
    """A disc at 80 to 86 % of the pot's height, narrower than the pot is there."""
    bottom = radius * (0.72 + 0.28 * 0.80) - 0.06 * radius - 0.003
    return moved(cylinder(bottom, 0.06 * height, bevel=0.002), (0, 0, 0.80 * height))


def _above_soil(pot: tuple[float, float, float], height: float) -> tuple[float, float, float]:
    return (pot[0], pot[1], pot[2] + 0.86 * height + GAP)


def _fig() -> Mesh:
    """A small tree on the origin: a trunk and twelve boughs, leaves in a golden-angle spiral along each."""
    rng = np.random.default_rng(7)
    trunk = curved([(0, 0, 0.004), (0.015, 0.01, 0.25), (-0.02, -0.01, 0.55), (0.01, 0.0, 0.95)], count=24)
    parts = [tube(trunk, np.linspace(0.016, 0.005, 24), segments=12)]
    stems = [(trunk, 0.35)]
    for index in range(12):
        start = trunk[7 + index]
        azimuth, reach = 2.4 * index, rng.uniform(0.16, 0.27)
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        points = [
            start,
            start + 0.5 * reach * out + [0, 0, 0.07],
            start + reach * out + [0, 0, rng.uniform(0.16, 0.22)],
        ]
        bough = curved([tuple(point) for point in points], count=12)
        parts.append(tube(bough, np.linspace(0.006, 0.0025, 12), segments=8))
        stems.append((bough, 0.15))
    for stem, bare in stems:
        count = 44 if len(stem) == 24 else 24
        for index, t in enumerate(np.linspace(bare, 1, count)):
            place = np.array([np.interp(t * (len(stem) - 1), np.arange(len(stem)), stem[:, axis]) for axis in range(3)])
            size = rng.uniform(0.085, 0.13)
            blade = leaf(size, 0.5 * size, droop=rng.uniform(0.4, 1.1))
            parts.append(_pointing(blade, place, 2.4 * index + rng.uniform(-0.3, 0.3), rng.uniform(0.05, 0.7)))
    # The wall is behind, the shelf on the left.
    return merged([part for part in parts if _within(part, lambda p: (p[:, 1] < 0.43) & (p[:, 0] > -0.30))])


def _fern() -> Mesh:
    """Arching fronds with paired leaflets on a short stem at the origin, clear of the wall and the board."""
    rng = np.random.default_rng(3)
    parts = [tube(np.array([(0, 0, 0), (0, 0, 0.012), (0, 0, 0.024)]), np.array([0.012, 0.012, 0.006]))]
    for index in range(22):
        azimuth = 2.4 * index
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        reach, rise = rng.uniform(0.15, 0.27), rng.uniform(0.10, 0.24)
        fall = rise * rng.uniform(0.2, 0.9) if out[1] < 0.3 else rise
        points = [0.004 * out + [0, 0, 0.012], 0.45 * reach * out + [0, 0, rise], reach * out + [0, 0, fall]]
        spine = curved([tuple(point) for point in points], count=16)
        frond = [tube(spine, np.linspace(0.0022, 0.0008, 16), segments=6)]
        for step in range(5, 15):
            size = 0.07 * np.sin(np.pi * (step - 2) / 15) ** 0.8
            ahead = spine[step + 1] - spine[step]
            for side in (-1, 1):
                turn = azimuth + side * 1.15
                blade = leaf(float(size), 0.36 * float(size), droop=0.5, fold=0.2, rows=4)
                lift = float(np.arctan2(ahead[2], np.hypot(ahead[0], ahead[1]))) * 0.35
                frond.append(_pointing(blade, spine[step], turn, lift))
        parts += [part for part in frond if _within(part, lambda p: (p[:, 1] < 0.235) & (p[:, 2] > -0.07))]
    return merged(parts)


def _pointing(blade: Mesh, place: np.ndarray, azimuth: float, lift: float) -> Mesh:
    """A leaf put at a point of its stem, turned about z and raised by `lift` radians."""
    turn = rotation((0, 0, 1), np.degrees(azimuth)) @ rotation((0, 1, 0), -np.degrees(lift))
    return transformed(blade, turn, place.tolist())


def _within(part: Mesh, is_inside: Callable[[np.ndarray], np.ndarray]) -> bool:
    return bool(is_inside(part.vertices).all())


def _glass() -> list[SceneObject]:
    outline = curved(
        [(0.036, 0.0), (0.058, 0.05), (0.062, 0.10), (0.036, 0.17), (0.032, 0.20), (0.046, 0.24)], count=40
    )
    vase = lathe(walled([(0.0, 0.0), *map(tuple, outline.tolist())], wall=0.0045, floor=0.012), segments=80)
    dome = filleted([(0, 0.262, 0), (0.082, 0.262, 0.079), (0.082, 0, 0.0016), (0.0785, 0, 0.0016),
                     (0.0785, 0.2585, 0.0755), (0, 0.2585, 0)], segments=14)  # fmt: skip
    bottle_side = filleted([(0, 0, 0), (0.040, 0, 0.006), (0.040, 0.15, 0.03), (0.013, 0.185, 0.02),
                            (0.013, 0.235, 0.01), (0.016, 0.25, 0)], segments=8)  # fmt: skip
    bottle = lathe(walled(bottle_side, wall=0.003, floor=0.008), segments=72)
    green = Dielectric(ior=1.5, absorption=(90.0, 18.0, 60.0))
    return [
        _on_board("vase", vase, Dielectric(ior=1.5), 0.16, 0.20, 2),
        _on_board("bell_jar", lathe(dome, segments=72), Dielectric(ior=1.5), 0.10, 0.20, 1),
        _on_board("bottle", bottle, green, 0.36, 0.22, 1),
    ]


def _things() -> list[SceneObject]:
    ribs = SolidTexture(pattern="stripes", colors=((0.10, 0.32, 0.16), (0.40, 0.55, 0.25)), scale=0.03, axis="z")
    reed = SolidTexture(pattern="checker", colors=((0.62, 0.46, 0.26), (0.40, 0.26, 0.13)), scale=0.036)
    veins = SolidTexture(pattern="marble", colors=((0.78, 0.76, 0.72), (0.35, 0.33, 0.36)), scale=0.12)
    dots = SolidTexture(pattern="speckle", colors=((0.80, 0.36, 0.30), (0.88, 0.82, 0.70)), scale=0.035)
    angles = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    rings = [
        moved(lathe([(0.135 + 0.012 * np.cos(a), 0.012 * np.sin(a)) for a in angles], segments=56), (0, 0, 0.0125 + z))
        for z in 0.021 * np.arange(8)
    ]
    basket = merged([*rings, moved(cylinder(0.132, 0.012), (0, 0, 0.004))])
    teal = Plastic(color=(0.10, 0.36, 0.46), roughness=0.12)
    bowl_side = filleted([(0, 0, 0), (0.034, 0, 0.004), (0.080, 0.055, 0.05), (0.086, 0.075, 0)], segments=8)
    things = [
        _on_board("cactus", moved(deformed(ball(0.05), _ribbed), (0, 0, 0.0)), Plastic(color=ribs), 0.10, 0.20, 1),
        _on_board("basket", basket, Diffuse(color=reed), -0.30, 0.21, 0),
        _on_board("bowl", lathe(walled(bowl_side, wall=0.005, floor=0.006)), Plastic(color=veins), 0.42, 0.20, 2),
        _on_board("box", rounded_box((0.30, 0.20, 0.16), bevel=0.012), Plastic(color=dots), 0.25, 0.22, 0),
        SceneObject(name="can", mesh=moved(_watering_can(), (-0.88, -0.10, GAP)), material=teal),
    ]
    x = -0.50
    for name, size, color, lean in (
        ("book_ochre", (0.034, 0.15, 0.22), (0.74, 0.48, 0.12), 0.0),
        ("book_navy", (0.026, 0.14, 0.20), (0.08, 0.14, 0.34), 0.0),
        ("book_brick", (0.040, 0.16, 0.24), (0.56, 0.15, 0.10), 0.0),
        ("book_cream", (0.028, 0.14, 0.21), (0.74, 0.68, 0.54), -14.0),
    ):
        book = turned(rounded_box(size, bevel=0.002), (0, 1, 0), lean)
        width = float(np.ptp(book.vertices[:, 0]))
        things.append(_on_board(name, book, Diffuse(color=color), x + width / 2, 0.19, 1))
        x += width + 2 * GAP
    return things


def _ribbed(p: np.ndarray) -> np.ndarray:
    """A ball of radius 5 cm as a cactus: taller than wide, with twelve soft ribs."""
    around = np.arctan2(p[:, 1], p[:, 0])
    slim = np.hypot(p[:, 0], p[:, 1]) / 0.05
    ribs = 1 + 0.10 * slim * np.cos(12 * around)
    return np.stack([p[:, 0] * ribs, p[:, 1] * ribs, 1.7 * p[:, 2]], axis=-1)


def _watering_can() -> Mesh:
    body = filleted([(0, 0, 0), (0.105, 0, 0.008), (0.085, 0.20, 0)], segments=4)
    spout = curved([(0.085, 0, 0.06), (0.16, 0, 0.11), (0.20, 0, 0.20), (0.26, 0, 0.245)], count=20)
    handle = curved(
        [(-0.0835, 0, 0.18), (-0.13, 0, 0.23), (-0.20, 0, 0.17), (-0.16, 0, 0.07), (-0.099, 0, 0.05)], count=28
    )
    vessel = lathe(walled(body, wall=0.005, floor=0.006), segments=72)
    return turned(merged([vessel, tube(spout, np.linspace(0.019, 0.011, 20)), tube(handle, 0.008)]), (0, 0, 1), -35)


def _on_board(name: str, mesh: Mesh, material: Material, x: float, y: float, level: int) -> SceneObject:
    """An object on one of the boards."""
    return put_on(LEVELS[level], name, mesh, material, x, y)
