"""What the head of a variant says of it: of which dataset, with which splits, and how its scene was edited."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from datagen.data.config import Split
from datagen.disk.names import check_name
from datagen.disk.records import Json, from_json


@dataclass(frozen=True, kw_only=True)
class SceneEdit:
    """How the scene of a variant differs from that of the dataset around it."""

    edits: tuple[str, ...]
    """As `datagen.scene.edits.parse_edit` reads them, in the order in which they were made."""
    changed: tuple[str, ...]
    """Names of the objects that are not what they were: removed, moved, copied, of another material."""
    copies: dict[str, str]
    """The original's name by the name of each copy: objects that no renderer was trained on look like these."""

    def __post_init__(self) -> None:
        for name in (*self.changed, *self.copies, *self.copies.values()):
            check_name(name, where="object name")


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What a dataset inside another one says of itself."""

    of: str
    """Seal of the dataset around it."""
    splits: tuple[Split, ...]
    """The splits that it has."""
    edit: SceneEdit | None = None
    """None: scene, meshes and proxies are those of the dataset around it. Otherwise its test cameras are."""


def variant_of(head: Mapping[str, Json], path: Path) -> Variant | None:
    """What a variant's head says of it; None in the head of another dataset."""
    return from_json(Variant, head["variant"], where=f"{path}: variant") if "variant" in head else None
