"""The things of a random scene: what one is, where several are placed, and opaque ones (books, pots, fruit, ...)."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.description import SceneObject
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Material, Plastic
from datagen.scene.modelling import (
    ball,
    curved,
    cylinder,
    deformed,
    knot,
    lathe,
    moved,
    rotation,
    rounded_box,
    transformed,
    tube,
    turned,
    walled,
)
from hyaline_random.chance import color_pair, pattern, pick, weigh


@dataclass(frozen=True, kw_only=True, eq=False)
class Thing:
    """Objects that belong together, such as a glass, its drink and ice, on z = 0 around the z axis."""

    words: str
    """What it is, for the scene's description."""
    objects: tuple[SceneObject, ...]
    """The outermost first."""

    @property
    def reach(self) -> float:
        """Radius in metres of the upright cylinder around the z axis that holds it."""
        return max(float(np.linalg.norm(item.mesh.vertices[:, :2], axis=-1).max()) for item in self.objects)

    @property
    def height(self) -> float:
        """Metres from the lowest to the highest point."""
        low = min(float(item.mesh.vertices[:, 2].min()) for item in self.objects)
        return max(float(item.mesh.vertices[:, 2].max()) for item in self.objects) - low

    @property
    def is_glass(self) -> bool:
        """Whether any of it is glass."""
        return any(item.material.is_glass for item in self.objects)


def part(name: str, mesh: Mesh, material: Material) -> SceneObject:
    """One object of a thing."""
    return SceneObject(name=name, mesh=mesh, material=material)


def standing(mesh: Mesh) -> Mesh:
    """The mesh with its lowest point at z = 0 and its middle over the origin."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return moved(mesh, (-float(low[0] + high[0]) / 2, -float(low[1] + high[1]) / 2, -float(low[2])))


def put(thing: Thing, place: tuple[float, float, float], *, turn_deg: float = 0.0) -> Thing:
    """The thing turned about its axis and moved; its textures come along."""
    linear = rotation((0, 0, 1), turn_deg)
    objects = tuple(
        dataclasses.replace(item, mesh=transformed(item.mesh, linear, place), material=item.material.moved(place))
        for item in thing.objects
    )
    return dataclasses.replace(thing, objects=objects)


def enlarged(thing: Thing, factor: float) -> Thing:
    """The thing in another size; its glass keeps the colour that it had, since it absorbs less the larger it is."""
    objects = []
    for item in thing.objects:
        material = item.material
        if isinstance(material, Dielectric):
            red, green, blue = (round(value / factor, 3) for value in material.absorption)
            material = dataclasses.replace(material, absorption=(red, green, blue))
        objects.append(
            dataclasses.replace(item, mesh=transformed(item.mesh, factor * np.eye(3), (0, 0, 0)), material=material)
        )
    return dataclasses.replace(thing, objects=tuple(objects))


# Placing things


CLEARANCE = 0.012
"""Metres between the cylinders around two things, at least."""
TRIES = 40
"""Places that are tried for a thing before the room for all of them is made larger."""


def spread_out(things: Sequence[Thing], *, rng: np.random.Generator) -> list[Thing]:
    """The things side by side around the z axis, each turned to any side; the same order."""
    places = free_places([thing.reach for thing in things], clearance=CLEARANCE, rng=rng)
    return [put(thing, (x, y, 0.0), turn_deg=rng.uniform(0, 360)) for thing, (x, y) in zip(things, places, strict=True)]


def free_places(reaches: Sequence[float], *, clearance: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Centres of circles of these radii that keep clear of each other, close together around the origin."""
    room = 0.9 * float(np.sum(np.square(reaches))) ** 0.5
    found: dict[int, np.ndarray] = {}
    for index in sorted(range(len(reaches)), key=lambda index: -reaches[index]):
        while index not in found:
            for _ in range(TRIES):
                angle, away = rng.uniform(0, 2 * np.pi), room * rng.uniform() ** 0.5
                place = away * np.array([np.cos(angle), np.sin(angle)])
                if all(
                    np.linalg.norm(place - other) >= reaches[index] + reaches[number] + clearance
                    for number, other in found.items()
                ):
                    found[index] = place
                    break
            else:
                room *= 1.1
    middle = np.mean(list(found.values()), axis=0)
    placed = np.round([found[index] - middle for index in range(len(reaches))], 4)
    return [(float(x), float(y)) for x, y in placed]


# Opaque things

Maker = Callable[[np.random.Generator], Thing]

GAP = 0.001
"""Metres between stacked things: coincident faces lose layers."""
METALS = ((0.90, 0.66, 0.33), (0.91, 0.62, 0.50), (0.82, 0.82, 0.84), (0.55, 0.56, 0.58))
"""Brass, copper, silver, steel."""


def surface(scale: float, *, rng: np.random.Generator) -> Material:
    """Paint, lacquer, paper or metal.

    Args:
        scale: metres of one period of its pattern.
    """
    kind = weigh({"paint": 0.25, "matt": 0.25, "lacquer": 0.4, "metal": 0.1}, rng=rng)
    if kind == "metal":
        return Conductor(color=pick(METALS, rng=rng), roughness=round(rng.uniform(0.12, 0.3), 3))
    if kind == "paint":
        return Plastic(color=pick(color_pair(rng=rng), rng=rng), roughness=round(rng.uniform(0.1, 0.3), 3))
    if kind == "matt":
        return Diffuse(color=pattern(scale, rng=rng))
    return Plastic(color=pattern(scale, rng=rng), roughness=round(rng.uniform(0.1, 0.25), 3))


def _books(rng: np.random.Generator) -> Thing:
    books, height = [], 0.0
    for number in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.13, 0.17), rng.uniform(0.09, 0.12), rng.uniform(0.014, 0.028)
        book = turned(rounded_box(size, bevel=0.002), (0, 0, 1), rng.uniform(-20, 20))
        books.append(
            part(
                f"book_{number}",
                moved(book, (0, 0, height + size[2] / 2)),
                Diffuse(color=pattern(rng.uniform(0.02, 0.05), rng=rng)),
            )
        )
        height += size[2] + GAP
    return Thing(words="books" if len(books) > 1 else "a book", objects=tuple(books))


def _pot(rng: np.random.Generator) -> Thing:
    wide, height = rng.uniform(0.03, 0.045), rng.uniform(0.08, 0.16)
    levels = zip(rng.uniform(0.55, 1.0, 5).tolist(), (0, 0.25, 0.5, 0.78, 1.0), strict=True)
    line = curved([(wide * share, height * level) for share, level in levels], count=32)
    outline = walled([(0.0, 0.0), *map(tuple, line.tolist())], wall=0.004, floor=0.007)
    return _one("pot", lathe(outline, segments=72, crease_deg=30), rng)


def _fruit(rng: np.random.Generator) -> Thing:
    long = rng.uniform(1.0, 1.35)
    body = deformed(ball(rng.uniform(0.03, 0.042)), lambda p: p * np.array([long, 1, 1]))
    return _one("fruit", body, rng)


def _block(rng: np.random.Generator) -> Thing:
    size = rng.uniform(0.035, 0.06)
    return _one("block", rounded_box((size, size, size), bevel=0.12 * size), rng)


def _can(rng: np.random.Generator) -> Thing:
    radius = rng.uniform(0.028, 0.036)
    top = radius if rng.random() < 0.6 else 0.3 * radius
    return _one("can", cylinder(radius, rng.uniform(0.07, 0.13), top_radius=top, segments=64), rng)


def _wire(rng: np.random.Generator) -> Thing:
    mesh = tube(knot(0.034, 0.014, count=160), rng.uniform(0.006, 0.008), segments=18, is_loop=True)
    return _one("knot", turned(mesh, (1, 0, 0), pick((0.0, 90.0), rng=rng)), rng)


THINGS: dict[str, Maker] = {"books": _books, "pot": _pot, "fruit": _fruit, "block": _block, "can": _can, "wire": _wire}


def _one(name: str, mesh: Mesh, rng: np.random.Generator) -> Thing:
    item = part(name, standing(mesh), surface(rng.uniform(0.012, 0.035), rng=rng))
    return Thing(words=f"a {name}", objects=(item,))
