"""A fit as `model fit` leaves it, of objects that are slightly off the truth."""

import dataclasses
from pathlib import Path

import numpy as np

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes, write_proxies
from datagen.data.images import png_bytes
from datagen.data.meshes import Mesh
from datagen.data.paths import FITTED, TRUTH
from datagen.disk.records import Json, commit_sealed


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
    content: dict[str, Json] = {"version": 3, "dataset": dataset.seal, "geometry": FITTED, "objects": objects}
    commit_sealed(folder / "fit.json", {**content, "unknown": list(names)})


def object_json(name: str, truth: Mesh, middle: np.ndarray) -> Json:
    """A vessel about an upright axis; a flat thing is a pane, of which fewer numbers are known."""
    is_flat = bool(np.ptp(truth.vertices[:, 2]) < 1e-6)
    numbers = {"ior": (1.49, 1.48, 1.51), "wall": (0.003, 0.002, 0.004), "floor": (0.01, 0.009, 0.011)}
    found = {key: dict(zip(("value", "low", "high"), values)) for key, values in numbers.items()}
    return {
        "name": name,
        "kind": "pane" if is_flat else "revolution",
        "axis": None if is_flat else {"point": middle.tolist(), "direction": [0.0, 0.0, 1.0]},
        "numbers": {"ior": found["ior"], "wall": None, "roughness": None} if is_flat else {**found},
        "unexplained": 0.01,
    }
