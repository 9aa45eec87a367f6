"""What a fit knows of each object, as its stages store it, as fit.json says it, and as a geometry."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch

from datagen.data.dataset import Dataset
from datagen.data.geometries import write_proxies
from datagen.data.meshes import Mesh
from datagen.data.paths import FITTED, TRUTH
from datagen.disk.records import Json
from datagen.scene.folder import material_json
from model.fit.boxes import Box
from model.fit.handles import Attached, Handled
from model.fit.hull import HullShape
from model.fit.search import NUMBERS, Found, interval
from model.fit.shapes import Axis, Glass, Revolution
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
    numbers: dict[str, Found] = field(default_factory=dict)
    history: tuple[dict[str, Json], ...] = ()
    """The numbers after each round, and the mean penalty of the object's pixels."""
    cells: tuple[tuple[float, ...], ...] = ()
    """Wall, floor, corner and penalty of the cells of the grid, the best first; a wall of 0: solid."""

    def state(self) -> dict[str, State]:
        numbers = {name: dataclasses.asdict(found) for name, found in self.numbers.items()}
        shapes = {"glass": to_state(self.glass), "hull": to_state(self.hull)}
        return {
            **shapes,
            "unexplained": self.unexplained,
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
            numbers={name: Found(**values) for name, values in state["numbers"].items()},
            history=tuple(state["history"]),
            cells=tuple(state["cells"]),
        )


KINDS = (Axis, Attached, Box, Handled, HullShape, Mesh, Revolution)
"""The records that a state may hold."""


def to_state(value: object) -> State:
    """A record, with the records and arrays in it, as PyTorch stores it."""
    if isinstance(value, KINDS):
        fields = {field.name: to_state(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"is": type(value).__name__, **fields}
    return torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else cast(State, value)


def from_state(state: object) -> Any:
    """What `to_state` stored."""
    if isinstance(state, dict):
        kind = next(kind for kind in KINDS if kind.__name__ == state["is"])
        return kind(**{name: from_state(value) for name, value in state.items() if name != "is"})
    return state.numpy() if isinstance(state, torch.Tensor) else state


Objects = dict[int, FoundGlass]
"""By object id."""


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
    if any(glass.absorption):
        parts.append("absorption " + ", ".join(f"{value:.1f}" for value in glass.absorption) + " 1/m")
    if glass.roughness is not None:
        parts.append(f"roughness {glass.roughness:.2f}")
    return ", ".join(parts)


def write_geometry(dataset: Dataset, geometry: str, truths: tuple[Mesh, ...], found: Objects) -> None:
    """Commits the meshes and materials that were found, beside the true ones of everything else."""
    meshes = list(truths)
    assignment = [TRUTH] * len(meshes)
    materials: dict[str, Json] = {}
    for object_id, item in found.items():
        meshes[object_id - 1], assignment[object_id - 1] = item.glass.mesh(), FITTED
        materials[dataset.objects[object_id - 1].name] = material_json(item.glass.material())
    write_proxies(dataset, geometry, tuple(meshes), (None,) * len(meshes), tuple(assignment), materials)


def summary(dataset: Dataset, found: Objects) -> dict[str, Json]:
    """What fit.json holds of the objects."""
    objects: list[Json] = []
    for object_id, item in found.items():
        glass = item.glass
        objects.append(
            {
                "name": dataset.objects[object_id - 1].name,
                "kind": glass.kind,
                "axis": _axis_json(glass),
                "outline": glass.outline().tolist() if isinstance(glass, Revolution) else None,
                "hull_outline": item.hull.outline().tolist() if isinstance(item.hull, Revolution) else None,
                "unexplained": item.unexplained,
                "numbers": {name: _interval(name, number) for name, number in item.numbers.items()},
                "history": list(item.history),
                "grid": [dict(zip(("wall", "floor", "corner", "loss"), cell, strict=True)) for cell in item.cells],
            }
        )
    return {"objects": objects}


def _axis_json(glass: Glass) -> Json:
    if not isinstance(glass, Revolution):
        return None
    return {"point": glass.axis.point.tolist(), "direction": glass.axis.direction.tolist()}


def _interval(name: str, found: Found) -> Json:
    low, high = interval(name, found)
    return {"value": found.value, "low": low, "high": high}
