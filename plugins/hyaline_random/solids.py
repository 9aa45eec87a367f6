"""Bodies without a hollow: lenses, prisms, gems, eggs; and stars, knots, rings and turned ones, which are not convex.

Each is about 0.1 m large and stands on z = 0. Bodies that another program would cut out of each other are made whole:
a lens is turned on a lathe, a gem is the hull of its corners, a bubble is a part that is wound inward.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from datagen.data.meshes import normals_of
from datagen.scene.modelling import (
    Around,
    Mesh,
    Points,
    ball,
    curved,
    deformed,
    filleted,
    lathe,
    merged,
    moved,
    rounded_box,
    shaded,
    tube,
    turned,
)
from hyaline_random.chance import pick
from hyaline_random.things import standing

ROUND = 96
"""Points around a section that has no corners."""


def _upright(radius: Callable[[np.ndarray], np.ndarray]) -> Around:
    """The same section at every height: the factor of the outline's radius by angle."""
    return lambda angles, outline: np.tile(radius(angles), (len(outline), 1))


def polygon(sides: int) -> Around:
    """A regular polygon whose flat sides have the outline's radius; a corner is at angle 0."""
    step = 2 * np.pi / sides
    return _upright(lambda angles: 1 / np.cos(angles % step - step / 2))


def soft_square(power: float) -> Around:
    """A square with round corners (a superellipse): a circle at power 2, sharper with more."""
    return _upright(lambda angles: (np.abs(np.cos(angles)) ** power + np.abs(np.sin(angles)) ** power) ** (-1 / power))


def flutes(count: int, depth: float) -> Around:
    """Round ribs with narrow grooves between them; `depth` is a share of the radius."""
    return _upright(lambda angles: 1 - depth * (1 - np.abs(np.sin(count * angles / 2))))


def star(points: int, depth: float) -> Around:
    """Waves around the axis, like a star with soft points; `depth` is a share of the radius."""
    return _upright(lambda angles: 1 - depth * (0.5 - 0.5 * np.cos(points * angles)))


def outside_only(around: Around, count: int, *, low: float, high: float) -> Around:
    """The section for the first `count` points of an outline, where their height is between `low` and `high`.

    So the outside of a vessel is cut and its inside stays round. The cut fades over a tenth of the height at both ends.
    """
    fade = 0.1 * (high - low)

    def factors(angles: np.ndarray, outline: np.ndarray) -> np.ndarray:
        height = outline[:, 1]
        share = np.clip(np.minimum(height - low, high - height) / fade, 0, 1)
        share = np.where(np.arange(len(outline)) < count, share, 0.0)[:, None]
        return 1 + share * (around(angles, outline) - 1)

    return factors


def corners_of(sides: int) -> int:
    """Points around a polygon: its corners are among them."""
    return sides * max(1, round(ROUND / sides))


def twisted(mesh: Mesh, turns_per_metre: float, *, crease_deg: float) -> Mesh:
    """The mesh turned about z the more, the higher it is."""

    def turn(p: Points) -> Points:
        angle = 2 * np.pi * turns_per_metre * p[:, 2]
        cos, sin = np.cos(angle), np.sin(angle)
        x, y, z = p.T

        return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)

    return deformed(mesh, turn, crease_deg=crease_deg)


FACET_CREASE_DEG = 12.0
"""Crease angle of bodies with flat facets, which also meet at small angles."""

Maker = Callable[[np.random.Generator], Mesh]


# Convex


def _ball(rng: np.random.Generator) -> Mesh:
    return ball(rng.uniform(0.045, 0.06))


def _egg(rng: np.random.Generator) -> Mesh:
    wide, high = rng.uniform(0.034, 0.045), rng.uniform(0.045, 0.06)
    point = rng.uniform(0.0, 0.25)

    def drawn_out(p: Points) -> Points:
        slim = 1 - point * p[:, 2:]
        return np.concatenate([wide * slim * p[:, :2], high * p[:, 2:]], axis=-1)

    return deformed(ball(1.0), drawn_out)


def _soft_cube(rng: np.random.Generator) -> Mesh:
    size = rng.uniform(0.07, 0.085)
    height, bevel = size * rng.uniform(0.8, 1.2), size * rng.uniform(0.06, 0.3)
    cube = rounded_box((size, size, height), bevel=bevel, segments=5)
    return turned(cube, (0, 0, 1), rng.uniform(0, 90))


def _disc(rng: np.random.Generator) -> Mesh:
    radius, height = rng.uniform(0.045, 0.055), rng.uniform(0.03, 0.07)
    soft = rng.uniform(0.003, 0.012)
    return lathe(filleted([(0, 0, 0), (radius, 0, soft), (radius, height, soft), (0, height, 0)], segments=8))


def _cone(rng: np.random.Generator) -> Mesh:
    low, high = rng.uniform(0.045, 0.055), rng.uniform(0.006, 0.03)
    height = rng.uniform(0.08, 0.12)
    return lathe(filleted([(0, 0, 0), (low, 0, 0.004), (high, height, 0.004), (0, height, 0)], segments=6))


def _prism(rng: np.random.Generator) -> Mesh:
    sides = pick((3, 3, 4, 5, 6, 8), rng=rng)
    radius, height = rng.uniform(0.026, 0.036), rng.uniform(0.08, 0.12)
    outline = filleted([(0, 0, 0), (radius, 0, 0.0015), (radius, height, 0.0015), (0, height, 0)], segments=2)
    upright = lathe(outline, segments=corners_of(sides), crease_deg=FACET_CREASE_DEG, around=polygon(sides))
    if sides == 3 and rng.random() < 0.6:  # Lying on a long face, as on an optical bench.
        return turned(turned(turned(upright, (0, 0, 1), 60), (0, 1, 0), 90), (0, 0, 1), rng.uniform(0, 360))
    return upright


def _lens(rng: np.random.Generator) -> Mesh:
    """Two spherical caps back to back, standing on its rim."""
    radius, bulge = rng.uniform(0.045, 0.055), rng.uniform(0.012, 0.024)
    rim = 0.0015
    low = _cap(radius, bulge)
    outline = [(r, -z - rim) for r, z in low] + [(r, z + rim) for r, z in reversed(low)]
    return _on_edge(lathe(outline, crease_deg=30), rng)


def _dome(rng: np.random.Generator) -> Mesh:
    """A magnifier that lies on its flat side."""
    radius, bulge = rng.uniform(0.045, 0.058), rng.uniform(0.02, 0.042)
    cap = [(r, z + 0.003) for r, z in reversed(_cap(radius, bulge))]
    return lathe([*filleted([(0, 0, 0), (radius, 0, 0.001), cap[0] + (0.0,)], segments=3), *cap[1:]], crease_deg=30)


def _gem(rng: np.random.Generator) -> Mesh:
    """A stone of brilliant cut: table, crown, girdle and pavilion, the hull of its corners."""
    sides = pick((6, 8, 8, 10, 12), rng=rng)
    radius = rng.uniform(0.05, 0.06)
    table, crown = rng.uniform(0.5, 0.65), rng.uniform(0.24, 0.36)
    rings = [
        (table * radius, crown * radius, 0.0),
        (0.86 * radius, 0.55 * crown * radius, 0.5),
        (radius, 0.03 * radius, 0.0),
        (radius, -0.03 * radius, 0.0),
        (0.55 * radius, -0.42 * radius, 0.5),
        (0.02 * radius, -rng.uniform(0.7, 0.85) * radius, 0.0),
    ]
    corners = [
        (r * np.cos(a), r * np.sin(a), z)
        for r, z, shift in rings
        for a in 2 * np.pi * (np.arange(sides) + shift) / sides
    ]
    # It stands on its table, or leans to a side as if it lay on its pavilion.
    stone = turned(hull(np.array(corners)), (0, 1, 0), pick((180.0, 40.0), rng=rng))
    return turned(stone, (0, 0, 1), 10)


def _pebble(rng: np.random.Generator) -> Mesh:
    """A block with many flat facets: the hull of points on an ellipsoid."""
    points = rng.normal(size=(int(rng.integers(14, 40)), 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    return hull(points * np.array([0.055, 0.045, 0.045]))


# Not convex


def _ring(rng: np.random.Generator) -> Mesh:
    radius, thick = rng.uniform(0.036, 0.042), rng.uniform(0.011, 0.017)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    torus = lathe(list(zip(radius + thick * np.cos(angle), thick * np.sin(angle))))
    return _on_edge(torus, rng) if rng.random() < 0.5 else torus


def _knot(rng: np.random.Generator) -> Mesh:
    """A torus knot."""
    p, q = pick(((2, 3), (3, 2), (2, 5)), rng=rng)
    loop = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    ring = 0.036 + 0.015 * np.cos(q * loop)
    path = np.stack([ring * np.cos(p * loop), ring * np.sin(p * loop), 0.017 * np.sin(q * loop)], axis=-1)
    knot = tube(path, rng.uniform(0.0055, 0.0075), segments=20, is_loop=True)
    return turned(knot, (1, 0, 0), pick((0.0, 90.0), rng=rng))


def _star_prism(rng: np.random.Generator) -> Mesh:
    """An extruded star with soft points, straight or twisted."""
    height, radius = rng.uniform(0.08, 0.12), rng.uniform(0.038, 0.048)
    points, depth = int(rng.integers(3, 8)), rng.uniform(0.2, 0.42)
    top, bevel = radius * rng.uniform(0.8, 1.0), 0.002
    side = np.stack([np.linspace(radius, top, 24), np.linspace(bevel, height - bevel, 24)], axis=-1)
    outline = [(0.0, 0.0), (radius - bevel, 0.0), *map(tuple, side.tolist()), (top - bevel, height), (0.0, height)]
    mesh = lathe(outline, around=star(points, depth))
    return twisted(mesh, rng.uniform(-4, 4), crease_deg=40)


def _turned_post(rng: np.random.Generator) -> Mesh:
    """A post as a turner makes it: bellies and waists of random widths."""
    count, height = int(rng.integers(3, 6)), rng.uniform(0.10, 0.14)
    radii = [
        rng.uniform(0.026, 0.038) if place % 2 == 0 else rng.uniform(0.010, 0.02) for place in range(2 * count - 1)
    ]
    levels = np.linspace(0, height, len(radii))
    line = curved(list(zip(radii, levels)), count=64)
    line[:, 0] = np.maximum(line[:, 0], 0.006)
    return lathe([(0.0, 0.0), *map(tuple, line.tolist()), (0.0, float(line[-1, 1]))], crease_deg=30)


def _ribbed_ball(rng: np.random.Generator) -> Mesh:
    """A squat melon with ribs."""
    radius, ribs = rng.uniform(0.045, 0.055), int(rng.integers(5, 12))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 40)
    side = np.stack([radius * np.cos(angle), 0.8 * radius * np.sin(angle)], axis=-1)[1:-1]
    outline = [(0.0, -0.8 * radius), *map(tuple, side.tolist()), (0.0, 0.8 * radius)]
    segments = ribs * max(6, round(ROUND / ribs))
    return lathe(outline, segments=segments, around=flutes(ribs, rng.uniform(0.1, 0.25)), crease_deg=50)


def _hollow_lens(rng: np.random.Generator) -> Mesh:
    """A lens thinner in its middle, standing on its rim."""
    radius, dip = rng.uniform(0.045, 0.055), rng.uniform(0.008, 0.014)
    rim = dip + rng.uniform(0.003, 0.006)
    bowl = _cap(radius, dip)
    outline = [(r, z - rim) for r, z in bowl] + [(r, rim - z) for r, z in reversed(bowl)]
    return _on_edge(lathe(outline, crease_deg=30), rng)


def _drilled_block(rng: np.random.Generator) -> Mesh:
    """A soft-edged block with a round hole through it."""
    hole, radius = rng.uniform(0.012, 0.02), rng.uniform(0.038, 0.045)
    height, power = rng.uniform(0.04, 0.08), rng.uniform(3, 8)
    outer = filleted([(hole, 0, 0), (radius, 0, 0.003), (radius, height, 0.003), (hole, height, 0)], segments=4)
    square = soft_square(power)

    def around(angles: np.ndarray, outline: np.ndarray) -> np.ndarray:
        return np.where(outline[:, :1] > hole + 1e-6, square(angles, outline), 1.0)

    return lathe(outer, around=around, crease_deg=35)


def _coil(rng: np.random.Generator) -> Mesh:
    """A helix of glass rod."""
    turns, radius = rng.uniform(2, 4), rng.uniform(0.03, 0.04)
    angle = np.linspace(0, 2 * np.pi * turns, round(48 * turns))
    rise = np.linspace(0, 0.02 * turns + 0.02, len(angle))
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle), rise], axis=-1)
    rod = 0.0075 * np.clip(np.minimum(angle, angle[-1] - angle) / 0.5, 0.35, 1)
    return tube(path, rod, segments=20)


CONVEX: dict[str, Maker] = {
    "ball": _ball,
    "egg": _egg,
    "soft cube": _soft_cube,
    "disc": _disc,
    "cone": _cone,
    "prism": _prism,
    "lens": _lens,
    "dome": _dome,
    "gem": _gem,
    "pebble": _pebble,
}
NOT_CONVEX: dict[str, Maker] = {
    "ring": _ring,
    "knot": _knot,
    "star": _star_prism,
    "turned post": _turned_post,
    "ribbed ball": _ribbed_ball,
    "hollow lens": _hollow_lens,
    "drilled block": _drilled_block,
    "coil": _coil,
}
CUT = ("prism", "gem", "pebble")
"""Those with flat facets."""


def make_solid(name: str, *, rng: np.random.Generator) -> Mesh:
    """A body of this name, standing."""
    return standing({**CONVEX, **NOT_CONVEX}[name](rng))


def hull(points: np.ndarray) -> Mesh:
    """The convex hull of points, with sharp edges."""
    from scipy.spatial import ConvexHull

    found = ConvexHull(points)
    faces = found.simplices
    is_outward = np.einsum("fc,fc->f", normals_of(points[faces]), found.equations[:, :3]) > 0
    faces = np.where(is_outward[:, None], faces, faces[:, ::-1])
    return shaded(points.astype(np.float64), faces, crease_deg=1.0)


def with_bubbles(mesh: Mesh, *, rng: np.random.Generator) -> Mesh:
    """The body with round holes full of air near its middle."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    size = float((mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)).min())
    bubbles = []
    for place in range(int(rng.integers(3, 9))):
        # Each in a shell of its own cell of a small grid, so that none meets another.
        cell = np.array([place % 2, place // 2 % 2, place // 4 % 2]) - 0.5
        radius = size * rng.uniform(0.03, 0.075)
        offset = cell * 0.26 * size + rng.uniform(-0.03, 0.03, 3) * size
        bubble = moved(ball(radius, subdivisions=3), middle + offset)
        bubbles.append(dataclasses.replace(bubble, faces=bubble.faces[:, ::-1].copy(), normals=-bubble.normals))
    return merged([mesh, *bubbles])


def _cap(radius: float, height: float, *, count: int = 20) -> list[tuple[float, float]]:
    """A cap of a sphere from its top on the axis (0, height) down to its rim (radius, 0)."""
    sphere = (radius**2 + height**2) / (2 * height)
    angle = np.linspace(0, np.arctan2(radius, sphere - height), count)
    points = [(float(sphere * np.sin(a)), float(sphere * np.cos(a) - sphere + height)) for a in angle]
    return [(0.0, height), *points[1:-1], (radius, 0.0)]


def _on_edge(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """A flat body put upright, turned to any side."""
    return turned(turned(mesh, (1, 0, 0), 90), (0, 0, 1), rng.uniform(0, 360))
