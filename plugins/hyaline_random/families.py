"""Families of random scenes: what is in each, how large it is made, and what it stands on.

Media in each other and thin glass: vessels with drinks, ice and stones, cores and shells; panes, cases, baubles.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.description import SceneObject
from datagen.scene.materials import Dielectric, Material, Plastic
from datagen.scene.modelling import (
    ball,
    deformed,
    lathe,
    merged,
    moved,
    rotation,
    rounded_box,
    sheet,
    transformed,
    turned,
)
from hyaline_random.backdrop import Support
from hyaline_random.chance import (
    ICE,
    ICE_PRIORITY,
    clear_ior,
    color_pair,
    drink,
    pane_glass,
    pattern,
    pick,
    solid_glass,
    tint,
    vessel_glass,
    weigh,
)
from hyaline_random.solids import CONVEX, CUT, NOT_CONVEX, corners_of, make_solid, polygon, with_bubbles
from hyaline_random.things import GAP, THINGS, Maker, Thing, enlarged, free_places, part, standing, surface
from hyaline_random.vessels import VESSELS, Vessel

HOSTS = ("ball", "egg", "soft cube", "disc")
"""Bodies that have room for something inside."""
BODIES = *CONVEX, *NOT_CONVEX
STONES = ("ball", "soft cube", "gem", "pebble", "ring", "ribbed ball", "drilled block")
"""Bodies that lie in a drink."""


def empty_vessel(kind: str, *, rng: np.random.Generator) -> Thing:
    """A glass without a drink."""
    vessel = VESSELS[kind](rng)
    return Thing(words=with_article(kind), objects=(_glass(kind, vessel, rng),))


def filled_vessel(kind: str, *, rng: np.random.Generator) -> Thing:
    """A glass with a drink, and in most of the open ones ice or stones."""
    vessel = VESSELS[kind](rng)
    liquid, medium = drink(rng=rng)
    level = vessel.floor + rng.uniform(0.6, 1.0) * (vessel.brim - vessel.floor)
    name = kind.replace(" ", "_")
    objects = [_glass(kind, vessel, rng), part(f"{name}_drink", vessel.drink(level), medium)]
    words = f"{with_article(kind)} of {liquid}"
    if vessel.is_open:
        inside = weigh({"ice": 0.45, "stones": 0.35, "nothing": 0.2}, rng=rng)
        if kind == "tank" or (kind == "jar" and inside == "ice"):
            inside = "stones"
        if inside == "ice":
            objects += _ice(name, vessel, level, rng)
            words += " with ice"
        elif inside == "stones":
            stones, what = _stones(name, vessel, level, rng)
            objects += stones
            words += f" with {what} in it"
    return Thing(words=words, objects=tuple(objects))


def solid(kind: str, *, rng: np.random.Generator) -> Thing:
    """A body of one glass, now and then with bubbles."""
    mesh = make_solid(kind, rng=rng)
    words = with_article(kind)
    if kind in HOSTS and rng.random() < 0.2:
        mesh, words = with_bubbles(mesh, rng=rng), f"{words} with bubbles"
    material = solid_glass(0.05, rng=rng, is_cut=kind in CUT)
    return Thing(words=words, objects=(part(kind.replace(" ", "_"), mesh, material),))


def paperweight(rng: np.random.Generator) -> Thing:
    """A body with another one in its middle: of another glass, of a liquid, or opaque."""
    host = pick(HOSTS, rng=rng)
    mesh = make_solid(host, rng=rng)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    room = 0.62 * float((high - low).min()) / 2
    kind = pick(("ball", "soft cube", "pebble", "knot", "ring", "star", "ribbed ball"), rng=rng)
    core = moved(fitted(make_solid(kind, rng=rng), room), (low + high) / 2)
    material, what = _core(rng)
    name = host.replace(" ", "_")
    objects = part(name, mesh, Dielectric(ior=clear_ior(rng=rng))), part(f"{name}_core", core, material)
    return Thing(words=f"{with_article(host)} around {with_article(kind)} of {what}", objects=objects)


def onion(rng: np.random.Generator) -> Thing:
    """Three balls in each other, of three media."""
    radius = rng.uniform(0.05, 0.06)
    shares = (1.0, rng.uniform(0.68, 0.8), rng.uniform(0.35, 0.5))
    middle = 1.31 if rng.random() < 0.5 else round(rng.uniform(1.6, 1.8), 3)
    media = (
        Dielectric(ior=round(rng.uniform(1.45, 1.55), 3)),
        Dielectric(ior=middle, absorption=tint(radius, rng=rng), priority=1),
        Dielectric(ior=round(rng.uniform(1.45, 1.9), 3), absorption=tint(radius / 2, rng=rng), priority=2),
    )
    objects = tuple(
        part(f"shell_{place}", moved(ball(share * radius), (0, 0, radius)), medium)
        for place, (share, medium) in enumerate(zip(shares, media, strict=True))
    )
    return Thing(words="three balls in each other", objects=objects)


def _glass(kind: str, vessel: Vessel, rng: np.random.Generator) -> SceneObject:
    return part(kind.replace(" ", "_"), vessel.glass(), vessel_glass(vessel.wall, rng=rng))


def _ice(name: str, vessel: Vessel, level: float, rng: np.random.Generator) -> list[SceneObject]:
    """One to three cubes that float, clear of the wall and of each other."""
    room = vessel.inner_radius(level)
    count = int(rng.integers(1, 4))
    # Circles around the cubes fit into the glass: of one, of two and of three.
    away, share = ((0.15, 0.75), (0.5, 0.46), (0.54, 0.42))[count - 1]
    size = share * room / 0.75
    start = rng.uniform(0, 2 * np.pi)
    cubes = []
    for number in range(count):
        angle = start + 2 * np.pi * number / count
        axis = rng.normal(size=3)
        cube = transformed(
            _ice_cube(size),
            rotation((float(axis[0]), float(axis[1]), float(axis[2])), rng.uniform(0, 90)),
            (away * room * np.cos(angle), away * room * np.sin(angle), level - rng.uniform(-0.05, 0.2) * size),
        )
        cubes.append(part(f"{name}_ice_{number}", cube, ICE))
    return cubes


def _ice_cube(size: float) -> Mesh:
    """A cube with soft edges and hollow sides, around the origin; its corners are 0.73 sizes away."""
    cube = rounded_box((size, size, size), bevel=0.2 * size, segments=5)
    return deformed(cube, lambda p: p * (0.90 + 0.16 * np.linalg.norm(p, axis=-1, keepdims=True) / size))


def _stones(name: str, vessel: Vessel, level: float, rng: np.random.Generator) -> tuple[list[SceneObject], str]:
    """Bodies of glass or opaque ones on the vessel's floor: one in a round one, several in a box."""
    count = int(rng.integers(2, 5)) if vessel.is_box else 1
    room = 0.94 * (vessel.outer[-1][0] - vessel.wall) if vessel.is_box else vessel.inner_radius(level)
    size = {1: 0.42, 2: 0.46, 3: 0.42, 4: 0.38}[count] * room
    kinds = [pick(STONES, rng=rng) for _ in range(count)]
    meshes = [standing(fitted(make_solid(kind, rng=rng), size)) for kind in kinds]
    places = [(0.0, 0.0)]
    if count > 1:
        places = _places_in_circle([size] * count, room, rng)
    objects = []
    for number, (mesh, (x, y)) in enumerate(zip(meshes, places, strict=True)):
        material, _ = _core(rng)
        objects.append(part(f"{name}_stone_{number}", moved(mesh, (x, y, vessel.floor + GAP)), material))
    return objects, with_article(kinds[0]) if count == 1 else f"{count} stones"


def _places_in_circle(reaches: list[float], room: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Places of circles within a larger one: drawn, or on a ring where that does not fit."""
    places = free_places(reaches, clearance=0.002, rng=rng)
    if all(np.hypot(x, y) + reach <= room for (x, y), reach in zip(places, reaches, strict=True)):
        return places
    start = rng.uniform(0, 2 * np.pi)
    angles = start + 2 * np.pi * np.arange(len(reaches)) / len(reaches)
    away = room - max(reaches)
    return [(float(away * np.cos(angle)), float(away * np.sin(angle))) for angle in angles]


def _core(rng: np.random.Generator) -> tuple[Material, str]:
    """What something inside of a medium is made of; it displaces the medium."""
    kind = weigh({"colour": 0.4, "glass": 0.4, "light glass": 0.2}, rng=rng)
    if kind == "colour":
        color = pattern(0.012, rng=rng) if rng.random() < 0.6 else pick(color_pair(rng=rng), rng=rng)
        return Plastic(color=color, roughness=0.2), "something opaque"
    if kind == "light glass":
        return Dielectric(ior="ice", absorption=tint(0.04, rng=rng), priority=ICE_PRIORITY), "lighter glass"
    heavy = round(rng.uniform(1.65, 1.9), 3)
    return Dielectric(ior=heavy, absorption=tint(0.03, rng=rng), priority=ICE_PRIORITY), "heavier glass"


def fitted(mesh: Mesh, radius: float) -> Mesh:
    """The mesh around the origin, just as large as a ball of this radius."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    around = moved(mesh, (-float(middle[0]), -float(middle[1]), -float(middle[2])))
    return transformed(around, radius / float(np.linalg.norm(around.vertices, axis=-1).max()) * np.eye(3), (0, 0, 0))


def opaque_thing(rng: np.random.Generator) -> Thing:
    """One of `THINGS`."""
    return THINGS[pick(tuple(THINGS), rng=rng)](rng)


def with_article(name: str) -> str:
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


CELLS = 6, 6
"""Cells of a pane: enough of its points lie inside of whatever it would reach into."""
CORES = ("ball", "soft cube", "gem", "pebble", "knot", "ring", "star", "ribbed ball")
"""Bodies that lie in a bauble."""


def _panes(rng: np.random.Generator) -> Thing:
    """One to three panes, most of them tinted, upright behind each other in a stand."""
    count = int(rng.integers(1, 4))
    wide, tall = rng.uniform(0.05, 0.08), rng.uniform(0.07, 0.11)
    step, height = rng.uniform(0.012, 0.022), 0.014
    deep = step * (count - 1) + 0.03
    stand = moved(rounded_box((2 * wide + 0.012, deep, height), bevel=0.002), (0, 0, height / 2))
    objects = [part("stand", stand, surface(0.02, rng=rng))]
    for number in range(count):
        away = step * (number - (count - 1) / 2)
        # Each a little aside from the one before it, so that one sees them alone and one behind the other.
        aside = rng.uniform(-0.2, 0.2) * wide
        pane = _upright((aside, away, height + GAP), wide - abs(aside), tall * rng.uniform(0.8, 1.0))
        objects.append(part(f"stand_pane_{number}", pane, pane_glass(0.75, rng=rng)))
    return Thing(words=f"{'a pane' if count == 1 else f'{count} panes'} in a stand", objects=tuple(objects))


def _frame(rng: np.random.Generator) -> Thing:
    """A picture frame on its edge, without a picture; its glass lies behind it, as in a real one."""
    inner, bar, thick = rng.uniform(0.035, 0.05), rng.uniform(0.008, 0.014), rng.uniform(0.014, 0.02)
    high = rng.uniform(1.0, 1.4)
    outer, bevel = inner + bar, 0.002
    outline = [(inner, 0.0), (outer - bevel, 0.0), (outer, bevel), (outer, thick - bevel)]
    outline += [(outer - bevel, thick), (inner + bevel, thick), (inner, thick - bevel)]
    square = turned(lathe(outline, segments=corners_of(4), crease_deg=20, around=polygon(4)), (0, 0, 1), 45)
    # Its depth is along z so far; front to -y, and the lower edge on the ground.
    bars = turned(transformed(square, np.diag([1.0, high, 1.0]), (0, 0, 0)), (1, 0, 0), 90)
    half = inner + 0.6 * bar
    pane = _upright((0.0, GAP, high * (outer - half)), half, 2 * high * half)
    frame = part("frame", moved(bars, (0, 0, high * outer)), surface(0.02, rng=rng))
    return Thing(words="an empty picture frame", objects=(frame, part("frame_pane", pane, pane_glass(0.3, rng=rng))))


def glass_case(*, of_glass: bool, rng: np.random.Generator) -> Thing:
    """Five panes that meet at their edges, without a floor, over a body.

    Args:
        of_glass: the body is glass; else it may be an opaque thing.
    """
    body = BODY(rng) if of_glass or rng.random() < 0.4 else opaque_thing(rng)
    half, tall = body.reach + rng.uniform(0.006, 0.015), body.height + rng.uniform(0.008, 0.02)
    inside = tuple(dataclasses.replace(item, name=f"case_{item.name}") for item in body.objects)
    case = part("case", _box_of_panes(half, tall), pane_glass(0.3, rng=rng))
    return Thing(words=f"{body.words} in a glass case", objects=(case, *inside))


def bauble(*, is_empty: bool, rng: np.random.Generator) -> Thing:
    """A ball blown as thin as a soap bubble, with a body of glass that lies low in it, or with nothing."""
    radius = rng.uniform(0.045, 0.06)
    shell = moved(ball(radius), (0, 0, radius))
    objects = [part("bauble", shell, pane_glass(0.6, rng=rng))]
    if is_empty:
        return Thing(words="a bauble", objects=tuple(objects))
    kind = pick(CORES, rng=rng)
    room = rng.uniform(0.45, 0.65) * radius
    core = moved(fitted(make_solid(kind, rng=rng), room), (0, 0, room + 0.03 * radius))
    material = solid_glass(room, rng=rng, is_cut=kind in CUT)
    objects.append(part("bauble_core", core, material))
    return Thing(words=f"a bauble around {with_article(kind)}", objects=tuple(objects))


PANES: dict[str, Maker] = {
    "panes": _panes,
    "frame": _frame,
    "case": lambda rng: glass_case(of_glass=False, rng=rng),
    "bauble": lambda rng: bauble(is_empty=True, rng=rng),
}
"""Panes for a table."""


def enclosed(rng: np.random.Generator) -> Thing:
    """A body of glass with thin glass around it."""
    return glass_case(of_glass=True, rng=rng) if rng.random() < 0.5 else bauble(is_empty=False, rng=rng)


def _upright(foot: tuple[float, float, float], half: float, tall: float) -> Mesh:
    """A pane across the x axis that faces -y; `foot` is the middle of its lower edge."""
    x, y, z = foot
    return sheet((x - half, y, z), (2 * half, 0, 0), (0, 0, tall), cells=CELLS)


def _box_of_panes(half: float, tall: float) -> Mesh:
    """Four walls and a lid around the z axis, outward."""
    wall = moved(_upright((0.0, 0.0, 0.0), half, tall), (0, -half, 0))
    walls = [turned(wall, (0, 0, 1), angle) for angle in (0.0, 90.0, 180.0, 270.0)]
    lid = sheet((-half, -half, tall), (2 * half, 0, 0), (0, 2 * half, 0), cells=CELLS)
    return merged([*walls, lid])


# Families


@dataclass(frozen=True, kw_only=True)
class Family:
    """A kind of random scene."""

    draw: Callable[[np.random.Generator], list[Thing]]
    """The things of one scene, not placed yet; all random numbers come from the generator."""
    stands_on: Mapping[Support, float]
    """What the things stand on, and how often."""
    has_lamps: bool = False
    """Whether lamps light the things, instead of a sky."""


def _one_of(make: Callable[..., Thing], kinds: Iterable[str]) -> Maker:
    """Makes a thing of one of these kinds."""
    return lambda rng: make(pick(tuple(kinds), rng=rng), rng=rng)


def _vessel_or_solid(kind: str, *, rng: np.random.Generator) -> Thing:
    return (empty_vessel if kind in VESSELS else solid)(kind, rng=rng)


def _frosted(kind: str, *, rng: np.random.Generator) -> Thing:
    """A vessel or a body of frosted or tinted glass."""
    thing = _vessel_or_solid(kind, rng=rng)
    glass = solid_glass(0.012 if kind in VESSELS else 0.05, rng=rng, kinds={"tinted": 0.5, "frosted": 0.5})
    return dataclasses.replace(thing, objects=(dataclasses.replace(thing.objects[0], material=glass),))


def _group(
    makers: Mapping[Maker, float],
    count: tuple[int, int],
    *,
    opaque: tuple[int, int] = (1, 3),
    size: tuple[float, float] = (1.3, 1.6),
) -> Callable[[np.random.Generator], list[Thing]]:
    """Draws things of glass, so many times enlarged, and opaque ones; of both at least and fewer than so many."""

    def draw(rng: np.random.Generator) -> list[Thing]:
        glass = [enlarged(weigh(makers, rng=rng)(rng), rng.uniform(*size)) for _ in range(rng.integers(*count))]
        rest = range(rng.integers(*opaque))
        return [*glass, *(enlarged(opaque_thing(rng), rng.uniform(1.0, 1.4)) for _ in rest)]

    return draw


PORTABLE = tuple(name for name in VESSELS if name != "tank")
"""Vessels for a table."""
VESSEL, DRINK, BODY = _one_of(empty_vessel, PORTABLE), _one_of(filled_vessel, PORTABLE), _one_of(solid, BODIES)
SEVERAL_MEDIA = {_one_of(filled_vessel, VESSELS): 0.5, paperweight: 0.26, onion: 0.12, enclosed: 0.12}
ONE = {
    _one_of(solid, CONVEX): 0.3,
    _one_of(_vessel_or_solid, (*NOT_CONVEX, "tumbler", "cut tumbler", "wine glass", "bottle", "jar")): 0.3,
    lambda rng: weigh(SEVERAL_MEDIA, rng=rng)(rng): 0.3,
    enclosed: 0.1,
}
"""A convex body, one that is not, several media, or one in thin glass."""
MIXED = {VESSEL: 0.26, DRINK: 0.26, BODY: 0.34, lambda rng: PANES[pick(tuple(PANES), rng=rng)](rng): 0.14}
TABLE_OR_FLOOR: dict[Support, float] = {"table": 0.6, "floor": 0.4}

OBJECT = Family(draw=_group(ONE, (1, 2), opaque=(0, 1), size=(1.6, 2.0)), stands_on={"floor": 0.5, "plinth": 0.5})
"""A single thing, as large as a melon."""
TABLE = Family(draw=_group(MIXED, (3, 7), opaque=(2, 5), size=(1.3, 1.5)), stands_on={"table": 1.0})
NESTED = Family(draw=_group(SEVERAL_MEDIA, (1, 4), size=(1.4, 1.7)), stands_on=TABLE_OR_FLOOR)
SOLID = Family(draw=_group({BODY: 1.0}, (2, 5)), stands_on=TABLE_OR_FLOOR)
DRINKS = Family(draw=_group({DRINK: 1.0}, (2, 4)), stands_on=TABLE_OR_FLOOR, has_lamps=True)
FROSTED = Family(draw=_group({_one_of(_frosted, (*PORTABLE, *BODIES)): 1.0}, (2, 5)), stands_on=TABLE_OR_FLOOR)
LAMPS = Family(draw=_group(MIXED, (2, 5)), stands_on=TABLE_OR_FLOOR, has_lamps=True)
