"""A run's folder: what was trained on what, its state, and its files.

    RUN/run.json                    with checksum, written first: the configuration and what it was trained on
    RUN/metrics.jsonl, snapshots/, costs.json
                                    logs (format: model/run/logs.py)
    RUN/checkpoint.pt               while training: everything that a resumed run needs (format: model/state.py)
    RUN/weights.pt                  after training: only the renderer, with the configuration and the digests of its
                                    data; the checkpoint is deleted then
    RUN/predictions/SPLIT/0000.png  8-bit sRGB
    RUN/predictions.json            with checksum, written last: SHA-256 of each prediction, and the digests of the
                                    dataset and of run.json; it marks a finished run
    RUN/variants/NAME/...           predictions of a variant of the dataset: both of the above

Except for costs.json, nothing depends on time, host or thread count: the same command gives the same bytes (on the same
machine).
"""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from datagen.data.config import ANGLE_SPLITS, TEST_SPLITS
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import NO_GEOMETRY, describe_geometry, read_materials
from datagen.data.paths import find_dataset, is_fitted
from datagen.data.variants import ANGLES, VARIANTS_FOLDER, has_variant, open_variant, variant_root
from datagen.disk.errors import HyalineError, shown
from datagen.disk.ownership import FolderKind, begin, is_ours, remove_files
from datagen.disk.records import Json, commit_sealed, from_json, load_sealed, seal_of, to_json
from datagen.disk.storage import check_files
from model.methods.protocol import METHODS, Inputs, MethodConfig, open_inputs
from model.run.logs import COSTS, METRICS, SNAPSHOTS
from model.settings import AMOUNT, COUNT, NO_VGG, RUNS, SEED, PixelOptimisation, unflagged

RUN_VERSION = 5

OPEN: dict[str, Json] = {}
"""Placeholder for a method's record while the rest of a configuration is read."""

RUN, PREDICTIONS, WEIGHTS, CHECKPOINT = "run.json", "predictions.json", "weights.pt", "checkpoint.pt"

PICTURE = rf"predictions/({'|'.join((*TEST_SPLITS, *ANGLE_SPLITS))})/[0-9]{{4,}}\.png"

FOLDER = FolderKind(what="run", head=RUN, folders=("predictions", f"{VARIANTS_FOLDER}/*/predictions", SNAPSHOTS))
"""A run of `model train`; not a folder with a foreign method's pictures and a run.json of its own."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(PixelOptimisation):
    """The configuration of `model train`; equal configurations on equal data give equal bytes."""

    method: str
    geometry: str
    """`truth`, a kind of proxy or a mixture."""
    net: MethodConfig
    """The method's own record, complete."""
    seed: int = unflagged(0, limits=SEED)
    held_out_views: int = unflagged(4, limits=AMOUNT)
    """Most training views to hold out for the progress line's PSNR; never more than a fifth."""
    evaluate_every: int = unflagged(500, limits=COUNT)
    """Steps between two held-out PSNRs."""
    checkpoint_every: int = unflagged(1000, limits=COUNT)
    """Steps between two checkpoints; there is also one every minute. Each takes 15 MB for 18 textures of 64 x 64
    texels, 230 MB for 256 x 256."""


def parse_config(data: Json, *, where: str) -> TrainConfig:
    """The configuration that JSON describes; its method's record is found by the method's name."""
    if not isinstance(data, dict):
        raise HyalineError(f"{where}: is {shown(data)}; expected an object")
    if not isinstance(name := data.get("method"), str):
        raise HyalineError(f"{where}: method is {shown(name)}; expected the name of one")
    try:
        kind = METHODS.find(name)
    except HyalineError as error:
        raise HyalineError(f"{where}: {error}") from None
    net = from_json(kind, data.get("net"), where=f"{where}.net")
    return dataclasses.replace(from_json(TrainConfig, {**data, "net": OPEN}, where=where), net=net)


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """The content of run.json."""

    version: int
    method: str
    geometry: str
    knowledge: str
    """The method's inputs besides images and cameras."""
    uses_materials: bool = False
    """Whether the method reads materials of surfaces."""
    told: tuple[str, ...] = ()
    """Objects of which a fitted geometry tells more than `model fit` found: glass that it takes from the truth, and
    other objects that are not matt, if the method uses materials."""
    dataset: str
    """The dataset's folder as it was given."""
    dataset_seal: str
    layers_seal: str
    seed: int
    num_parameters: int
    """Parameters of the network, without textures."""
    num_texture_parameters: int
    num_layers: int | None = None
    """Stored straight layers that it looks up; None if it does not use any."""
    label: str
    """Label on the run's page and in the list of runs; tables of scores use the folder's name."""
    config: TrainConfig
    flags: dict[str, str] = dataclasses.field(default_factory=dict)
    """The flags of `model train METHOD DATASET` that train it again, without dashes; a switch has no value."""
    torch: str
    """Version of torch."""


def describe_run(
    config: TrainConfig, inputs: Inputs, *, label: str, flags: Mapping[str, str], num_parameters: Mapping[str, int]
) -> RunRecord:
    """The record of a run; torch is loaded by then.

    Args:
        num_parameters: of the `network`, and of its `textures`.
    """
    import torch

    method, dataset, geometry = config.net, inputs.dataset, config.geometry
    knowledge, told = method.knowledge, ()
    if method.uses_geometry:
        told = _told(config, dataset) if is_fitted(geometry) else ()
        materials = method.knowledge if told or not is_fitted(geometry) else ""  # Else a fit has found them.
        loss = "no perceptual loss" if flags.get("vgg-weights") == NO_VGG else config.loss.describe()
        parts = (describe_geometry(dataset, geometry), materials, loss)
        knowledge = ", ".join(filter(None, parts))
    return RunRecord(
        version=RUN_VERSION,
        method=config.method,
        geometry=geometry if method.uses_geometry else NO_GEOMETRY,
        knowledge=knowledge,
        uses_materials=method.uses_geometry and bool(method.knowledge),
        told=told,
        dataset=dataset.root.as_posix(),
        dataset_seal=dataset.seal,
        layers_seal=inputs.layers_seal,
        seed=config.seed,
        num_parameters=num_parameters["network"],
        num_texture_parameters=num_parameters["textures"],
        num_layers=inputs.num_layers or None,
        label=label,
        config=config,
        flags=dict(flags),
        torch=torch.__version__,
    )


def _told(config: TrainConfig, dataset: Dataset) -> tuple[str, ...]:
    """Names of the objects of which a fitted geometry tells the method more than `model fit` found."""
    from datagen.data.meshes import is_there
    from datagen.scene.folder import open_scene  # Not before: training on other geometries needs no scene.
    from datagen.scene.materials import Diffuse

    found = read_materials(dataset, config.geometry)
    return tuple(
        item.name
        for item in open_scene(dataset, config.geometry).objects
        if is_there(item.mesh)
        and item.name not in found
        and (item.material.is_glass or (config.net.knowledge and not isinstance(item.material, Diffuse)))
    )


def begin_run(out: Path, record: RunRecord, *, overwrite: bool) -> None:
    """Writes the record of a run that starts or resumes; `overwrite` first deletes the files of the run that is there.

    If it is killed at any moment, the folder holds the old run's record or the new one: never files without a record.
    """
    content = cast(dict[str, Json], to_json(record))
    if not is_ours(out, FOLDER):
        return begin(out, FOLDER, content)
    if overwrite:
        variant = rf"({VARIANTS_FOLDER}/[^/]+/)?"
        others = "|".join(map(re.escape, (WEIGHTS, CHECKPOINT, METRICS, COSTS)))
        own = re.compile(rf"{variant}({PREDICTIONS}|{PICTURE})|{others}|{SNAPSHOTS}/[0-9]{{6,}}\.png")
        paths = (path.relative_to(out).as_posix() for path in sorted(out.rglob("*")))
        remove_files(out, filter(own.fullmatch, paths))
    commit_sealed(out / RUN, content)


def list_runs(root: Path) -> list[str]:
    """The names of the runs in a folder, sorted: SCENE/NAME."""
    return sorted(path.parent.relative_to(root).as_posix() for path in root.glob(f"*/*/{RUN}"))


def find_run(name: Path, root: Path = RUNS) -> Path:
    """The folder of a run: `name` itself, or SCENE/NAME under `root`; raises a HyalineError if neither is a folder."""
    places = list(dict.fromkeys((name, root / name)))  # One place, if the name is an absolute path.
    folders = [place for place in places if place.is_dir()]
    if not folders:
        known = f"choose from {', '.join(runs)}" if (runs := list_runs(root)) else "`model train paper` makes one"
        raise HyalineError(f"no run at {' or '.join(map(str, places))}; {known}")
    return next((place for place in folders if (place / RUN).is_file()), folders[0])


def read_run(out: Path) -> RunRecord:
    """The record of a run."""
    path = out / RUN
    if not path.is_file():
        raise HyalineError(
            f"{out}: holds no run; `model train paper` makes one (`eval report` also scores pictures of other programs)"
        )
    content = load_sealed(path)
    if content.get("version") != RUN_VERSION:
        raise HyalineError(
            f"{path}: format version {shown(content.get('version'))}; this program reads {RUN_VERSION}; train it again"
        )
    config = parse_config(content.get("config"), where=f"{path}.config")
    stand_in = cast(Json, {**content, "config": {**cast(dict[str, Json], content["config"]), "net": OPEN}})
    return dataclasses.replace(from_json(RunRecord, stand_in, where=str(path)), config=config)


def check_trained_on(out: Path, config: TrainConfig, dataset: Dataset) -> Inputs:
    """The inputs of a run from a dataset.

    Labels, folder names and torch's version may differ from the run's record.

    Raises:
        HyalineError: naming the first difference between the run there and this configuration or data.
    """
    record, inputs = read_run(out), open_inputs(config.net, dataset, config.geometry)
    before, after = _entries(record.config), _entries(config)
    for key in {**after, **before}:
        if before.get(key) != after.get(key):
            raise HyalineError(
                f"{out}: holds a run with another {key}: {before.get(key)} there, {after.get(key)} here; "
                f"start over with --overwrite, or choose another --out"
            )
    for what, key in (("dataset", "dataset_seal"), ("geometry or number of layers", "layers_seal")):
        if getattr(record, key) != data_seals(inputs)[key]:
            raise HyalineError(f"{out}: was trained on another {what} than is there now; restore that, or train again")
    return inputs


def _entries(config: TrainConfig) -> dict[str, Json]:
    """All settings by name."""
    data = cast(dict[str, dict[str, Json]], to_json(config))
    return {**data.pop("net"), **data.pop("loss"), **data}


def data_seals(inputs: Inputs) -> dict[str, str]:
    """The digests of the training data that weights and checkpoints store."""
    return {"dataset_seal": inputs.dataset.seal, "layers_seal": inputs.layers_seal}


def check_state_of(state: Mapping[str, object], config: TrainConfig, inputs: Inputs, *, path: Path) -> None:
    """Raises a HyalineError for weights or a checkpoint copied from another run; older files have no digests."""
    if parse_config(cast(Json, state.get("config")), where=f"{path}: config") != config:
        raise HyalineError(f"{path}: its configuration differs from run.json; train with --overwrite")
    for key, own in data_seals(inputs).items():
        if (found := state.get(key, own)) != own:
            raise HyalineError(
                f"{path}: trained on other data ({key} {str(found)[:12]}...) than this run ({str(own)[:12]}...); "
                "restore its own file, or train again with --overwrite"
            )


def open_trained(run: Path, dataset: str | None = None) -> tuple[RunRecord, Dataset]:
    """A run's record and its dataset: the given one, or the one that the run was trained on."""
    record = read_run(run)
    if not dataset and not Path(record.dataset).is_dir():
        raise HyalineError(
            f"{run}: was trained on {record.dataset}, which is not there; call from the folder that holds it (predict, "
            "film and export also take --dataset)"
        )
    opened = open_dataset(find_dataset(dataset) if dataset else Path(record.dataset))
    check_trained_on(run, record.config, opened)
    return record, opened


# Predictions


def predictions_folder(run: Path, home: Dataset) -> Path:
    """Where a run's predictions of a dataset or of a variant lie, with their list."""
    return run if home.parent is None else variant_root(run, home.name)


def drawn_along(dataset: Dataset) -> list[Dataset]:
    """The variants with further test splits, which cost no more than the dataset's own."""
    return [open_variant(dataset, ANGLES)] if has_variant(dataset, ANGLES) else []


def is_drawn(run: Path, home: Dataset) -> bool:
    """True if all of a run's pictures of a dataset or of a variant exist and verify; older lists have no digests."""
    folder = predictions_folder(run, home)
    try:
        check_files(folder, read_predictions(folder))
        stored, own = load_sealed(folder / PREDICTIONS), _prediction_seals(run, home)
    except HyalineError:
        return False
    return all(stored.get(key, seal) == seal for key, seal in own.items())


def is_all_drawn(run: Path, dataset: Dataset) -> bool:
    """True if a run is finished, including the variants that `render_predictions` also draws."""
    return all(is_drawn(run, home) for home in (dataset, *drawn_along(dataset)))


def write_predictions(run: Path, home: Dataset, files: Mapping[str, str]) -> None:
    """Commits the list of a run's pictures of a dataset or variant: SHA-256 by path relative to their folder."""
    content = {"version": RUN_VERSION, **_prediction_seals(run, home), "files": dict(files)}
    commit_sealed(predictions_folder(run, home) / PREDICTIONS, content)


def read_predictions(folder: Path) -> dict[str, str]:
    """SHA-256 of each prediction by path relative to the folder of the run, or of a variant in it."""
    path = folder / PREDICTIONS
    content = load_sealed(path)
    if content.get("version") != RUN_VERSION:
        raise HyalineError(f"{path}: format version {content.get('version')!r}; this program reads {RUN_VERSION}")
    files = from_json(dict[str, str], content.get("files"), where=f"{path}: files")
    for file in files:
        if not re.fullmatch(PICTURE, file):
            raise HyalineError(f"{path}: lists {file!r}; expected predictions/SPLIT/0000.png")
    return files


def _prediction_seals(run: Path, home: Dataset) -> dict[str, str]:
    """The digests of dataset (or variant) and run that a list of predictions stores."""
    return {"dataset_seal": home.seal, "run_seal": seal_of(load_sealed(run / RUN))}
