"""The parts of a build that several machines make at once: which views are whose, and what the whole still lacks.

Machines meet in the folder alone, without a lock that all of them would have to see (flock often ends at the machine).
So a part never deletes or replaces anything but by the same bytes: what several need (scene, cameras, heads) each
writes whole and of the same content, a head that stands there is never replaced, views are disjoint. What a killed part
left is cleared by a build without a part, when all have ended.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.variants import list_variants, open_variant
from datagen.disk.errors import HyalineError

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One of `count` disjoint parts of the views of a dataset."""

    number: int
    """From 1 to `count`."""
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise HyalineError(f"shard: is {self}; expected a part from 1/{self.count} to {self.count}/{self.count}")

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def of(self, tasks: Sequence[T]) -> list[T]:
        """The part's own of the tasks of the whole, evenly spread."""
        return list(tasks[self.number - 1 :: self.count])


def parse_shard(text: str) -> Shard:
    """The part that `--shard 2/4` names.

    Raises:
        HyalineError: no such part.
    """
    number, slash, count = text.partition("/")
    if not (slash and number.isascii() and number.isdecimal() and count.isascii() and count.isdecimal() and int(count)):
        raise HyalineError(f"shard: is {text!r}; expected the part and the number of parts, such as 2/4")
    return Shard(number=int(number), count=int(count))


def own_tasks(shard: Shard | None, tasks: list[T]) -> list[T]:
    """What a part makes of the tasks of the whole; all of them without parts."""
    return tasks if shard is None else shard.of(tasks)


def count_missing(dataset: Dataset) -> tuple[int, int]:
    """How many views, and sets of layers of views, are not committed yet, and how many there are in all.

    Counts by the records, which are written last; only a build without a part reads every byte. Variants count, too.
    """
    found = [_is_there(dataset, split, view) for split, view in _views(dataset)]
    for name in list_variants(dataset.root):
        variant = open_variant(dataset, name)
        if variant.edit is not None:
            continue  # Made by one machine.
        found += [_is_there(variant, *view) for view in _views(variant)]
    states = [state for view in found for state in view]
    return states.count(False), len(states)


def _is_there(dataset: Dataset, split: Split, view: int) -> list[bool]:
    """Whether a view's record, and that of its layers, stands there."""
    states = []
    for read in (lambda: dataset.view(split, view).record, lambda: dataset.layer_store().record(split, view)):
        try:
            read()
            states.append(True)
        except HyalineError:
            states.append(False)
    return states


def _views(dataset: Dataset) -> list[tuple[Split, int]]:
    return [(split, view) for split in dataset.splits for view in range(dataset.config.split(split).views)]
