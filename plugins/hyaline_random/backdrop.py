"""What is around the things of a random scene: what they are placed on, a room or a landscape, and the light.

Three kinds: two walls of a room that cameras look into; a round or square screen with a pattern all around, open at
its top; and nothing but a ground in a drawn map of the environment.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from datagen.data.images import encode_float_exr
from datagen.scene.description import Environment, EnvironmentMap, RectangleLight, SceneObject, SoftEnvironment
from datagen.scene.materials import Diffuse, Plastic, SolidTexture, as_vector
from datagen.scene.modelling import cylinder, lathe, moved, rounded_box
from datagen.scene.textures import fractal_noise
from hyaline_random.chance import color_pair, pattern, pick, weigh, wood
from hyaline_random.solids import corners_of, polygon
from hyaline_random.things import part

Support = Literal["floor", "plinth", "table"]

GAP = 0.001
"""Metres between stacked things."""
SKY_PATH = "maps/environment.exr"
DUSK = SoftEnvironment(zenith=(0.2, 0.2, 0.24), horizon=(0.3, 0.28, 0.26), ground=(0.1, 0.1, 0.1))
"""The sky beside lamps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Backdrop:
    """All of a scene except its things."""

    words: str
    objects: tuple[SceneObject, ...]
    environment: Environment
    sky: bytes
    """The map of the environment, an EXR; not used beside lamps."""
    lamps: tuple[RectangleLight, ...] = ()
    azimuth_deg: tuple[float, float] = (0.0, 360.0)
    """Where cameras may be."""


def draw_backdrop(
    stands_on: Mapping[Support, float], *, lamps: bool, extent: float, radius: float, rng: np.random.Generator
) -> Backdrop:
    """A backdrop for things on z = 0.

    Args:
        stands_on: what the things may stand on, and how often.
        lamps: lamps light the things in the dusk, instead of a sky.
        extent: metres that the things reach from the z axis.
        radius: metres from the cameras to the things.
    """
    support, below = _support(stands_on, extent, radius, rng)
    kind = weigh({"room": 0.3, "screen": 0.35, "open": 0.0 if lamps else 0.35}, rng=rng)
    around = {"room": _room, "screen": _screen, "open": _open}[kind](radius, below, rng)
    if lamps:
        words = f"{around.words} under lamps"
        around = dataclasses.replace(around, words=words, environment=DUSK, lamps=_lamps(radius, rng))
    return dataclasses.replace(around, objects=(*support, *around.objects))


def _lamps(radius: float, rng: np.random.Generator) -> tuple[RectangleLight, ...]:
    """Two rectangles above all cameras' sight that face the things, and together light white paper to 0.6."""
    lamps, start = [], rng.uniform(0, 2 * np.pi)
    for angle in (start, start + rng.uniform(1.5, 4.5)):
        away, height = rng.uniform(0.3, 0.8) * radius, rng.uniform(1.6, 1.9) * radius
        middle = np.array([away * np.cos(angle), away * np.sin(angle), height])
        across = np.array([np.sin(angle), -np.cos(angle), 0.0])
        distance = float(np.linalg.norm(middle))
        u, v = (rng.uniform(0.5, 0.9) * radius * side for side in (across, np.cross(across, middle / distance)))
        # Paper at the origin has the lamp's radiance times its solid angle and the cosine, by pi.
        bright = 0.3 * np.pi * distance**3 / (height * float(np.linalg.norm(u) * np.linalg.norm(v)))
        corner, edge_u, edge_v = map(as_vector, np.round([middle - (u + v) / 2, u, v], 4))
        lamps.append(RectangleLight(corner=corner, edge_u=edge_u, edge_v=edge_v, radiance=(bright, bright, bright)))
    return tuple(lamps)


# Below the things


def _support(
    stands_on: Mapping[Support, float], extent: float, radius: float, rng: np.random.Generator
) -> tuple[list[SceneObject], float]:
    """A table, a plinth, or nothing but the floor; and the height of the floor."""
    top = max(0.03, round(extent, 3))
    match weigh(stands_on, rng=rng):
        case "floor":
            return [], -GAP
        case "plinth":
            height = 0.6 * radius
            wide = 2.0 * (1.25 * top + 0.03)
            material = Plastic(color=_ground_pattern(0.2 * radius, -GAP, rng), roughness=0.25)
            block = moved(rounded_box((wide, wide, height), bevel=0.006), (0, 0, -GAP - height / 2))
            return [part("plinth", block, material)], -2 * GAP - height
        case _:
            height = 0.9 * radius
            return _table(1.15 * top + 0.08, height, rng), -3 * GAP - height


def _table(half: float, height: float, rng: np.random.Generator) -> list[SceneObject]:
    """A top, round or square, on one leg."""
    thick = 0.03
    texture = wood(rng.uniform(0.03, 0.09), rng=rng) if rng.random() < 0.5 else _ground_pattern(0.08, -GAP, rng)
    if rng.random() < 0.5:
        top = moved(cylinder(1.1 * half, thick, bevel=0.006, segments=96), (0, 0, -GAP - thick))
    else:
        top = moved(rounded_box((2 * half, 2 * half, thick), bevel=0.006), (0, 0, -GAP - thick / 2))
    leg = moved(cylinder(0.3 * half, height - thick - 2 * GAP, top_radius=0.12 * half), (0, 0, -GAP - height))
    return [
        part("table", top, Plastic(color=texture, roughness=round(rng.uniform(0.15, 0.35), 3))),
        part("table_leg", leg, Plastic(color=(0.12, 0.11, 0.10), roughness=0.3)),
    ]


def _ground_pattern(scale: float, height: float, rng: np.random.Generator) -> SolidTexture:
    """A pattern that begins at the height of a level surface, so that none of its edges lies in it."""
    texture = pattern(scale, rng=rng)
    axis = "x" if texture.axis == "z" else texture.axis
    return dataclasses.replace(texture, axis=axis, origin=(0.0, 0.0, round(height, 4)))


# What is behind them


def _room(radius: float, below: float, rng: np.random.Generator) -> Backdrop:
    """A floor and two walls that cameras look at, with a picture on each."""
    far, tall = 1.7 * radius, 1.9 * radius - below
    floor = part(
        "floor",
        moved(rounded_box((2.6 * far, 2.6 * far, 0.05), bevel=0.004), (0.25 * far, -0.25 * far, below - 0.025)),
        Plastic(color=_ground_pattern(0.3 * radius, below, rng), roughness=0.3),
    )
    middle = below + GAP + tall / 2
    # The back wall reaches behind the left one: no camera in the room sees out through the corner.
    back = moved(rounded_box((2.6 * far, 0.06, tall), bevel=0.004), (0.25 * far, far + 0.03, middle))
    left = moved(
        rounded_box((0.06, 2.55 * far - GAP, tall), bevel=0.004), (-far - 0.03, -0.275 * far - GAP / 2, middle)
    )
    paper = pattern(rng.uniform(0.2, 0.4) * radius, rng=rng)
    red, green, blue = (round(0.5 * channel + 0.5 * 0.4, 3) for channel in pick(color_pair(rng=rng), rng=rng))
    plain = red, green, blue  # Half way to a middle grey.
    papers = [paper, plain] if rng.random() < 0.5 else [plain, paper]
    size = 1.1 * radius
    panel = moved(rounded_box((size, 0.02, size), bevel=0.004), (-0.2 * far, far - 0.03, below + 0.02 + size / 2))
    art = pattern(rng.uniform(0.16, 0.3) * radius, rng=rng)
    return Backdrop(
        words="in the corner of a room",
        objects=(
            floor,
            part("wall_back", back, Diffuse(color=papers[0])),
            part("wall_left", left, Diffuse(color=papers[1])),
            part("panel", panel, Plastic(color=art, roughness=0.2)),
        ),
        azimuth_deg=(-150.0, 60.0),
        environment=_turned_sky(rng),
        sky=_exr(_cards_overhead, rng.uniform(1.3, 1.6), rng),
    )


def _screen(radius: float, below: float, rng: np.random.Generator) -> Backdrop:
    """A floor inside a screen with a pattern, round or square, that is open to the sky."""
    far, tall = 2.0 * radius, rng.uniform(1.1, 1.4) * radius - below
    sides = pick((4, 6, 96, 96), rng=rng)
    outline = [(far, below + GAP), (far + 0.03, below + GAP), (far + 0.03, below + tall), (far, below + tall)]
    wall = lathe(outline, segments=corners_of(sides), crease_deg=20, around=polygon(sides))
    scale = round(rng.uniform(0.25, 0.45) * radius, 4)
    texture = dataclasses.replace(pattern(scale, rng=rng), origin=(0.0, 0.0, below))
    return Backdrop(
        words="inside a patterned screen",
        objects=(
            _disc("floor", 1.5 * far, below, Plastic(color=_ground_pattern(0.3 * radius, below, rng), roughness=0.3)),
            part("screen", wall, Diffuse(color=texture)),
        ),
        environment=_turned_sky(rng),
        sky=_exr(_cards_overhead, rng.uniform(1.3, 1.6), rng),
    )


def _open(radius: float, below: float, rng: np.random.Generator) -> Backdrop:
    """A ground with a pattern that ends in a drawn map of the environment."""
    shows = pick(tuple(SKIES), rng=rng)
    sky = draw_sky(shows, rng=rng)
    ground = Plastic(color=_ground_pattern(rng.uniform(0.16, 0.3) * radius, below, rng), roughness=0.3)
    return Backdrop(
        words=f"in a {shows}",
        objects=(_disc("ground", 2.2 * radius, below, ground),),
        environment=_turned_sky(rng),
        sky=sky,
    )


def _disc(name: str, radius: float, top: float, material: Plastic) -> SceneObject:
    mesh = moved(cylinder(radius, 0.04, bevel=0.006, segments=128), (0, 0, top - 0.04))
    return part(name, mesh, material)


def _turned_sky(rng: np.random.Generator) -> EnvironmentMap:
    return EnvironmentMap(path=SKY_PATH, rotation_deg=round(rng.uniform(0, 360), 1))


HEIGHT = 256
"""Rows; a map is twice as wide."""

Radiance = Float[np.ndarray, "h w 3"]
Directions = Float[np.ndarray, "h w 3"]
Shows = Callable[[Directions, np.random.Generator], Radiance]


def draw_sky(shows: str, *, rng: np.random.Generator) -> bytes:
    """The EXR of one of the SKIES; white paper that lies in the open has a radiance of 0.8 to 1 below it."""
    return _exr(SKIES[shows], rng.uniform(0.8, 1.0), rng)


def map_directions(height: int) -> Directions:
    """Unit directions of the pixels of a map, +z up; see `EnvironmentMap`."""
    azimuth = (0.5 - (np.arange(2 * height) + 0.5) / (2 * height)) * 2 * np.pi
    polar = ((np.arange(height) + 0.5) / height * np.pi)[:, None]
    return np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)), axis=-1
    )


def paper_radiance(radiance: Radiance, directions: Directions) -> float:
    """Radiance, averaged over the channels, of a level white sheet in this light."""
    height = len(radiance)
    polar = (np.arange(height) + 0.5) / height * np.pi
    solid_angle = (np.sin(polar) * (np.pi / height) ** 2)[:, None]
    return float((radiance.mean(axis=-1) * np.maximum(directions[..., 2], 0) * solid_angle).sum() / np.pi)


def _studio(d: Directions, rng: np.random.Generator) -> Radiance:
    """Rolls of coloured paper around, bright cards and dark flags above."""
    azimuth, elevation = _angles(d)
    first, second = (np.array(color) for color in color_pair(rng=rng))
    cells = int(rng.integers(5, 13))
    roll = _step(np.sin(cells * (azimuth + rng.uniform(0, 6))), 0.04)[..., None]
    # Below the horizon, too: there a camera that looks down sees it behind the ground.
    paper = _step(np.radians(rng.uniform(16, 26)) - elevation, 0.03)[..., None]
    canvas = 0.8 + 0.7 * (_noise(d, 9, rng) - 0.5)[..., None]
    return paper * canvas * 1.1 * (roll * first + (1 - roll) * second) + _cards(d, rng)


def _cards(d: Directions, rng: np.random.Generator) -> Radiance:
    """Bright rectangles, warm and cool, and one overhead; a dim dome behind them."""
    azimuth, elevation = _angles(d)
    radiance = np.full(d.shape, 0.5)
    count = int(rng.integers(3, 6))
    start = rng.uniform(0, 2 * np.pi)
    for number in range(count):
        warm = rng.uniform(-0.14, 0.14)
        middle = start + 2 * np.pi * (number + rng.uniform(-0.3, 0.3)) / count
        half, tall = np.radians(rng.uniform(18, 34)), np.radians(rng.uniform(30, 48))
        bottom = np.radians(rng.uniform(24, 36))
        across = half - np.abs((azimuth - middle + np.pi) % (2 * np.pi) - np.pi)
        card = _step(across, 0.015) * _step(elevation - bottom, 0.015) * _step(bottom + tall - elevation, 0.015)
        radiance = radiance + card[..., None] * rng.uniform(3, 7) * np.array([1 + warm, 1, 1 - warm])
    overhead = _step(d[..., 2] - rng.uniform(0.94, 0.98), 0.01)[..., None]
    return radiance + overhead * rng.uniform(3, 6)


def _cards_overhead(d: Directions, rng: np.random.Generator) -> Radiance:
    """Cards, and nothing where the floor of a room would hide it: the path tracer aims at no light in vain."""
    return _cards(d, rng) * _step(d[..., 2] + 0.45, 0.1)[..., None]


def _hall(d: Directions, rng: np.random.Generator) -> Radiance:
    """A room with rows of windows in two of its walls, their bars dark against the light."""
    azimuth, elevation = _angles(d)
    wall, dado = (np.array(color) for color in color_pair(rng=rng))
    radiance = (0.6 + 0.3 * _noise(d, 5, rng))[..., None] * wall
    low = _step(np.radians(rng.uniform(4, 10)) - elevation, 0.02)[..., None]
    panels = 0.5 + 0.5 * _step(np.sin(14 * azimuth), 0.1)[..., None]
    radiance = (1 - low) * radiance + low * 0.5 * panels * dado
    start, bars = rng.uniform(0, 2 * np.pi), int(rng.integers(3, 6))
    for side in range(2):
        turned = (azimuth - start - side * rng.uniform(1.7, 2.6) + np.pi) % (2 * np.pi) - np.pi
        u, v = turned / np.radians(rng.uniform(32, 46)), (elevation - np.radians(14)) / np.radians(42)
        inside = _step(1 - np.abs(u), 0.02) * _step(v, 0.02) * _step(1 - v, 0.02)
        panes = _step(np.abs(np.sin(np.pi * bars * (u + 1) / 2)) - 0.12, 0.04) * _step(
            np.abs(np.sin(np.pi * 2 * v)) - 0.1, 0.04
        )
        outside = np.array([0.75, 0.9, 1.1]) * (0.6 + 0.6 * v[..., None])
        radiance = radiance * (1 - inside[..., None]) + (inside * panes)[..., None] * rng.uniform(4, 8) * outside
    ceiling = _step(elevation - np.radians(62), 0.03)[..., None]
    return (1 - ceiling) * radiance + ceiling * 0.8


def _landscape(d: Directions, rng: np.random.Generator) -> Radiance:
    """Hills below clouds and a hazy sun."""
    azimuth, elevation = _angles(d)
    up = np.clip(d[..., 2], 0, 1)[..., None]
    clear = np.array([0.16, 0.34, 0.8]) * up**0.5 + np.array([0.85, 0.88, 0.9]) * (1 - up) ** 3
    clouds = np.clip((_noise(d / (0.25 + up), 2.4, rng, octaves=6) - 0.48) * 5, 0, 1)[..., None]
    radiance = clear * (1 - clouds) + clouds * np.array([1.15, 1.12, 1.08])
    sun_height, sun_azimuth = np.radians(rng.uniform(25, 60)), rng.uniform(0, 2 * np.pi)
    across = np.cos(sun_height)
    sun = np.array([across * np.cos(sun_azimuth), across * np.sin(sun_azimuth), np.sin(sun_height)])
    radiance = radiance + (np.exp(100 * (d @ sun - 1)) * 16)[..., None] * np.array([1.0, 0.92, 0.78])
    around = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=-1)
    for steep, color in ((0.20, (0.30, 0.42, 0.52)), (0.09, (0.16, 0.34, 0.10))):
        crest = steep * _noise(around, 3.0, rng) - 0.02
        hill = _step(crest - elevation, 0.01)[..., None]
        shade = 0.5 + 1.0 * _noise(d, 14, rng)[..., None]
        radiance = radiance * (1 - hill) + hill * shade * np.array(color)
    # Fields in perspective, as from a hill: stripes that narrow towards the horizon.
    ground = _step(-elevation - 0.01, 0.02)[..., None]
    away = 1 / np.maximum(-d[..., 2], 0.05)
    rows = _step(np.sin(2.2 * away * d[..., 0]) * np.sin(1.3 * away * d[..., 1] + 1), 0.1)[..., None]
    crop, soil = np.array([0.40, 0.48, 0.20]), np.array([0.58, 0.46, 0.30])
    fields = (0.7 + 0.6 * _noise(d, 10, rng)[..., None]) * (rows * crop + (1 - rows) * soil)
    return radiance * (1 - ground) + ground * fields


SKIES: dict[str, Shows] = {"studio": _studio, "hall": _hall, "landscape": _landscape}


def _angles(d: Directions) -> tuple[np.ndarray, np.ndarray]:
    return np.arctan2(d[..., 1], d[..., 0]), np.arcsin(np.clip(d[..., 2], -1, 1))


def _step(x: np.ndarray, width: float) -> np.ndarray:
    """From 0 to 1 around x = 0, over so much."""
    return np.clip(x / width + 0.5, 0, 1)


def _noise(d: np.ndarray, frequency: float, rng: np.random.Generator, *, octaves: int = 4) -> np.ndarray:
    """Clouds of noise over directions, others each time."""
    return fractal_noise(frequency * d + rng.uniform(0, 100, 3), octaves=octaves)


def _exr(shows: Shows, paper: float, rng: np.random.Generator) -> bytes:
    """A map in which white paper has this radiance, in half precision, which compresses better and looks the same."""
    directions = map_directions(HEIGHT)
    radiance = np.maximum(shows(directions, rng), 0)
    radiance *= paper / paper_radiance(radiance, directions)
    planes = radiance.astype(np.float16).astype(np.float32)
    return encode_float_exr({name: planes[..., place] for place, name in enumerate("RGB")})
