"""Floors: two methods that learn nothing, which every other one should beat."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import NO_GEOMETRY
from datagen.data.images import png_bytes
from datagen.data.paths import list_datasets, view_name
from datagen.data.variants import has_variant, open_variant, variant_root
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, dump_json
from datagen.disk.storage import commit
from datagen.terminal.command import say
from hyaline_bench.protocol import Protocol, is_of_preset, left_out

Pictures = UInt8[np.ndarray, "view h w 3"]
Floor = Callable[[Pictures, Cameras, Cameras], Pictures]


def mean_picture(pictures: Pictures, train: Cameras, test: Cameras) -> Pictures:  # noqa: ARG001
    """The mean of all training pictures, for every camera."""
    return np.repeat(np.rint(pictures.mean(axis=0, keepdims=True)).astype(np.uint8), len(test), axis=0)


def nearest_view(pictures: Pictures, train: Cameras, test: Cameras) -> Pictures:
    """The training picture of the nearest camera, by position and viewing direction.

    A turn in radians counts as a step of that many times the cameras' mean distance from their centroid.
    """
    poses, wanted = train.world_from_camera, test.world_from_camera
    positions = poses[:, :3, 3]
    scale = np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean() or 1.0  # All at one place: any will do.
    steps = np.linalg.norm(wanted[:, None, :3, 3] - positions, axis=-1)
    turns = np.arccos(np.clip(wanted[:, :3, 2] @ poses[:, :3, 2].T, -1, 1))
    return pictures[np.argmin(steps**2 + (scale * turns) ** 2, axis=1)]


FLOORS: dict[str, tuple[Floor, str]] = {
    "mean-picture": (mean_picture, "training pictures"),
    "nearest-view": (nearest_view, "training pictures, cameras"),
}
"""What each predicts, and what it is told, by its name in tables."""


def write_floors(runs_root: Path, data_root: Path, preset: str, protocol: Protocol) -> list[Path]:
    """The floors' predictions of each dataset of a preset, as runs; returns their folders."""
    datasets: list[Dataset] = []
    for root in list_datasets(data_root):
        with left_out():
            if is_of_preset(dataset := open_dataset(root), preset, protocol):
                datasets.append(dataset)
    if not datasets:
        command = f"hyaline-bench commands --preset {preset} | model sweep -"
        raise HyalineError(f"{data_root}: has no dataset of {preset}; make them with `{command}`")
    chosen = {dataset.seal: dataset for dataset in datasets}  # One folder of each dataset.
    places = [(runs_root / dataset.name / name, name, dataset) for dataset in chosen.values() for name in FLOORS]
    return [_write_floor(*place, protocol) for place in places]


def _write_floor(out: Path, name: str, dataset: Dataset, protocol: Protocol) -> Path:
    floor, knowledge = FLOORS[name]
    record: dict[str, Json] = {
        "method": name,
        "geometry": NO_GEOMETRY,
        "knowledge": knowledge,
        "dataset": dataset.root.as_posix(),
        "dataset_seal": dataset.seal,
    }
    path, data = out / "run.json", dump_json(record)
    if not (path.is_file() and path.read_bytes() == data):
        if out.exists() and any(out.iterdir()):
            raise HyalineError(f"{out}: holds something else than {name} of {dataset.root}; move it elsewhere")
        commit(path, data)
    pictures = np.stack([view.image for view in dataset.views("train")])
    places = {out: dataset}
    for variant in protocol.variant_splits(dataset.config.scene):
        if has_variant(dataset, variant):
            places[variant_root(out, variant)] = open_variant(dataset, variant)
    for folder, shown in places.items():
        splits: list[Split] = [split for split in shown.splits if split != "train"]
        for split in splits:
            for view, picture in enumerate(floor(pictures, dataset.cameras("train"), shown.cameras(split))):
                commit(folder / "predictions" / split / f"{view_name(view)}.png", png_bytes(picture))
    say(f"{out}: predicted {', '.join(shown.name for shown in places.values())}")
    return out
