"""The fitted objects: as stages store them, in fit.json, and as a geometry."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch

from datagen.data.dataset import Dataset
from datagen.data.geometries import write_proxies
from datagen.data.meshes import MIN_AREA, Mesh, face_areas
from datagen.data.paths import FITTED, TRUTH
from datagen.disk.records import Json
from datagen.scene.folder import material_json
from hyaline_photos.fit.boxes import Box
from hyaline_photos.fit.handles import Attached, Handled
from hyaline_photos.fit.hull import HullShape
from hyaline_photos.fit.intervals import intervals
from hyaline_photos.fit.lathe import Axis
from hyaline_photos.fit.materials import Found
from hyaline_photos.fit.search import NUMBERS
from hyaline_photos.fit.section import Section
from hyaline_photos.fit.shapes import Glass, Revolution
from model.run.checkpoint import fingerprint
from model.settings.state import State


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundGlass:
    """One object, and what is known of its numbers."""

    glass: Glass
    hull: Glass
    """Its outside as masks show it, solid."""
    unexplained: float
    """Share of the rays at the mask's edge that the outside explains wrongly."""
    drink_id: int | None = None
    """Id of the drink inside it."""
    numbers: dict[str, Found] = field(default_factory=dict)
    history: tuple[dict[str, Json], ...] = ()
    """The numbers after each round, and the mean penalty of the object's pixels."""
    cells: tuple[tuple[float, ...], ...] = ()
    """Wall, floor, corner and penalty of the cells of the grid, the best first; a wall of 0: solid."""

    def ids(self, object_id: int) -> tuple[int, ...]:
        """Object ids of the glass and its drink."""
        return (object_id,) if self.drink_id is None else (object_id, self.drink_id)

    def state(self) -> dict[str, State]:
        numbers = {name: dataclasses.asdict(found) for name, found in self.numbers.items()}
        shapes = {"glass": to_state(self.glass), "hull": to_state(self.hull)}
        return {
            **shapes,
            "unexplained": self.unexplained,
            "drink_id": self.drink_id,
            "numbers": numbers,
            "history": list(self.history),
            "cells": list(self.cells),
        }

    @classmethod
    def of(cls, state: dict) -> "FoundGlass":
        return cls(
            glass=from_state(state["glass"]),
            hull=from_state(state["hull"]),
            unexplained=state["unexplained"],
            drink_id=state.get("drink_id"),
            numbers={name: Found(**values) for name, values in state["numbers"].items()},
            history=tuple(state["history"]),
            cells=tuple(state["cells"]),
        )


KINDS = (Axis, Attached, Box, Handled, HullShape, Mesh, Revolution, Section)
"""The records that a state may hold."""


def to_state(value: object) -> State:
    """A record, with the records and arrays in it, as PyTorch stores it."""
    if isinstance(value, KINDS):
        fields = {field.name: to_state(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"is": type(value).__name__, **fields}
    return torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else cast(State, value)


def from_state(state: object) -> Any:
    """Restores the value that `to_state` stored."""
    if isinstance(state, dict):
        kind = next(kind for kind in KINDS if kind.__name__ == state["is"])
        return kind(**{name: from_state(value) for name, value in state.items() if name != "is"})
    return state.numpy() if isinstance(state, torch.Tensor) else state


DRINK_NUMBERS = ("level", "drink_")
"""Prefixes of the drink's numbers among those of its vessel."""

Objects = dict[int, FoundGlass]
"""By object id."""


def settled(found: Objects) -> Objects:
    """The same objects, those that were found solid as the shapes that they are then."""
    return {object_id: dataclasses.replace(item, glass=item.glass.settled()) for object_id, item in found.items()}


def states(found: Objects) -> dict[str, State]:
    return {str(object_id): item.state() for object_id, item in found.items()}


def digest(found: Objects) -> str:
    return fingerprint(states(found)) if found else ""


def history_row(stage: str, glass: Glass, loss: float) -> dict[str, Json]:
    numbers = {name: getattr(glass, name, None) for name in NUMBERS}
    return {"stage": stage, **numbers, "absorption": list(glass.absorption), "loss": loss}


def in_words(glass: Glass) -> str:
    """Its numbers, in one line."""
    parts = [f"index {glass.ior:.3f}"]
    if not isinstance(glass, Revolution) or glass.wall is None:
        parts.insert(0, "solid")
    else:
        assert glass.floor is not None
        parts.insert(0, f"wall {1000 * glass.wall:.2f} mm, floor {1000 * glass.floor:.1f} mm")
    parts += _tint_in_words(glass.absorption)
    if glass.roughness is not None:
        parts.append(f"roughness {glass.roughness:.2f}")
    words = ", ".join(parts)
    if isinstance(glass, Revolution) and glass.drink_ior is not None and glass.level is not None:
        drink = [f"index {glass.drink_ior:.3f}", *_tint_in_words(glass.drink_absorption)]
        words += f"; filled to {1000 * glass.level:.1f} mm: {', '.join(drink)}"
    return words


def _tint_in_words(absorption: tuple[float, float, float]) -> list[str]:
    return ["absorption " + ", ".join(f"{value:.1f}" for value in absorption) + " 1/m"] if any(absorption) else []


def write_geometry(
    dataset: Dataset, geometry: str, truths: tuple[Mesh, ...], assumed: dict[str, Json], found: Objects
) -> None:
    """Commits the meshes and materials that were found, beside the true ones of everything else.

    Args:
        assumed: materials, by name of the object, that were used in place of the true ones.
    """
    meshes = list(truths)
    assignment = [TRUTH] * len(meshes)
    materials = dict(assumed)
    for object_id, item in found.items():
        for each, (mesh, material) in zip(item.ids(object_id), item.glass.bodies(), strict=True):
            # Where a handle meets its vessel, a search can flatten faces.
            has_area = face_areas(mesh) >= MIN_AREA
            meshes[each - 1] = dataclasses.replace(mesh, faces=mesh.faces[has_area])
            assignment[each - 1] = FITTED
            materials[dataset.objects[each - 1].name] = material_json(material)
    write_proxies(dataset, geometry, tuple(meshes), (None,) * len(meshes), tuple(assignment), materials)


def summary(dataset: Dataset, found: Objects) -> dict[str, Json]:
    """The objects in fit.json."""
    objects: list[Json] = []
    for object_id, item in found.items():
        glass, pixel = item.glass, _pixel(dataset, item.glass)
        # A round may have left a number that a later one gave up, such as the roughness of smooth glass.
        numbers = {key: each for key, each in item.numbers.items() if getattr(glass, key, 0) is not None}
        of_drink = {key: key.removeprefix("drink_") for key in numbers if key.startswith(DRINK_NUMBERS)}
        objects.append(
            {
                "name": dataset.objects[object_id - 1].name,
                "kind": glass.kind,
                "axis": _axis_json(glass),
                "outline": glass.outline().tolist() if isinstance(glass, Revolution) else None,
                "hull_outline": item.hull.outline().tolist() if isinstance(item.hull, Revolution) else None,
                "unexplained": item.unexplained,
                "numbers": _intervals({key: each for key, each in numbers.items() if key not in of_drink}, pixel),
                "history": list(item.history),
                "grid": [dict(zip(("wall", "floor", "corner", "loss"), cell, strict=True)) for cell in item.cells],
            }
        )
        if item.drink_id is not None:
            objects.append(
                {
                    "name": dataset.objects[item.drink_id - 1].name,
                    "kind": "drink",
                    "axis": _axis_json(glass),
                    "numbers": _intervals({short: item.numbers[key] for key, short in of_drink.items()}, pixel),
                }
            )
    return {"objects": objects}


def _axis_json(glass: Glass) -> Json:
    if not isinstance(glass, Revolution):
        return None
    return {"point": glass.axis.point.tolist(), "direction": glass.axis.direction.tolist()}


def _intervals(numbers: dict[str, Found], pixel: float) -> dict[str, Json]:
    ends = intervals(numbers, pixel)
    return {name: {"value": numbers[name].value, "low": low, "high": high} for name, (low, high) in ends.items()}


def _pixel(dataset: Dataset, glass: Glass) -> float:
    """Width in metres of a pixel at an object's distance."""
    cameras = dataset.cameras("train")
    middle = glass.mesh().vertices.mean(axis=0)
    far = np.median(np.linalg.norm(cameras.world_from_camera[:, :3, 3] - middle, axis=1))
    return float(far / cameras.focal)
