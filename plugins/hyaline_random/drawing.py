"""A random scene from its seed: draws until one passes the checks of every scene, and keeps why others did not.

Each draw has a generator of its own, made from the seed, family and number of the draw: equal names give equal bits.
"""

import dataclasses
import re
import zlib
from collections import Counter
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Cameras
from datagen.data.config import OWN_LICENSE, DatasetConfig, square
from datagen.data.meshes import face_corners
from datagen.data.queries import windings
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import CameraRig, Scene, SceneObject, WalkPoint
from datagen.scene.materials import ThinDielectric, Vector
from datagen.scene.mending import assemble
from datagen.scene.rig import make_cameras
from datagen.scene.soundness import check_scene
from datagen.terminal.command import say
from hyaline_random.backdrop import SKY_PATH, draw_backdrop
from hyaline_random.families import Family
from hyaline_random.names import FAMILIES, RandomName
from hyaline_random.things import Thing, spread_out


def glass_shares(objects: tuple[SceneObject, ...], cameras: Cameras) -> Float[np.ndarray, " view"]:
    """The share of each picture's pixels in whose middle the nearest surface is glass.

    Args:
        objects: those that are glass or can be in front of glass, in front of all cameras; others are optional.
    """
    use_mitsuba()
    from datagen.trace.peel import Peeler

    peeler = Peeler(tuple(item.mesh for item in objects))
    is_glass = np.array([*(item.material.is_glass for item in objects), False])  # The last where nothing is hit: -1.
    rays = (cameras[view].rays() for view in range(len(cameras)))
    hits = (peeler.trace(origin, directions.reshape(-1, 3), 1).shape[0] for origin, directions in rays)
    return np.array([is_glass[shape].mean() for shape in hits])


MAX_DRAWS = 20
GLASS_SHARE = 0.05, 0.40
"""Lowest and highest share of pixels that show glass, on average over the views."""
VIEWS = 12
"""Training cameras that see how much glass there is."""
SIZE = 48
"""Pixels a side of what they see."""
FOV_DEG = 40.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """A random scene, not unwrapped yet."""

    scene: Scene
    refused: tuple[str, ...]
    """Why each earlier draw was refused, in order."""
    glass_share: float
    """Share of pixels that show glass, on average."""
    things: tuple[Thing, ...]
    """The things in it; their objects are the scene's first ones."""


def make_random(name: RandomName) -> Scene:
    """The scene of this name, unwrapped and checked."""
    say(f"scene {name}: generating it and unwrapping its surfaces")
    drawn = draw_scene(name)
    for reason in drawn.refused:
        say(f"scene {name}: a candidate was rejected: {reason}")
    return assemble(dataclasses.replace(drawn.scene, license=OWN_LICENSE))


def draw_scene(name: RandomName) -> Drawn:
    """The first draw of this name that passes all checks."""
    refused: list[str] = []
    while len(refused) < MAX_DRAWS:
        rng = np.random.default_rng([name.seed, _number(name.family), len(refused)])
        try:
            return _draw(name, tuple(refused), rng)
        except HyalineError as error:
            refused.append(str(error).removeprefix(f"scene {name}: "))
    counts = Counter(refused).most_common(3)
    reasons = "; ".join(f"{count} times: {reason}" for reason, count in counts)
    raise HyalineError(f"scene {name}: {MAX_DRAWS} candidates were rejected; take another --seed. Reasons: {reasons}")


def _draw(name: RandomName, refused: tuple[str, ...], rng: np.random.Generator) -> Drawn:
    """One draw, which may be refused."""
    family: Family = FAMILIES.find(name.family)
    things = _with_own_names(spread_out(family.draw(rng), rng=rng))
    check_inside(things, where=f"scene {name}")
    objects = tuple(item for thing in things for item in thing.objects)
    # Over the middle, at half the mean height of the glass.
    target = 0.0, 0.0, round(0.5 * float(np.mean([thing.height for thing in things if thing.is_glass])), 3)
    extent = max(float(np.linalg.norm(item.mesh.vertices[:, :2], axis=-1).max()) for item in objects)
    radius, share = _radius(objects, target, extent, rng)
    if not GLASS_SHARE[0] <= share <= GLASS_SHARE[1]:
        raise HyalineError(
            f"scene {name}: {100 * share:.1f} % of the pixels are glass; expected {100 * GLASS_SHARE[0]:g} to "
            f"{100 * GLASS_SHARE[1]:g} %"
        )
    backdrop = draw_backdrop(family.stands_on, lamps=family.has_lamps, extent=extent, radius=radius, rng=rng)
    words = f"{_listed([thing.words for thing in things])}, {backdrop.words}; glass in {100 * share:.0f} %"
    told = f"; draws refused before: {' | '.join(refused)}" if refused else ""
    scene = Scene(
        name=str(name),
        description=f"Random scene, family {name.family}, seed {name.seed}: {words} of the pixels{told}",
        objects=(*objects, *backdrop.objects),
        environment=backdrop.environment,
        lights=backdrop.lamps,
        cameras=_rig(target, radius, backdrop.azimuth_deg, rng),
        baked={} if backdrop.lamps else {SKY_PATH: backdrop.sky},
    )
    check_scene(scene)
    return Drawn(scene=scene, refused=refused, glass_share=share, things=tuple(things))


def _number(family: str) -> int:
    """A number for a family, so that equal seeds of two families differ."""
    built_in = list(FAMILIES.built_in)
    return built_in.index(family) if family in built_in else zlib.crc32(family.encode())


def check_inside(things: list[Thing], *, where: str) -> None:
    """Refuses ice, stones, cores and panes that reach into what they are in, or into each other.

    Drinks reach into their glass on purpose, and cores and shells are wholly inside of what they are in. Of thin glass,
    which may be open and bounds no solid, the question is whether some of it is in the other.
    """
    for thing in things:
        loose = [item for item in thing.objects[1:] if not item.name.endswith("_drink")]
        for one, other in combinations([thing.objects[0], *loose], 2):
            if isinstance(one.material, ThinDielectric):
                one, other = other, one
            if isinstance(one.material, ThinDielectric):
                continue
            inside = windings(face_corners(one.mesh), other.mesh.vertices[::3]) > 0
            if inside.any() and not inside.all():
                raise HyalineError(
                    f"{where}: {other.name} reaches into {one.name}; expected it to be clear of it or wholly inside"
                )


def _radius(
    objects: tuple[SceneObject, ...], target: Vector, extent: float, rng: np.random.Generator
) -> tuple[float, float]:
    """How far the cameras are from the things, and the share of the pixels that is glass from there."""
    wanted = rng.uniform(0.15, 0.32)
    nearest = 2.5 * max(extent, target[2])  # Less than that, and the outermost things would be cut off.
    radius = nearest * 1.3
    for _ in range(3):
        share = _glass_share(objects, target, radius, views=4)
        radius = max(nearest, radius * (max(share, 1e-3) / wanted) ** 0.5)
    radius = round(radius, 3)
    return radius, _glass_share(objects, target, radius, views=VIEWS)


def _glass_share(objects: tuple[SceneObject, ...], target: Vector, radius: float, *, views: int) -> float:
    config = DatasetConfig.even("random", square(SIZE), views)
    rig = _rig(target, radius, (0.0, 360.0), np.random.default_rng(0))
    return float(glass_shares(objects, make_cameras(rig, config)["train"]).mean())


def _rig(target: Vector, radius: float, azimuth_deg: tuple[float, float], rng: np.random.Generator) -> CameraRig:
    """Cameras on a hemisphere, and a walk that comes nearer, goes lower and leaves it."""
    first, last = azimuth_deg
    start = rng.uniform(first, last) if last - first >= 360 else first + 20
    turn = 220.0 if last - first >= 360 else last - first - 40
    walk = []
    for share, away, elevation_deg, aside in (
        (0.0, 1.0, 38.0, 0.0),
        (0.2, 0.72, 24.0, 0.06),
        (0.4, 0.62, 12.0, -0.05),
        (0.6, 0.85, 8.0, 0.05),
        (0.75, 1.3, 28.0, -0.1),
        (0.9, 1.55, 42.0, 0.05),
        (1.0, 1.45, 16.0, 0.0),
    ):
        azimuth, elevation = np.radians(start + share * turn), np.radians(elevation_deg)
        across = np.cos(elevation)
        position = np.array(target) + away * radius * np.array(
            [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)]
        )
        x, y, z = np.round(position, 4).tolist()
        looks_at = target[0] + round(aside * radius, 4), target[1] - round(aside * radius, 4), target[2]
        walk.append(WalkPoint(position=(x, y, z), target=looks_at))
    return CameraRig(
        target=target,
        radius=radius,
        elevation_deg=(8.0, 65.0),
        azimuth_deg=azimuth_deg,
        fov_deg=FOV_DEG,
        target_jitter=0.08,
        walk=tuple(walk),
    )


def _with_own_names(things: list[Thing]) -> list[Thing]:
    """The things with a number in the names of the second and later ones of a kind."""
    counts: Counter[str] = Counter()
    named = []
    for thing in things:
        kind = thing.objects[0].name
        counts[kind] += 1
        if (number := counts[kind]) > 1:
            names = [re.sub(rf"^{kind}|$", rf"\g<0>_{number}", item.name, count=1) for item in thing.objects]
            objects = [dataclasses.replace(item, name=name) for item, name in zip(thing.objects, names, strict=True)]
            thing = dataclasses.replace(thing, objects=tuple(objects))
        named.append(thing)
    return named


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
