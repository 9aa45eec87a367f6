"""Things of thin glass, which light crosses without bending: panes in a stand, empty frames, cases and baubles."""

import dataclasses
from collections.abc import Callable

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.description import SceneObject
from datagen.scene.modelling import ball, lathe, merged, moved, rounded_box, sheet, transformed, turned
from hyaline_random.chance import between, happens, pane_glass, pick, solid_glass
from hyaline_random.nesting import fitted, solid, with_article
from hyaline_random.solids import CONVEX, CUT, NOT_CONVEX, corners_of, make_solid, polygon
from hyaline_random.things import GAP, THINGS, Thing, surface

CELLS = 6, 6
"""Cells of a pane: enough of its points lie inside of whatever it would reach into."""
CORES = ("ball", "soft cube", "gem", "pebble", "knot", "ring", "star", "ribbed ball")
"""Bodies that lie in a bauble."""

Maker = Callable[[np.random.Generator], Thing]


def _panes(rng: np.random.Generator) -> Thing:
    """One to three panes, most of them tinted, upright behind each other in a stand."""
    count = int(rng.integers(1, 4))
    wide, tall = between(0.05, 0.08, rng=rng), between(0.07, 0.11, rng=rng)
    step, height = between(0.012, 0.022, rng=rng), 0.014
    deep = step * (count - 1) + 0.03
    stand = moved(rounded_box((2 * wide + 0.012, deep, height), bevel=0.002), (0, 0, height / 2))
    objects = [SceneObject(name="stand", mesh=stand, material=surface(0.02, rng=rng))]
    for number in range(count):
        away = step * (number - (count - 1) / 2)
        # Each a little aside from the one before it, so that one sees them alone and one behind the other.
        aside = between(-0.2, 0.2, rng=rng) * wide
        pane = _upright((aside, away, height + GAP), wide - abs(aside), tall * between(0.8, 1.0, rng=rng))
        objects.append(SceneObject(name=f"stand_pane_{number}", mesh=pane, material=pane_glass(0.75, rng=rng)))
    words = "a pane in a stand" if count == 1 else f"{count} panes in a stand"
    return Thing(words=words, objects=tuple(objects))


def _frame(rng: np.random.Generator) -> Thing:
    """A picture frame on its edge, without a picture; its glass lies behind it, as in a real one."""
    inner, bar, thick = between(0.035, 0.05, rng=rng), between(0.008, 0.014, rng=rng), between(0.014, 0.02, rng=rng)
    high = between(1.0, 1.4, rng=rng)
    outer, bevel = inner + bar, 0.002
    outline = [
        (inner, 0.0),
        (outer - bevel, 0.0),
        (outer, bevel),
        (outer, thick - bevel),
        (outer - bevel, thick),
        (inner + bevel, thick),
        (inner, thick - bevel),
    ]
    square = turned(lathe(outline, segments=corners_of(4), crease_deg=20, around=polygon(4)), (0, 0, 1), 45)
    # Its depth is along z so far; front to -y, and the lower edge on the ground.
    bars = turned(transformed(square, np.diag([1.0, high, 1.0]), (0, 0, 0)), (1, 0, 0), 90)
    half = inner + 0.6 * bar
    pane = _upright((0.0, GAP, high * (outer - half)), half, 2 * high * half)
    return Thing(
        words="an empty picture frame",
        objects=(
            SceneObject(name="frame", mesh=moved(bars, (0, 0, high * outer)), material=surface(0.02, rng=rng)),
            SceneObject(name="frame_pane", mesh=pane, material=pane_glass(0.3, rng=rng)),
        ),
    )


def glass_case(*, of_glass: bool, rng: np.random.Generator) -> Thing:
    """Five panes that meet at their edges, without a floor, over a body.

    Args:
        of_glass: the body is glass; else it may be an opaque thing.
    """
    if of_glass or happens(0.4, rng=rng):
        kind = pick((*CONVEX, *NOT_CONVEX), rng=rng)
        body = solid(kind, rng=rng)
    else:
        body = THINGS[pick(tuple(THINGS), rng=rng)](rng)
    half, tall = body.reach + between(0.006, 0.015, rng=rng), body.height + between(0.008, 0.02, rng=rng)
    inside = tuple(dataclasses.replace(item, name=f"case_{item.name}") for item in body.objects)
    case = SceneObject(name="case", mesh=_box_of_panes(half, tall), material=pane_glass(0.3, rng=rng))
    return Thing(words=f"{body.words} in a glass case", objects=(case, *inside))


def bauble(*, is_empty: bool, rng: np.random.Generator) -> Thing:
    """A ball blown as thin as a soap bubble, with a body of glass that lies low in it, or with nothing."""
    radius = between(0.045, 0.06, rng=rng)
    shell = moved(ball(radius), (0, 0, radius))
    objects = [SceneObject(name="bauble", mesh=shell, material=pane_glass(0.6, rng=rng))]
    if is_empty:
        return Thing(words="a bauble", objects=tuple(objects))
    kind = pick(CORES, rng=rng)
    room = between(0.45, 0.65, rng=rng) * radius
    core = moved(fitted(make_solid(kind, rng=rng), room), (0, 0, room + 0.03 * radius))
    material = solid_glass(room, rng=rng, is_cut=kind in CUT)
    objects.append(SceneObject(name="bauble_core", mesh=core, material=material))
    return Thing(words=f"a bauble around {with_article(kind)}", objects=tuple(objects))


PANES: dict[str, Maker] = {
    "panes": _panes,
    "frame": _frame,
    "case": lambda rng: glass_case(of_glass=False, rng=rng),
    "bauble": lambda rng: bauble(is_empty=True, rng=rng),
}
"""Panes for a table."""


def enclosed(*, rng: np.random.Generator) -> Thing:
    """A body of glass with thin glass around it."""
    return glass_case(of_glass=True, rng=rng) if happens(0.5, rng=rng) else bauble(is_empty=False, rng=rng)


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
