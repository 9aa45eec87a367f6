"""Records in a dataset's head and beside its views: variant, import, licence, view."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from datagen.data.config import Split
from datagen.disk.names import check_name
from datagen.disk.records import Json, from_json

ROUNDING_MSE = 2 / 12 / 255**2
"""What rounding two pictures to 8 bits adds to their mean squared difference, unless both are nearly free of noise."""


@dataclass(frozen=True, kw_only=True)
class ViewRecord:
    """One view: how it was made, and its files. Written last. Fields of the renderer are None for imported views."""

    dataset: str
    """Seal of the view's dataset."""
    split: Split
    view: int
    seed: int | None = None
    spp: int | None = None
    """Samples per pixel that were drawn, both halves together."""
    noise_mse: float | None = None
    """Estimated mean squared error of the clipped sRGB image against its limit for infinitely many samples."""
    variant: str | None = None
    """The Mitsuba variant that rendered it."""
    files: dict[str, str]
    """SHA-256 by path, relative to the dataset."""

    @property
    def ceiling_db(self) -> float | None:
        """The PSNR in dB that noise and 8 bits would leave a perfect method; None if unknown."""
        return None if self.noise_mse is None else -10 * math.log10(self.noise_mse + ROUNDING_MSE)


@dataclass(frozen=True, kw_only=True)
class SceneEdit:
    """How the scene of a variant differs from that of the dataset around it."""

    edits: tuple[str, ...]
    """The edits in order, as `datagen.scene.edits.parse_edit` reads them."""
    changed: tuple[str, ...]
    """Names of the objects that were removed, moved, copied or given another material."""
    copies: dict[str, str]
    """The original of each copy: no renderer was trained on the copies, but on these."""

    def __post_init__(self) -> None:
        for name in (*self.changed, *self.copies, *self.copies.values()):
            check_name(name, where="object name")


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A dataset inside another one."""

    of: str
    """Seal of its parent, the dataset around it."""
    splits: tuple[Split, ...]
    """Its splits."""
    edit: SceneEdit | None = None
    """None: it has the parent's scene, meshes and proxies. Otherwise it has the parent's test cameras."""


def variant_of(head: Mapping[str, Json], path: Path) -> Variant | None:
    """The variant in a head; None if the dataset is not one."""
    return from_json(Variant, head["variant"], where=f"{path}: variant") if "variant" in head else None


@dataclass(frozen=True, kw_only=True)
class Imported:
    """Where the pictures come from if they were not rendered here.

    Their noise, radiance and light are unknown. Without imported meshes, there is no scene.
    """

    layout: str
    """Layout of the source folder: refref, openmaterial, blender, nerfstudio or capture."""
    source: str
    """Name of the source folder."""
    source_sha256: str
    """Hash of the pictures and everything else that was read."""
    has_masks: bool
    has_depth: bool
    has_objects: bool = False
    """There is a mask for each object of glass."""
    remarks: tuple[str, ...] = ()
    """Decisions and omissions, a line each."""

    @property
    def endings(self) -> tuple[str, ...]:
        """Endings of the files of a view."""
        masks, depth = (".mask.png",) * self.has_masks, (".depth.npy",) * self.has_depth
        return (".png", *masks, *depth, *(".objects.png",) * self.has_objects)


RENDERED = (".png", ".exr")
"""Endings of the files of a rendered view."""


def imported_of(head: Mapping[str, Json], path: Path) -> Imported | None:
    """The import in a head; None if the pictures were rendered here."""
    return from_json(Imported, head["imported"], where=f"{path}: imported") if "imported" in head else None


OWN_LICENSE = "CC0-1.0"
"""SPDX name of the licence of built-in and random scenes, which code generates, and of pictures of them. CC0, because
pictures end up in batches, crops and merged sets that cannot carry attributions."""
OWN_LICENSE_ADDRESS = "https://creativecommons.org/publicdomain/zero/1.0/"

MAX_LICENSE_LENGTH = 500
"""Characters of a foreign file's licence that are kept."""


def unknown_license(source: str) -> str:
    """The licence of data that states none: whom to ask."""
    return f"unknown; ask the author of {source}"


def license_line(*parts: object) -> str | None:
    """A foreign file's licence in one line; None if none of the parts is a text."""
    lines = (" ".join(part.split()) for part in parts if isinstance(part, str))
    return "; ".join(dict.fromkeys(filter(None, lines)))[:MAX_LICENSE_LENGTH] or None
