"""What is around the things of a random scene: what they stand on, a room or a landscape, and the light.

Three kinds: two walls of a room that cameras look into; a round or square screen with a pattern all around, open at
its top; and nothing but a ground in a drawn map of the environment.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.description import EnvironmentMap, SceneObject
from datagen.scene.materials import Diffuse, Plastic
from datagen.scene.modelling import cylinder, lathe, moved, rounded_box
from datagen.scene.procedural.chance import between, happens, pick, weigh
from datagen.scene.procedural.names import Family
from datagen.scene.procedural.patterns import color_pair, pattern, wood
from datagen.scene.procedural.sections import corners_of, polygon
from datagen.scene.procedural.skies import SKIES, draw_cards, draw_sky
from datagen.scene.textures import SolidTexture

GAP = 0.001
"""Metres between things that stand on each other."""
SKY_PATH = "maps/environment.exr"


class Light(TypedDict):
    """The map of the environment, and its file."""

    environment: EnvironmentMap
    files: Mapping[str, bytes]


@dataclass(frozen=True, kw_only=True, eq=False)
class Backdrop:
    """All of a scene but the things that stand in it."""

    words: str
    objects: tuple[SceneObject, ...]
    environment: EnvironmentMap
    files: Mapping[str, bytes]
    """The map of the environment, by its path."""
    azimuth_deg: tuple[float, float] = (0.0, 360.0)
    """Where cameras may stand."""


def draw_backdrop(family: Family, *, extent: float, radius: float, rng: np.random.Generator) -> Backdrop:
    """A backdrop for things on z = 0.

    Args:
        extent: metres that the things reach from the z axis.
        radius: metres from the cameras to the things.
    """
    support, below = _support(family, extent, radius, rng)
    kind = weigh({"room": 0.3, "screen": 0.35, "open": 0.35}, rng=rng)
    match kind:
        case "room":
            around = _room(radius, below, rng)
        case "screen":
            around = _screen(radius, below, rng)
        case _:
            around = _open(radius, below, rng)
    return dataclasses.replace(around, objects=(*support, *around.objects))


# What things stand on


def _support(family: Family, extent: float, radius: float, rng: np.random.Generator) -> tuple[list[SceneObject], float]:
    """A table, a plinth, or nothing but the floor; and the height of the floor."""
    kind = {
        "object": {"floor": 0.5, "plinth": 0.5},
        "table": {"table": 1.0},
        "nested": {"table": 0.6, "floor": 0.4},
    }[family]
    top = max(0.03, round(extent, 3))
    match weigh(kind, rng=rng):
        case "floor":
            return [], -GAP
        case "plinth":
            height = 0.6 * radius
            wide = 2.0 * (1.25 * top + 0.03)
            material = Plastic(color=_ground_pattern(0.2 * radius, -GAP, rng), roughness=0.25)
            block = moved(rounded_box((wide, wide, height), bevel=0.006), (0, 0, -GAP - height / 2))
            return [SceneObject(name="plinth", mesh=block, material=material)], -2 * GAP - height
        case _:
            height = 0.9 * radius
            return _table(1.15 * top + 0.08, height, rng), -3 * GAP - height


def _table(half: float, height: float, rng: np.random.Generator) -> list[SceneObject]:
    """A top, round or square, on one leg."""
    thick = 0.03
    texture = wood(between(0.03, 0.09, rng=rng), rng=rng) if happens(0.5, rng=rng) else _ground_pattern(0.08, -GAP, rng)
    if happens(0.5, rng=rng):
        top = moved(cylinder(1.1 * half, thick, bevel=0.006, segments=96), (0, 0, -GAP - thick))
    else:
        top = moved(rounded_box((2 * half, 2 * half, thick), bevel=0.006), (0, 0, -GAP - thick / 2))
    leg = moved(cylinder(0.3 * half, height - thick - 2 * GAP, top_radius=0.12 * half), (0, 0, -GAP - height))
    return [
        SceneObject(
            name="table", mesh=top, material=Plastic(color=texture, roughness=round(between(0.15, 0.35, rng=rng), 3))
        ),
        SceneObject(name="table_leg", mesh=leg, material=Plastic(color=(0.12, 0.11, 0.10), roughness=0.3)),
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
    floor = SceneObject(
        name="floor",
        mesh=moved(rounded_box((2.6 * far, 2.6 * far, 0.05), bevel=0.004), (0.25 * far, -0.25 * far, below - 0.025)),
        material=Plastic(color=_ground_pattern(0.3 * radius, below, rng), roughness=0.3),
    )
    middle = below + GAP + tall / 2
    # The back wall reaches behind the left one: no camera in the room sees out through the corner.
    back = moved(rounded_box((2.6 * far, 0.06, tall), bevel=0.004), (0.25 * far, far + 0.03, middle))
    left = moved(
        rounded_box((0.06, 2.55 * far - GAP, tall), bevel=0.004), (-far - 0.03, -0.275 * far - GAP / 2, middle)
    )
    paper = pattern(between(0.2, 0.4, rng=rng) * radius, rng=rng)
    plain = _muted(pick(color_pair(rng=rng), rng=rng))
    papers = [paper, plain] if happens(0.5, rng=rng) else [plain, paper]
    size = 1.1 * radius
    panel = moved(rounded_box((size, 0.02, size), bevel=0.004), (-0.2 * far, far - 0.03, below + 0.02 + size / 2))
    art = pattern(between(0.16, 0.3, rng=rng) * radius, rng=rng)
    return Backdrop(
        words="in the corner of a room",
        objects=(
            floor,
            SceneObject(name="wall_back", mesh=back, material=Diffuse(color=papers[0])),
            SceneObject(name="wall_left", mesh=left, material=Diffuse(color=papers[1])),
            SceneObject(name="panel", mesh=panel, material=Plastic(color=art, roughness=0.2)),
        ),
        azimuth_deg=(-150.0, 60.0),
        **_lit_by_cards(rng),
    )


def _screen(radius: float, below: float, rng: np.random.Generator) -> Backdrop:
    """A floor inside a screen with a pattern, round or square, that is open to the sky."""
    far, tall = 2.0 * radius, between(1.1, 1.4, rng=rng) * radius - below
    sides = pick((4, 6, 96, 96), rng=rng)
    outline = [(far, below + GAP), (far + 0.03, below + GAP), (far + 0.03, below + tall), (far, below + tall)]
    wall = lathe(outline, segments=corners_of(sides), crease_deg=20, around=polygon(sides))
    scale = round(between(0.25, 0.45, rng=rng) * radius, 4)
    texture = dataclasses.replace(pattern(scale, rng=rng), origin=(0.0, 0.0, below))
    return Backdrop(
        words="inside a patterned screen",
        objects=(
            _disc("floor", 1.5 * far, below, Plastic(color=_ground_pattern(0.3 * radius, below, rng), roughness=0.3)),
            SceneObject(name="screen", mesh=wall, material=Diffuse(color=texture)),
        ),
        **_lit_by_cards(rng),
    )


def _open(radius: float, below: float, rng: np.random.Generator) -> Backdrop:
    """A ground with a pattern that ends in a drawn map of the environment."""
    shows = pick(tuple(SKIES), rng=rng)
    exr = draw_sky(shows, rng=rng)
    ground = Plastic(color=_ground_pattern(between(0.16, 0.3, rng=rng) * radius, below, rng), roughness=0.3)
    return Backdrop(
        words=f"in a {shows}",
        objects=(_disc("ground", 2.2 * radius, below, ground),),
        environment=EnvironmentMap(path=SKY_PATH, rotation_deg=round(between(0, 360, rng=rng), 1)),
        files={SKY_PATH: exr},
    )


def _disc(name: str, radius: float, top: float, material: Plastic) -> SceneObject:
    mesh: Mesh = moved(cylinder(radius, 0.04, bevel=0.006, segments=128), (0, 0, top - 0.04))
    return SceneObject(name=name, mesh=mesh, material=material)


def _lit_by_cards(rng: np.random.Generator) -> Light:
    """Bright cards above, which the open top of a room lets in, and glass mirrors."""
    return {
        "environment": EnvironmentMap(path=SKY_PATH, rotation_deg=round(between(0, 360, rng=rng), 1)),
        "files": {SKY_PATH: draw_cards(rng=rng)},
    }


def _muted(color: tuple[float, float, float]) -> tuple[float, float, float]:
    """A wall's colour: half way to a middle grey."""
    red, green, blue = (round(0.5 * channel + 0.5 * 0.4, 3) for channel in color)
    return red, green, blue
