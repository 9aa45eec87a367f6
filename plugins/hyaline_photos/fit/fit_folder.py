"""The folder of a fit: the results of each stage, from which an interrupted fit continues.

FIT/fit.json         sealed, written first: what was asked; in the end the objects that were found
FIT/STAGE.pt         what a stage found, with the digest of what it was found from
FIT/STAGE.png        a picture of it, for stages that draw
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from datagen.data.dataset import Dataset
from datagen.data.geometries import list_geometries, read_assignment
from datagen.data.images import png_bytes
from datagen.data.paths import FITTED, geometry_root
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import FolderKind, begin, is_ours, refuse_others, remove_files
from datagen.disk.records import Json, commit_sealed, dump_json, load_sealed
from datagen.disk.storage import commit, sha256
from datagen.terminal.command import say

if TYPE_CHECKING:
    from model.state import State

FIT = FolderKind(what="fit", head="fit.json")
FIT_VERSION = 3
STAGES = {
    "room": "learns textures beside the glass",
    "outside": "finds outsides from masks",
    "grid": "tells solid glass from vessels",
    "search": "one number after the other",
    "textures": "learns textures with the glass that was found",
    "again": "searches once more",
}
"""What is said of each stage."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitFolder:
    """The folder of one fit, held by its writer."""

    root: Path
    asked: dict[str, Json]
    """Everything that determines the result."""

    def begin(self, *, overwrite: bool) -> None:
        """Claims the folder; what another fit left there stays only where this one asks for the same."""
        head: dict[str, Json] = {"version": FIT_VERSION, **self.asked}
        path = self.root / FIT.head
        if not path.is_file():
            refuse_others(self.root, FIT)
            begin(self.root, FIT, head)
        elif overwrite:
            remove_files(self.root, [f"{stage}.{ending}" for stage in STAGES for ending in ("pt", "png")])
            commit_sealed(path, head)
        elif not is_ours(self.root, FIT):
            raise HyalineError(f"{path}: is damaged, or not of a fit; start over with --overwrite, which replaces it")
        else:
            before = load_sealed(path)
            if different := [key for key, value in head.items() if before.get(key) != value]:
                raise HyalineError(
                    f"{self.root}: holds a fit with another {different[0]}; start over with --overwrite, or choose "
                    "another --name"
                )

    def stage(self, name: str, depends_on: str, make: "Callable[[], dict[str, State]]") -> "dict[str, State]":
        """Runs a stage, or reads its stored result.

        Args:
            depends_on: digest of what it is found from.
        """
        from model.state import load_state, save_state  # Torch, which reports of fits do without.

        path, title = self.root / f"{name}.pt", f"{name}: {STAGES[name]}"
        key = sha256(dump_json([self.asked, name, depends_on]))
        try:
            state = load_state(path) if path.is_file() else {}
        except HyalineError as error:
            say(f"{error}; making it again")
            state = {}
        if state.pop("key", None) == key:
            say(f"{title}: found before")
            return state
        say(f"{title} ...")
        state = make()
        save_state(path, {**state, "key": key})
        return state

    def finish(self, found: dict[str, Json]) -> None:
        commit_sealed(self.root / FIT.head, {"version": FIT_VERSION, **self.asked, **found})

    def write_picture(self, name: str, image: UInt8[np.ndarray, "h w 3"]) -> None:
        commit(self.root / f"{name}.png", png_bytes(image))


def refuse_losing(dataset: Dataset, geometry: str, unknown: tuple[int, ...]) -> None:
    """Refuses a fit whose geometry would lose glass that another fit has found."""
    own = (read_assignment(dataset, geometry) or ()) if geometry in list_geometries(dataset) else ()
    found = {place: item.name for place, (item, by) in enumerate(zip(dataset.objects, own), start=1) if by == FITTED}
    if lost := [name for place, name in found.items() if place not in unknown]:
        raise HyalineError(
            f"{geometry_root(dataset.root, geometry)}: holds a fit of {', '.join(lost)}, too; replace it with "
            "--overwrite, or choose another --name"
        )
