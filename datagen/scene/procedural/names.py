"""The names of random scenes: `random-0007` is the scene of seed 7, `random-table-0007` that of a chosen family."""

import re
from dataclasses import dataclass
from typing import Literal, get_args

from datagen.disk.errors import HyalineError

Family = Literal["object", "table", "nested"]
FAMILIES: tuple[Family, ...] = get_args(Family)
"""A single glass object before a background, glass and other things on a table, and media inside of each other."""

RANDOM = "random"
"""What `datagen build --scene` takes for a scene that --seed draws."""

MAX_SEED = 2**63 - 1


@dataclass(frozen=True, kw_only=True)
class RandomName:
    """Which random scene is meant."""

    seed: int
    chosen: Family | None = None
    """The family that was asked for; by default the seeds take turns."""

    def __post_init__(self) -> None:
        if not 0 <= self.seed <= MAX_SEED:
            raise HyalineError(f"seed: is {self.seed}; expected 0 or more, and at most 63 bits")

    @property
    def family(self) -> Family:
        """The family that is drawn from: seed 0 an object, 1 a table, 2 nested media, and so on."""
        return self.chosen or FAMILIES[self.seed % len(FAMILIES)]

    def __str__(self) -> str:
        """The name of the scene, and of its dataset."""
        return "-".join([RANDOM, *([self.chosen] if self.chosen else []), f"{self.seed:04d}"])


def parse_random(name: str) -> RandomName | None:
    """What a name like `random-0007` means; None of any other name."""
    found = re.fullmatch(rf"{RANDOM}(?:-({'|'.join(FAMILIES)}))?-(\d{{4,19}})", name)
    if found is None:
        return None
    chosen: Family | None = next((family for family in FAMILIES if family == found[1]), None)
    if int(found[2]) > MAX_SEED:
        return None
    meant = RandomName(seed=int(found[2]), chosen=chosen)
    return meant if str(meant) == name else None
