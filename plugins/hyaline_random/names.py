"""The names of random scenes, as a source of scenes: `random-0007` has seed 7, `random-table-0007` a chosen family."""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from datagen.disk.errors import HyalineError
from datagen.scene.finding import SceneSource
from datagen.terminal.command import choose
from datagen.terminal.plugins import Group

if TYPE_CHECKING:
    from datagen.data.config import Resolution
    from datagen.scene.description import Scene
    from datagen.scene.finding import ImportChoices

TURNS = "object", "table", "nested"
"""Families that seeds take turns among by default; more of them would change what a seed draws."""
FAMILIES: Group = Group(
    name="hyaline.random_families",
    what="family",
    built_in={
        name: f"hyaline_random.families:{name.upper()}" for name in (*TURNS, "solid", "drinks", "frosted", "lamps")
    },
    guide="docs/extending.md",
    kind="hyaline_random.families:Family",
)
"""A single glass object before a background, glass and other things on a table, media inside of each other; bodies,
drinks under lamps, frosted or tinted glass, and a table under lamps."""

RANDOM = "random"
"""What `datagen build --scene` takes for a scene that --seed draws."""

MAX_SEED = 2**63 - 1


@dataclass(frozen=True, kw_only=True)
class RandomName:
    """Which random scene is meant."""

    seed: int
    chosen: str | None = None
    """The family that was asked for; by default the seeds take turns among `TURNS`."""

    def __post_init__(self) -> None:
        if self.chosen is not None:
            choose(FAMILIES.what, self.chosen, FAMILIES.names())
        if not 0 <= self.seed <= MAX_SEED:
            raise HyalineError(f"seed: is {self.seed}; expected 0 or more, and at most 63 bits")

    @property
    def family(self) -> str:
        """The family that is drawn from: seed 0 an object, 1 a table, 2 nested media, and so on."""
        return self.chosen or TURNS[self.seed % len(TURNS)]

    def __str__(self) -> str:
        """The name of the scene, and of its dataset."""
        return "-".join([RANDOM, *([self.chosen] if self.chosen else []), f"{self.seed:04d}"])


def parse_random(name: str) -> RandomName | None:
    """What a name like `random-0007` means; None of any other name."""
    found = re.fullmatch(rf"{RANDOM}(?:-(.+))?-(\d{{4,19}})", name)
    if found is None or int(found[2]) > MAX_SEED or (found[1] and found[1] not in FAMILIES.names()):
        return None
    meant = RandomName(seed=int(found[2]), chosen=found[1])
    return meant if str(meant) == name else None


def _find(given: str, _resolution: "Resolution", _imports: "ImportChoices") -> "Scene":
    from hyaline_random.drawing import make_random

    name = parse_random(given)
    if name is None:
        raise HyalineError(
            f"scene {given}: is not a random scene; expected a name like random-0007 or random-table-0007"
        )
    return make_random(name)


RANDOM_SCENES = SceneSource(
    has=lambda given: given.startswith(RANDOM),
    find=_find,
    is_of_files=False,
    name_of=lambda seed, family: str(RandomName(seed=seed, chosen=family)),
    families=FAMILIES.names,
)
