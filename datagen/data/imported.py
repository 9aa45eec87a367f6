"""What the head of a dataset says of pictures that were imported, and which files a view then has."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from datagen.disk.records import Json, from_json


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
