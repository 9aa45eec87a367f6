"""Who reads a hostile file, and what it says of it: accepted with these counts, or a HyalineError; and the command that
reads it for a person."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from support.hostile.corpus import DATASET, THEIRS
from support.hostile.pictures import PREDICTION

from datagen.builder.verify import verify_dataset
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import read_meshes
from datagen.data.images import decode_exr
from datagen.disk.errors import HyalineError


def _scene(root: Path) -> str:
    from datagen.scene.folder import load_scene

    scene = load_scene(root / "scene")
    vertices, faces = (sum(len(getattr(item.mesh, name)) for item in scene.objects) for name in ("vertices", "faces"))
    return f"{len(scene.objects)} objects, {vertices} vertices, {faces} faces"


def _dataset(root: Path) -> str:
    dataset = open_dataset(root / DATASET)
    views = [dataset.cameras(split).world_from_camera.shape[0] for split in dataset.splits]
    return f"{len(dataset.objects)} objects, {views} cameras; {_verified(root)}"


def _verified(root: Path) -> str:
    findings = verify_dataset(root / DATASET)
    if findings.problems:
        raise HyalineError(findings.problems[0])
    return f"{findings.verified} files"


def _opened(read: Callable[[Dataset], object]) -> Callable[[Path], str]:
    def reader(root: Path) -> str:
        read(open_dataset(root / DATASET))
        return _verified(root)

    return reader


def _layers(root: Path) -> str:
    layers = open_dataset(root / DATASET).view("train", 0).layers()
    return (
        f"layers {layers.uv.shape} of {layers.uv.dtype}, {int(np.count_nonzero(layers.object_id))} hits; "
        + _verified(root)
    )


def _cameras(root: Path) -> str:
    cameras = open_dataset(root / DATASET).cameras("train")
    return f"{cameras.world_from_camera.shape} cameras"


def _theirs(root: Path) -> str:
    from hyaline_import.datasets.choices import DatasetImportChoices
    from hyaline_import.datasets.import_dataset import plan_import

    plan_import((root / THEIRS).parent, DatasetImportChoices())
    return "an import is planned"


def _experiment(root: Path) -> str:
    from model.run.experiments import read_experiment

    return f"{len(read_experiment(str(root / 'grid.txt')).runs)} runs"


def _run(root: Path) -> str:
    from eval.score.runs import open_run
    from model.run.run_folder import read_run

    folder = root / "runs/one/paper"
    record = read_run(folder)
    open_run(folder, root / "data")
    return f"{record.method}, {record.config.steps} steps"


def _prediction(root: Path) -> str:
    from eval.score.runs import has_predictions, open_run, read_prediction

    folder = (root / PREDICTION).parents[2]
    assert has_predictions(folder)
    picture = read_prediction(open_run(folder, root / "data"), "interpolating", 0)
    return f"picture {picture.shape}, sum {int(picture.sum(dtype=np.int64))}"


def _predictions(root: Path) -> str:
    from eval.score.runs import open_run, read_prediction
    from model.run.run_folder import is_finished, read_prediction_hashes

    folder = root / "runs/one/paper"
    count = len(read_prediction_hashes(folder))
    run = open_run(folder, root / "data")
    picture = read_prediction(run, "interpolating", 0)
    return f"{count} predictions, finished {is_finished(folder)}, picture {picture.shape}"


def _weights(root: Path) -> str:
    from model.run.predict import load_renderer
    from model.run.run_folder import read_run

    folder = root / "runs/one/paper"
    renderer = load_renderer(folder, read_run(folder).config, open_dataset(root / DATASET))
    return f"{sum(value.numel() for value in renderer.parameters())} parameters"


def _exr(root: Path) -> str:
    radiance, noise = decode_exr((root / "view.exr").read_bytes())
    return f"radiance {radiance.shape}, noise {noise.shape}"


READERS: dict[str, Callable[[Path], str]] = {
    "scene": _scene,
    "dataset": _dataset,
    "record": _opened(lambda dataset: dataset.view("train", 0).record),
    "layers": _layers,
    "layers record": _layers,
    "proxies": _opened(lambda dataset: read_meshes(dataset, "box")),
    "cameras": _cameras,
    "theirs": _theirs,
    "experiment": _experiment,
    "run": _run,
    "prediction": _prediction,
    "predictions": _predictions,
    "weights": _weights,
    "exr": _exr,
}

_VERIFY = f"datagen verify {{world}}/{DATASET}"
_REPORT = "report {world}/runs --data {world}/data --out {out} --shown-views 1"
_EXPORT = "model export {world}/runs/one/paper --out {out}"

COMMANDS: dict[str, str] = {
    "scene": "datagen build --scene {world}/scene --out {out} --preset tiny --resolution 8 --views 1 --test-views 1"
    " --spp 2 --test-spp 2 --num-layers 2",
    **dict.fromkeys(("dataset", "record", "layers", "layers record", "proxies", "cameras"), _VERIFY),
    "experiment": "model sweep {world}/grid.txt --dry-run",
    **dict.fromkeys(("run", "weights"), _EXPORT),
    **dict.fromkeys(("prediction", "predictions"), _REPORT),
}
"""No command reads a lone EXR, and imports read what is theirs in a process of their own (test_confined_import.py)."""
