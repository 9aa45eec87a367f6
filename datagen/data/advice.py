"""What to type next: commands that work as they stand, with the folders that are there."""

import os
import shlex
from collections.abc import Iterator
from pathlib import Path

from datagen.data.dataset import Dataset, has_layers
from datagen.data.finding import build_command, list_datasets
from datagen.data.geometries import list_geometries
from datagen.data.paths import TRUTH
from datagen.data.variants import variant_root
from datagen.disk.errors import HyalineError
from datagen.disk.names import real_path
from datagen.disk.records import Json
from datagen.disk.storage import load_sealed

RUNS = Path("runs")
"""Where runs lie unless told."""
BLIND_METHODS = ("deepvoxels",)
"""Methods that know no geometry, and so cannot draw an edit."""


def after_build(dataset: Dataset) -> str:
    """What comes after a dataset."""
    if not dataset.objects:
        if not dataset.config.resolution.is_power_of_two_square:
            return shlex.join(["datagen", "look", str(dataset.root)])
        return shlex.join(["model", "train", "deepvoxels", "--dataset", str(dataset.root)])
    if not has_layers(dataset):
        return shlex.join(["datagen", "peel", "--dataset", str(dataset.root)])
    if "ellipsoid" not in list_geometries(dataset):
        return shlex.join(["proxies", "make", "--dataset", str(dataset.root), "--kind", "ellipsoid"])
    return after_layers(dataset, TRUTH)


def after_layers(dataset: Dataset, geometry: str) -> str:
    """What comes after layers of a geometry: a run that learns from them, or the report when there is one."""
    if dataset.edit is not None and dataset.parent is not None:
        return after_edit(dataset.parent, dataset)
    home = dataset.home
    seal = _layers_seal(home, geometry)
    method, seal = ("light-path", home.seal) if seal is None else ("paper", seal)
    usual = RUNS / home.name / (method if geometry == TRUTH else f"{method}-{geometry}")
    command = ["model", "train", method, "--dataset", str(home.root)]
    command += [] if geometry == TRUTH else ["--geometry", geometry]
    if not os.path.lexists(usual):
        return shlex.join(command)
    record = _read_record(usual)
    if (record.get("dataset_seal"), record.get("layers_seal")) == (home.seal, seal) and _is_predicted(usual):
        return report_command(usual)
    others = (usual.with_name(f"{usual.name}-{number}") for number in range(2, 1000))
    return shlex.join([*command, "--out", str(next(path for path in others if not os.path.lexists(path)))])


def after_edit(base: Dataset, edited: Dataset) -> str:
    """What comes after an edit: a trained run draws it; training where there is none, the report where all have."""
    runs = list(_runs_that_draw(base, edited))
    if not runs:
        return after_layers(base, TRUTH)
    undrawn = [(run, record) for run, record in runs if not _is_predicted(variant_root(run, edited.name))]
    if not undrawn:
        return report_command(runs[0][0])
    run, record = min(undrawn, key=lambda item: (item[1].get("method") != "light-path", item[0]))
    command = ["model", "render", "--run", str(run), "--variant", edited.name]
    found = real_path(Path(str(record.get("dataset")))) == real_path(base.root)
    return shlex.join(command if found else [*command, "--dataset", str(base.root)])


def report_command(run: Path) -> str:
    """The report of the folder RUNS in which a run is RUNS/SCENE/NAME."""
    root = os.path.normpath(run / ".." / "..")
    return "eval report" if root == str(RUNS) else f"eval report --runs {shlex.quote(root)}"


def train_command(out: Path | None = None) -> str:
    """The command that trains a run of `paper` in a folder; that of a dataset where there is none to train on."""
    datasets = list_datasets()
    if not datasets:
        return build_command()
    named = [root for root in datasets if out is not None and root.name == out.parent.name]
    place = [] if out is None else ["--out", str(out)]
    return shlex.join(["model", "train", "paper", "--dataset", str([*named, *datasets][0]), *place])


def edit_command(base: Dataset, edited: Dataset) -> str:
    """The command that makes an edit again, or what it lacks."""
    assert edited.edit is not None
    words = [word for edit in edited.edit.edits for word in ("--edit", edit)]
    return shlex.join(["datagen", "build", "--dataset", str(base.root), *words])


def _runs_that_draw(base: Dataset, edited: Dataset) -> Iterator[tuple[Path, dict[str, Json]]]:
    geometries = list_geometries(edited)
    for path in sorted((RUNS / base.name).glob("*/run.json")):
        record = _read_record(path.parent)
        geometry = str(record.get("geometry"))
        if record.get("dataset_seal") != base.seal or geometry not in geometries:
            continue
        is_current = record.get("layers_seal") in (base.seal, _layers_seal(base, geometry))
        is_able = record.get("method") not in BLIND_METHODS and (path.parent / "weights.pt").is_file()
        if is_current and is_able:
            yield path.parent, record


def _layers_seal(dataset: Dataset, geometry: str) -> str | None:
    """What names the straight layers of a geometry; None where it has none."""
    try:
        return dataset.layer_store(geometry).seal
    except HyalineError:
        return None


def _read_record(run: Path) -> dict[str, Json]:
    try:
        return load_sealed(run / "run.json")
    except HyalineError:
        return {}  # None there, or of another method's making.


def _is_predicted(folder: Path) -> bool:
    return (folder / "predictions.json").is_file()
