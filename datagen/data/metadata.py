"""Records in a dataset's head and beside its views: variant, import, licence, view."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from datagen.data.config import Split
from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name
from datagen.disk.records import Json, from_json


@dataclass(frozen=True, kw_only=True)
class ViewRecord:
    """What is known of one view; written last. What only a renderer knows is None where the view was imported."""

    dataset: str
    """The seal of the dataset that the view belongs to."""
    split: Split
    view: int
    seed: int | None = None
    spp: int | None = None
    """Samples per pixel that were really drawn, both halves together."""
    noise_mse: float | None = None
    """Estimated mean squared error of the clipped sRGB image against its own limit of infinitely many samples."""
    variant: str | None = None
    """The Mitsuba variant that rendered it."""
    files: dict[str, str]
    """SHA-256 by path, relative to the dataset."""

    @property
    def ceiling_db(self) -> float | None:
        """The PSNR in dB that the view's own noise would allow a perfect method; None where nobody knows it."""
        return None if self.noise_mse is None else -10 * math.log10(max(self.noise_mse, 1e-12))


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
    if old := sorted({"edit", "annex_of"} & head.keys()):
        raise HyalineError(
            f"{path}: says {old[0]!r}, as the format before `variants/` did; delete {path.parent} and build it again"
        )
    return from_json(Variant, head["variant"], where=f"{path}: variant") if "variant" in head else None


@dataclass(frozen=True, kw_only=True)
class Imported:
    """Where the pictures of a dataset come from that was not rendered here.

    Then nobody knows the pictures' noise and radiance, nor the light of the scene. Its scene holds what meshes it
    brought; without any, there is no scene.
    """

    layout: str
    """Whose layout of folders it was read from: refref, openmaterial, blender or nerfstudio."""
    source: str
    """Name of the folder that it was read from."""
    source_sha256: str
    """Names the pictures, and all else that was read."""
    has_masks: bool
    has_depth: bool
    remarks: tuple[str, ...] = ()
    """What was decided or left out, in a line each."""

    @property
    def endings(self) -> tuple[str, ...]:
        """Endings of the files of a view."""
        masks, depth = (".mask.png",) * self.has_masks, (".depth.npy",) * self.has_depth
        return (".png", *masks, *depth)


RENDERED = (".png", ".exr")
"""Endings of the files of a view that was rendered here."""


def imported_of(head: Mapping[str, Json], path: Path) -> Imported | None:
    """What the head of an imported dataset says of that; None in the head of another dataset."""
    return from_json(Imported, head["imported"], where=f"{path}: imported") if "imported" in head else None


OWN_LICENSE = "CC0-1.0"
"""SPDX name of the licence of built-in and random scenes, which code models and colours, and of all that is rendered
from them. CC0 because pictures end up in batches, crops and merged sets that cannot carry attributions."""
OWN_LICENSE_ADDRESS = "https://creativecommons.org/publicdomain/zero/1.0/"

MAX_LICENSE_LENGTH = 500
"""Characters of what a foreign file may say."""


def unknown_license(source: str) -> str:
    """What is said of data that states no licence: whom to ask."""
    return f"unknown; ask the author of {source}"


def license_line(*parts: object) -> str | None:
    """What a foreign file says of its licence, in one line; None where none of the parts is a text that says it."""
    lines = (" ".join(part.split()) for part in parts if isinstance(part, str))
    return "; ".join(dict.fromkeys(filter(None, lines)))[:MAX_LICENSE_LENGTH] or None
