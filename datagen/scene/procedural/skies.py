"""Maps of the environment that are drawn: a photographer's studio, a hall with windows, a landscape under clouds.

Glass reads as glass by what it shows of its surroundings: bright cards with hard edges, dark flags between them, and
colours at the height of the eye that its refraction turns upside down.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from datagen.data.images import encode_float_exr
from datagen.scene.procedural.chance import between
from datagen.scene.procedural.patterns import color_pair
from datagen.scene.solid_textures import fractal_noise

HEIGHT = 256
"""Rows; a map is twice as wide."""

Radiance = Float[np.ndarray, "h w 3"]
Directions = Float[np.ndarray, "h w 3"]
Shows = Callable[[Directions, np.random.Generator], Radiance]


def draw_sky(shows: str, *, rng: np.random.Generator) -> bytes:
    """The EXR of one of the SKIES; white paper that lies in the open has a radiance of 0.8 to 1 below it."""
    return _exr(SKIES[shows], between(0.8, 1.0, rng=rng), rng)


def draw_cards(*, rng: np.random.Generator) -> bytes:
    """The EXR of what lights a room through its open top: bright cards in a dim dome."""
    return _exr(_cards_overhead, between(1.3, 1.6, rng=rng), rng)


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
    roll = _step(np.sin(cells * (azimuth + between(0, 6, rng=rng))), 0.04)[..., None]
    # Below the horizon, too: there a camera that looks down sees it behind the ground.
    paper = _step(np.radians(between(16, 26, rng=rng)) - elevation, 0.03)[..., None]
    canvas = 0.8 + 0.7 * (_noise(d, 9, rng) - 0.5)[..., None]
    return paper * canvas * 1.1 * (roll * first + (1 - roll) * second) + _cards(d, rng)


def _cards(d: Directions, rng: np.random.Generator) -> Radiance:
    """Bright rectangles, warm and cool, and one overhead; a dim dome behind them."""
    azimuth, elevation = _angles(d)
    radiance = np.full(d.shape, 0.5)
    count = int(rng.integers(3, 6))
    start = between(0, 2 * np.pi, rng=rng)
    for number in range(count):
        warm = between(-0.14, 0.14, rng=rng)
        middle = start + 2 * np.pi * (number + between(-0.3, 0.3, rng=rng)) / count
        half, tall = np.radians(between(18, 34, rng=rng)), np.radians(between(30, 48, rng=rng))
        bottom = np.radians(between(24, 36, rng=rng))
        across = half - np.abs((azimuth - middle + np.pi) % (2 * np.pi) - np.pi)
        card = _step(across, 0.015) * _step(elevation - bottom, 0.015) * _step(bottom + tall - elevation, 0.015)
        radiance = radiance + card[..., None] * between(3, 7, rng=rng) * np.array([1 + warm, 1, 1 - warm])
    overhead = _step(d[..., 2] - between(0.94, 0.98, rng=rng), 0.01)[..., None]
    return radiance + overhead * between(3, 6, rng=rng)


def _cards_overhead(d: Directions, rng: np.random.Generator) -> Radiance:
    """Cards, and nothing where the floor of a room would hide it: the path tracer aims at no light in vain."""
    return _cards(d, rng) * _step(d[..., 2] + 0.45, 0.1)[..., None]


def _hall(d: Directions, rng: np.random.Generator) -> Radiance:
    """A room with rows of windows in two of its walls, their bars dark against the light."""
    azimuth, elevation = _angles(d)
    wall, dado = (np.array(color) for color in color_pair(rng=rng))
    radiance = (0.6 + 0.3 * _noise(d, 5, rng))[..., None] * wall
    low = _step(np.radians(between(4, 10, rng=rng)) - elevation, 0.02)[..., None]
    panels = 0.5 + 0.5 * _step(np.sin(14 * azimuth), 0.1)[..., None]
    radiance = (1 - low) * radiance + low * 0.5 * panels * dado
    start, bars = between(0, 2 * np.pi, rng=rng), int(rng.integers(3, 6))
    for side in range(2):
        turned = (azimuth - start - side * between(1.7, 2.6, rng=rng) + np.pi) % (2 * np.pi) - np.pi
        u, v = turned / np.radians(between(32, 46, rng=rng)), (elevation - np.radians(14)) / np.radians(42)
        inside = _step(1 - np.abs(u), 0.02) * _step(v, 0.02) * _step(1 - v, 0.02)
        panes = _step(np.abs(np.sin(np.pi * bars * (u + 1) / 2)) - 0.12, 0.04) * _step(
            np.abs(np.sin(np.pi * 2 * v)) - 0.1, 0.04
        )
        outside = np.array([0.75, 0.9, 1.1]) * (0.6 + 0.6 * v[..., None])
        radiance = radiance * (1 - inside[..., None]) + (inside * panes)[..., None] * between(4, 8, rng=rng) * outside
    ceiling = _step(elevation - np.radians(62), 0.03)[..., None]
    return (1 - ceiling) * radiance + ceiling * 0.8


def _landscape(d: Directions, rng: np.random.Generator) -> Radiance:
    """Hills below clouds and a hazy sun."""
    azimuth, elevation = _angles(d)
    up = np.clip(d[..., 2], 0, 1)[..., None]
    clear = np.array([0.16, 0.34, 0.8]) * up**0.5 + np.array([0.85, 0.88, 0.9]) * (1 - up) ** 3
    clouds = np.clip((_noise(d / (0.25 + up), 2.4, rng, octaves=6) - 0.48) * 5, 0, 1)[..., None]
    radiance = clear * (1 - clouds) + clouds * np.array([1.15, 1.12, 1.08])
    sun_height, sun_azimuth = np.radians(between(25, 60, rng=rng)), between(0, 2 * np.pi, rng=rng)
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


SKIES: dict[str, Shows] = {
    "studio": _studio,
    "hall": _hall,
    "landscape": _landscape,
}


def _angles(d: Directions) -> tuple[np.ndarray, np.ndarray]:
    return np.arctan2(d[..., 1], d[..., 0]), np.arcsin(np.clip(d[..., 2], -1, 1))


def _step(x: np.ndarray, width: float) -> np.ndarray:
    """From 0 to 1 around x = 0, over so much."""
    return np.clip(x / width + 0.5, 0, 1)


def _noise(d: np.ndarray, frequency: float, rng: np.random.Generator, *, octaves: int = 4) -> np.ndarray:
    """Clouds of noise over directions, others each time."""
    return fractal_noise(frequency * d + rng.uniform(0, 100, 3), octaves=octaves)


def _exr(shows: Shows, paper: float, rng: np.random.Generator) -> bytes:
    """A map in which white paper has this radiance, of half precision: it compresses better, and no more is seen."""
    directions = map_directions(HEIGHT)
    radiance = np.maximum(shows(directions, rng), 0)
    radiance *= paper / paper_radiance(radiance, directions)
    planes = radiance.astype(np.float16).astype(np.float32)
    return encode_float_exr({name: planes[..., place] for place, name in enumerate("RGB")})
