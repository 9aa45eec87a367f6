"""The fitted objects: as stages store them, in fit.json, and as a geometry."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch

from datagen.data.dataset import Dataset
from datagen.data.geometries import write_proxies
from datagen.data.meshes import MIN_AREA, Mesh, face_areas
from datagen.data.paths import FITTED, TRUTH
from datagen.disk.records import Json, to_json
from hyaline_photos.fit.boxes import Box
from hyaline_photos.fit.hull import HullShape
from hyaline_photos.fit.search import ABSORPTIONS, LAST, NUMBERS, STEPS, TINT_REACH, WORTH_IT, Found, reach_of
from hyaline_photos.fit.shapes import Axis, Glass, Revolution
from model.state import State, fingerprint


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundGlass:
    """One object, and what is known of its numbers."""

    glass: Glass
    unexplained: float
    """Share of the rays at the mask's edge that the outside explains wrongly."""
    drink_id: int | None = None
    """Id of the drink inside it."""
    overruled: tuple[int, ...] = ()
    """Training views that were left out, because their masks lack parts of it that the others show."""
    numbers: dict[str, Found] = field(default_factory=dict)

    def ids(self, object_id: int) -> tuple[int, ...]:
        """Object ids of the glass and its drink."""
        return (object_id,) if self.drink_id is None else (object_id, self.drink_id)


KINDS = (Axis, Box, Found, FoundGlass, HullShape, Mesh, Revolution)
"""The records that a state may hold."""


def to_state(value: object) -> State:
    """A record, with the records and arrays in it, as PyTorch stores it."""
    if isinstance(value, KINDS):
        fields = {field.name: to_state(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"is": type(value).__name__, **fields}
    if isinstance(value, Mapping):
        return {str(key): to_state(each) for key, each in value.items()}
    return torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else cast(State, value)


def from_state(state: object) -> Any:
    """Restores the value that `to_state` stored."""
    if isinstance(state, dict):
        values = {key: from_state(value) for key, value in state.items() if key != "is"}
        return next(kind for kind in KINDS if kind.__name__ == state["is"])(**values) if "is" in state else values
    return state.numpy() if isinstance(state, torch.Tensor) else state


DRINK_NUMBERS = ("level", "drink_")
"""Prefixes of the drink's numbers among those of its vessel."""

Objects = dict[int, FoundGlass]
"""By object id."""


def digest(found: Objects) -> str:
    return fingerprint(to_state(found)) if found else ""


def in_words(glass: Glass) -> str:
    """Its numbers, in one line; lengths in metres, absorption in 1/m."""
    tints = {"absorption": glass.absorption, "drink_absorption": glass.drink_absorption}
    words = [f"{name} {value:.4g}" for name, value in glass.numbers.items()]
    words += [f"{name} {', '.join(f'{each:.1f}' for each in tint)}" for name, tint in tints.items() if any(tint)]
    return "; ".join(["vessel" if glass.hollow else "solid", *words])


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
        for each, (mesh, material) in item.glass.bodies(item.ids(object_id)).items():
            # A search can flatten faces, as of a rounding that shrinks to nothing.
            has_area = face_areas(mesh) >= MIN_AREA
            meshes[each - 1] = dataclasses.replace(mesh, faces=mesh.faces[has_area])
            assignment[each - 1] = FITTED
            materials[dataset.objects[each - 1].name] = to_json(material)
    write_proxies(dataset, geometry, tuple(meshes), (None,) * len(meshes), tuple(assignment), materials)


def summary(dataset: Dataset, found: Objects) -> dict[str, Json]:
    """The objects in fit.json."""
    objects: list[Json] = []
    for object_id, item in found.items():
        glass, pixel = item.glass, _pixel(dataset, item.glass)
        # A round may have left a number that a later one gave up, such as the roughness of smooth glass.
        numbers = {key: each for key, each in item.numbers.items() if key in glass.numbers or "absorption" in key}
        of_drink = {key: numbers.pop(key) for key in list(numbers) if key.startswith(DRINK_NUMBERS)}
        axis: Json = None
        if isinstance(glass, Revolution):
            axis = {"point": glass.axis.point.tolist(), "direction": glass.axis.direction.tolist()}
        own = {"kind": glass.kind, "axis": axis, "unexplained": item.unexplained, "numbers": _json(numbers, pixel)}
        overruled: Json = [*pictures(dataset, item)]
        objects.append({"name": dataset.objects[object_id - 1].name, **own, "overruled": overruled})
        if item.drink_id is not None:
            inside = _json({key.removeprefix("drink_"): each for key, each in of_drink.items()}, pixel)
            name = dataset.objects[item.drink_id - 1].name
            objects.append({"name": name, "kind": "drink", "axis": axis, "numbers": inside})
    return {"objects": objects}


def pictures(dataset: Dataset, item: FoundGlass) -> list[str]:
    """The pictures that were left out, by their paths in the dataset."""
    return [dataset.view("train", view).file(".png") for view in item.overruled]


def _json(numbers: dict[str, Found], pixel: float) -> dict[str, Json]:
    ends = intervals(numbers, pixel)
    return {name: {"value": numbers[name].value, "low": low, "high": high} for name, (low, high) in ends.items()}


def _pixel(dataset: Dataset, glass: Glass) -> float:
    """Width in metres of a pixel at an object's distance."""
    cameras = dataset.cameras("train")
    middle = glass.mesh().vertices.mean(axis=0)
    far = np.median(np.linalg.norm(cameras.world_from_camera[:, :3, 3] - middle, axis=1))
    return float(far / cameras.focal)


# Intervals; docs/notes/fitting.md reports how often they contain the truth

WALL_ERROR, FLOOR_ERROR = 0.07, 0.75
"""In pixels at the object's distance. Masks show an outside to such a share of a pixel, and a hollow is found from
there; a floor is seen at a slant, through the wall."""
NORMALS_ERROR = 0.03
"""GGX alpha of smooth glass whose normals are 1 to 2 degrees off."""
FROSTED_INDEX_ERROR = 0.1
"""Of the index of frosted solids: less frost with a higher index spreads light as far."""
WELL = 0.02
"""Mean penalty of the pixels of glass whose shape is right. More means a wrong shape, and biases all numbers."""


def intervals(numbers: Mapping[str, Found], pixel: float) -> dict[str, tuple[float, float]]:
    """The intervals of all numbers of a glass, or of its drink.

    The refraction of a thin wall is proportional to (n - 1) / n times its thickness, so that a vessel's index n is as
    uncertain as its wall: an index that is n (n - 1) p too high makes up for a wall that is a share p too thin.

    Args:
        pixel: width in metres of a pixel at the object's distance.
    """
    least = {"wall": WALL_ERROR * pixel, "floor": FLOOR_ERROR * pixel, "roughness": NORMALS_ERROR}
    if "roughness" in numbers and "wall" not in numbers:
        least["ior"] = FROSTED_INDEX_ERROR
    found = {name: _interval(name, number, least.get(name, 0.0)) for name, number in numbers.items()}
    if "wall" in found and "ior" in found:
        index, wall = numbers["ior"].value, numbers["wall"].value
        reach = index * (index - 1) * max(abs(end - wall) for end in found["wall"]) / wall
        low, high = found["ior"]
        found["ior"] = min(low, index - reach), max(high, index + reach)
    for name, ends in found.items():
        ends = (*ends, *numbers[name].as_good)
        found[name] = min(ends), max(ends)
    return found


def _interval(name: str, found: Found, least: float) -> tuple[float, float]:
    """On either side as far as the two halves of the views differ, as the last round moved the number, and as the
    values that were tried last lie apart, all the wider the worse pictures are explained; and as far as values explain
    them as well."""
    spread = max(abs(found.even - found.odd), _last_step(name, found.value), least)
    if found.before is not None:
        spread = max(spread, abs(found.value - found.before))
    ends = [found.value]
    if found.curve:
        values, losses = np.array(sorted(found.curve)).T
        spread *= max(1.0, losses.min() / WELL)
        fine = np.linspace(values[0], values[-1], 1001)
        as_good = fine[np.interp(fine, values, losses) <= (1 + WORTH_IT) * losses.min()]
        ends += [float(as_good[0]), float(as_good[-1])]
    lowest = min(NUMBERS[name].low, 0.0) if name in NUMBERS else 0.0
    return max(min(found.value - spread, *ends), lowest), max(found.value + spread, *ends)


def _last_step(name: str, value: float) -> float:
    """Distance between the values that were tried last."""
    if "absorption" in name:
        return max(TINT_REACH * 2 / (STEPS - 1) * value, ABSORPTIONS[1])
    step = 2 * reach_of(name, LAST) / (STEPS - 1)
    return step * value if NUMBERS[name].is_factor else step
