"""All hostile files, and the world of good ones that each of them is put into."""

import json
import shutil
from pathlib import Path
from typing import Any

from support.hostile.jsons import Case, experiment_cases, json_cases, named, not_files, sealed, text_cases, text_of
from support.hostile.meshes import mesh_cases
from support.hostile.pictures import PREDICTION, exr_cases, picture_cases
from support.hostile.states import state_cases
from support.synthetic import synthetic_scene, write_synthetic_dataset

from datagen.data.cameras import look_at
from datagen.data.geometries import ProxyStatistics, read_meshes, write_proxies
from datagen.data.paths import TRUTH
from datagen.scene.folder import save_scene

DATASET = "data/one"
RUN = "runs/one/paper/run.json"
THEIRS = "theirs/transforms.json"
LAYERS = f"{DATASET}/layers/straight"
SEALED = {
    "dataset": (f"{DATASET}/dataset.json", 2),
    "record": (f"{DATASET}/records/train/0000.json", 3),
    "layers": (f"{LAYERS}/layers.json", 3),
    "layers record": (f"{LAYERS}/records/train/0000.json", 3),
    "proxies": (f"{DATASET}/proxies/box/proxies.json", 3),
    "predictions": ("runs/one/paper/predictions.json", 4),
}
"""By reader, a sealed file and how many values are tried at each of its places."""


def write_world(root: Path) -> None:
    """A scene, a dataset with layers and proxies, a trained run, a foreign method's pictures, an EXR: all good."""
    import numpy as np
    import torch

    from datagen.data.images import png_bytes
    from datagen.machine.mitsuba_variant import use_mitsuba
    from datagen.render.truth import Truth, radiance_bytes
    from model.methods.paper.config import PaperConfig
    from model.run.predict import render_predictions
    from model.run.run_folder import TrainConfig
    from model.run.train import train

    save_scene(synthetic_scene(), root / "scene")
    dataset = write_synthetic_dataset(root / DATASET, resolution=8, train_views=2)
    numbers = ProxyStatistics(volume_ratio=1.0, mean_distance=0.0, max_distance=0.0)
    write_proxies(dataset, "box", read_meshes(dataset, TRUTH), (numbers, numbers))
    config = TrainConfig(
        method="paper", geometry=TRUTH, net=PaperConfig(width=8, texture_size=8, position_size=8), steps=1, batch=16
    )
    run = root / "runs/one/paper"
    cpu = torch.device("cpu")
    train(config, dataset, run, label="paper", device=cpu)
    render_predictions(run, config, dataset, device=cpu)
    shutil.copytree(run / "predictions", root / "runs/one/foreign/predictions")
    (root / PREDICTION).write_bytes(png_bytes(dataset.view("interpolating", 0).image))
    use_mitsuba()
    ramp = np.linspace(0, 1, 192, dtype=np.float32).reshape(8, 8, 3)
    truth = Truth(radiance=ramp, half_difference=0.01 * ramp, spp=4, noise_mse=1e-5)
    (root / "view.exr").write_bytes(radiance_bytes(truth))
    (root / "grid.txt").write_text("model train paper\n")
    (root / "theirs").mkdir()
    frames = []
    for view in range(4):
        (root / f"theirs/{view}.png").write_bytes(png_bytes(np.zeros((8, 12, 3), np.uint8)))
        frames.append({"file_path": f"{view}.png", "transform_matrix": look_at((2, view, 1), (0, 0, 0)).tolist()})
    lens = {"fl_x": 10.0, "fl_y": 10.0, "cx": 6.5, "cy": 4.0, "w": 12, "h": 8, "k1": 0.0}
    (root / THEIRS).write_bytes(text_of({**lens, "frames": frames}))


def endless_scenes(good: dict[str, Any]) -> list[Case]:
    """A scene with very many of something."""
    changes = {
        "objects": good["objects"][:1] * 100_000,
        "lights": [{}] * 20_000,
        "cameras": {**good["cameras"], "walk": good["cameras"]["walk"][:1] * 20_000},
    }
    contents = {f"many {key}": text_of({**good, key: value}) for key, value in changes.items()}
    return named("scene", "scene", "scene/scene.json", contents)


def cases_of(root: Path) -> list[Case]:
    """Every hostile file of a world, in a fixed order."""

    def read(path: str) -> bytes:
        return (root / path).read_bytes()

    cases = [
        *mesh_cases(read("scene/meshes/pane.ply")),
        *json_cases("scene", "scene/scene.json", json.loads(read("scene/scene.json")), each=2),
        *text_cases("scene", "scene/scene.json", read("scene/scene.json")),
        *endless_scenes(json.loads(read("scene/scene.json"))),
        *not_files("scene", "scene/scene.json"),
        *not_files("scene", "scene/meshes/pane.ply"),
        *experiment_cases(),
        *not_files("experiment", "grid.txt", may_be_link=True),
        *picture_cases(read(PREDICTION)),
        *not_files("prediction", PREDICTION, may_be_link=True),
        *state_cases(read("runs/one/paper/weights.pt")),
        *not_files("weights", "runs/one/paper/weights.pt", may_be_link=True),
        *json_cases(
            "run", "runs/one/paper/run.json", json.loads(read("runs/one/paper/run.json")), each=1, write=sealed
        ),
        *text_cases("run", RUN, read(RUN)),
        *not_files("run", RUN, may_be_link=True),
        *exr_cases(read("view.exr")),
    ]
    for reader, (path, each) in SEALED.items():
        cases += json_cases(reader, path, json.loads(read(path)), each=each, write=sealed)
        cases += text_cases(reader, path, read(path))
        cases += not_files(reader, path, may_be_link=path.startswith("runs/"))
    for reader, path in (("cameras", f"{DATASET}/transforms_train.json"), ("theirs", THEIRS)):
        cases += json_cases(reader, path, json.loads(read(path)), each=2)
        cases += text_cases(reader, path, read(path))
    names = [case.name for case in cases]
    assert len(names) == len(set(names)), sorted(name for name in names if names.count(name) > 1)[:5]
    return cases
