"""A fit as `model fit` leaves it, of objects that are slightly off the truth."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes, write_proxies
from datagen.data.images import png_bytes
from datagen.data.meshes import Mesh, points_on
from datagen.data.paths import FITTED, TRUTH
from datagen.disk.records import Json
from datagen.disk.storage import commit_sealed


def write_fit(dataset: Dataset, folder: Path, names: tuple[str, ...], *, scale: float = 1.02) -> None:
    """Writes the geometry `fitted` and a folder of a fit; each object is the true one, scaled about its middle."""
    meshes = list(read_meshes(dataset, TRUTH))
    assignment = [TRUTH] * len(meshes)
    objects: list[Json] = []
    for place, item in enumerate(dataset.objects):
        if item.name in names:
            truth = meshes[place]
            middle = (truth.vertices.min(axis=0) + truth.vertices.max(axis=0)) / 2
            meshes[place] = dataclasses.replace(truth, vertices=middle + np.float32(scale) * (truth.vertices - middle))
            assignment[place] = FITTED
            objects.append(object_json(item.name, truth, middle))
    write_proxies(dataset, FITTED, tuple(meshes), (None,) * len(meshes), tuple(assignment))
    folder.mkdir(parents=True)
    for name in ("room", "search"):
        (folder / f"{name}.png").write_bytes(png_bytes(np.full((16, 32, 3), 90, np.uint8)))
    content: dict[str, Json] = {"version": 1, "dataset": dataset.seal, "geometry": FITTED, "objects": objects}
    commit_sealed(folder / "fit.json", {**content, "unknown": list(names), "pictures": ["room.png", "search.png"]})


def object_json(name: str, truth: Mesh, middle: np.ndarray) -> Json:
    """A vessel with a round hull of the true one's size; a flat thing is a pane, of which fewer numbers are known."""
    points = points_on(truth, 20_000).position - middle
    heights = np.linspace(*np.quantile(points[:, 2], [0, 1]), 41)
    is_flat = bool(np.ptp(heights) < 1e-6)
    hull: list[Json] = []
    for low, high in () if is_flat else itertools.pairwise(heights):
        rings = points[(points[:, 2] >= low) & (points[:, 2] <= high), :2]
        hull.append([float(np.linalg.norm(rings, axis=-1).max()), float(low + high) / 2])
    numbers = {"ior": (1.49, 1.48, 1.51), "wall": (0.003, 0.002, 0.004), "floor": (0.01, 0.009, 0.011)}
    found = {key: dict(zip(("value", "low", "high"), values)) for key, values in numbers.items()}
    steps = [("grid", 1.48, 0.0025, 0.2), ("search", 1.5, 0.0028, 0.12), ("search-again", 1.49, 0.003, 0.1)]
    point: list[Json] = [float(value) for value in middle]
    return {
        "name": name,
        "kind": "pane" if is_flat else "revolution",
        "axis": None if is_flat else {"point": point, "direction": [0.0, 0.0, 1.0]},
        "outline": None,
        "hull_outline": None if is_flat else hull,
        "numbers": {"ior": found["ior"], "wall": None, "roughness": None} if is_flat else {**found},
        "history": [dict(zip(("stage", "ior", "wall", "loss"), step)) for step in steps],
        "grid": [{"wall": 0.003, "floor": 0.1, "corner": 0.5, "loss": loss} for loss in (0.2, 0.3)],
        "unexplained": 0.01,
    }
