"""A run's folder: what was trained on what, its state, and its files.

    RUN/run.json                    with checksum, written first: the configuration and what it was trained on
    RUN/run.next.json               the next run.json, while --overwrite deletes the files of the run before
    RUN/metrics.jsonl               a line per evaluation: step, loss (mean since the line before), held_out_psnr
    RUN/snapshots/000500.png        a picture per evaluation: held-out views and predictions (run/logs.py)
    RUN/tensorboard/...             with --tensorboard: event files (run/logs.py)
    RUN/costs.json                  with --costs: the time and memory that training took (run/logs.py)
    RUN/checkpoint.pt               while training: everything that a resumed run needs (format: run/checkpoint.py)
    RUN/weights.pt                  after training: only the renderer, with the configuration and the digests of its
                                    data; the checkpoint is deleted then
    RUN/predictions/SPLIT/0000.png  8-bit sRGB
    RUN/predictions.json            with checksum, written last: SHA-256 of each prediction, and the digests of the
                                    dataset and of run.json; it marks a finished run
    RUN/variants/NAME/...           predictions of variants of the dataset (format: model/run/predict.py)

Except for TensorBoard's files and costs.json, nothing depends on time, host or thread count: the same command gives the
same bytes (on the same machine).
"""

import dataclasses
import itertools
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from datagen.data.config import ANGLE_SPLITS, TEST_SPLITS
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import describe_geometry
from datagen.data.paths import find_dataset, view_name
from datagen.data.variants import ANGLES, has_variant, open_variant, variant_root
from datagen.data.variants import VARIANTS_FOLDER as VARIANTS
from datagen.disk.errors import HyalineError, shown
from datagen.disk.ownership import FolderKind, begin, is_ours, refuse_others, refuse_taken, remove_files
from datagen.disk.records import (
    SEAL,
    Json,
    commit_sealed,
    from_json,
    load_json,
    load_sealed,
    parse_json,
    seal_of,
    to_json,
)
from datagen.disk.storage import check_files, commit, read_regular
from model.methods.protocol import Inputs, MethodConfig
from model.methods.table import METHODS, open_inputs
from model.run.logs import COSTS, EVENTS, SNAPSHOTS, list_events, list_snapshots
from model.settings import AMOUNT, COUNT, RUNS, SEED, PixelOptimisation, unflagged

RUN_VERSION = 5

OPEN: dict[str, Json] = {}
"""Placeholder for a method's record while the rest of a configuration is read."""

RUN, METRICS, PREDICTIONS, WEIGHTS = "run.json", "metrics.jsonl", "predictions.json", "weights.pt"
CHECKPOINT, NEXT_RUN = "checkpoint.pt", "run.next.json"


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


def _is_run(path: Path) -> bool:
    try:
        _read_record(path)
    except HyalineError:
        return False
    return True


FOLDER = FolderKind(
    what="run", head=RUN, folders=("predictions", "variants/*/predictions", SNAPSHOTS, EVENTS), holds_head=_is_run
)
"""A run of `model train`; not a folder with a foreign method's pictures and a run.json of its own."""


def describe_knowledge(dataset: Dataset, geometry: str, *more: str) -> str:
    """A method's inputs besides images and cameras, in words; empty ones are left out."""
    return ", ".join([describe_geometry(dataset, geometry), *filter(None, more)])


def begin_run(out: Path, record: RunRecord, *, overwrite: bool) -> None:
    """Writes the record of a run that starts or resumes; `overwrite` first deletes the run that is there.

    If it is killed at any moment, the folder holds the old run or a new one: never files without a record.
    """
    content = cast(dict[str, Json], to_json(record))
    if overwrite and is_ours(out, FOLDER):
        refuse_taken(out, FOLDER, [] if _is_run(out / NEXT_RUN) else [NEXT_RUN], [])
        commit_sealed(out / NEXT_RUN, content)
        finish_clearing(out)
    else:
        begin(out, FOLDER, content, replace=True)


def refuse_other_folders(out: Path) -> None:
    """Refuses a folder that is neither a run nor empty; names a run.json that cannot be read."""
    if os.path.lexists(out / RUN) and not _is_foreign(out):
        try:
            _read_record(out / RUN)
        except HyalineError as error:
            raise HyalineError(
                f"{str(error).partition('; ')[0]}; restore that file, move the folder away, or choose another --out"
            ) from error
    refuse_others(out, FOLDER)


def finish_clearing(out: Path) -> None:
    """Completes an --overwrite that was killed while it deleted files; otherwise does nothing."""
    if is_ours(out, FOLDER) and _is_run(out / NEXT_RUN):
        clear_run(out)
        (out / NEXT_RUN).replace(out / RUN)


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
    if _is_foreign(out):
        raise HyalineError(
            f"{out}: holds a foreign method's pictures, and no weights; expected the folder of a run of `model train` "
            "(`eval report` scores pictures of any method)"
        )
    if not (out / RUN).is_file():
        raise HyalineError(f"{out}: holds no run; `model train paper` makes one")
    return _read_record(out / RUN)


def _is_foreign(out: Path) -> bool:
    """True for a folder with a foreign method's pictures, with or without a run.json of its own."""
    if any((out / name).exists() for name in (WEIGHTS, CHECKPOINT)):
        return False
    if not os.path.lexists(out / RUN):
        return (out / "predictions").is_dir() or any(out.glob("*.png"))
    try:
        return SEAL not in load_json(out / RUN)
    except HyalineError:
        return False


def _read_record(path: Path) -> RunRecord:
    content = load_sealed(path)
    if content.get("version") != RUN_VERSION:
        raise HyalineError(
            f"{path}: format version {shown(content.get('version'))}; this program reads {RUN_VERSION}; train it again"
        )
    config = parse_config(content.get("config"), where=f"{path}.config")
    stand_in = cast(Json, {**content, "config": {**cast(dict[str, Json], content["config"]), "net": OPEN}})
    return dataclasses.replace(from_json(RunRecord, stand_in, where=str(path)), config=config)


def check_same_run(out: Path, config: TrainConfig, *, dataset_seal: str, layers_seal: str) -> None:
    """Raises a HyalineError that names the first difference between a run and a configuration or data.

    Labels, folder names and torch's version are not compared.
    """
    record = read_run(out)
    before, after = _entries(record.config), _entries(config)
    for key in {**after, **before}:
        if before.get(key) != after.get(key):
            raise HyalineError(
                f"{out}: holds a run with another {key}: {before.get(key)} there, {after.get(key)} here; "
                f"start over with --overwrite, or choose another --out"
            )
    if (record.dataset_seal, record.layers_seal) != (dataset_seal, layers_seal):
        what = "dataset" if record.dataset_seal != dataset_seal else "geometry or number of layers"
        raise HyalineError(f"{out}: was trained on another {what} than is there now; restore that, or train again")


def check_trained_on(out: Path, config: TrainConfig, dataset: Dataset) -> Inputs:
    """The inputs of a run of this configuration from a dataset; checked by `check_same_run`."""
    inputs = open_inputs(config.net, dataset, config.geometry)
    check_same_run(out, config, dataset_seal=dataset.seal, layers_seal=inputs.layers_seal)
    return inputs


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


def is_finished(out: Path, **seals: str) -> bool:
    """True if all predictions exist and verify, and their list has these digests, or none (in older runs).

    Args:
        seals: the result of `prediction_seals`.
    """
    try:
        check_files(out, read_prediction_hashes(out))
        stored = load_sealed(out / PREDICTIONS)
    except HyalineError:
        return False
    return all(stored.get(key, seal) == seal for key, seal in seals.items())


def prediction_seals(run: Path, home: Dataset) -> dict[str, str]:
    """The digests of dataset (or variant) and run that a list of predictions stores."""
    return {"dataset_seal": home.seal, "run_seal": seal_of(load_sealed(run / RUN))}


def is_drawn(run: Path, variant: Dataset) -> bool:
    """True if all of a run's pictures of this variant exist and verify."""
    return (run / RUN).is_file() and is_finished(variant_root(run, variant.name), **prediction_seals(run, variant))


def is_all_drawn(run: Path, dataset: Dataset) -> bool:
    """True if a run is finished, including the variants that `render_predictions` also draws."""
    return is_finished(run, **prediction_seals(run, dataset)) and all(
        is_drawn(run, variant) for variant in drawn_along(dataset)
    )


def drawn_along(dataset: Dataset) -> list[Dataset]:
    """The variants with further test splits, which cost no more than the dataset's own."""
    return [open_variant(dataset, ANGLES)] if has_variant(dataset, ANGLES) else []


def told_finished(out: Path) -> str:
    """What to say of a run that is asked for again."""
    return f"{out}: finished before, nothing to do; --overwrite trains it again"


def write_prediction_hashes(out: Path, files: dict[str, str], **seals: str) -> None:
    """Commits the list of pictures in the folder of a run or of a variant in it.

    Args:
        seals: the result of `prediction_seals`.
    """
    commit_sealed(out / PREDICTIONS, {"version": RUN_VERSION, **seals, "files": dict(files)})


def read_prediction_hashes(out: Path) -> dict[str, str]:
    """SHA-256 of each prediction by path relative to the folder of the run, or of a variant in it."""
    path = out / PREDICTIONS
    content = load_sealed(path)
    if content.get("version") != RUN_VERSION:
        raise HyalineError(f"{path}: format version {content.get('version')!r}; this program reads {RUN_VERSION}")
    files = from_json(dict[str, str], content.get("files"), where=f"{path}: files")
    for file in files:
        if not re.fullmatch(rf"predictions/({'|'.join((*TEST_SPLITS, *ANGLE_SPLITS))})/[0-9]{{4,}}\.png", file):
            raise HyalineError(f"{path}: lists {file!r}; expected predictions/SPLIT/0000.png")
    return files


def clear_run(out: Path) -> None:
    """Deletes only the files that a run has made; its record is kept until the next one replaces it."""
    remove_files(out, [PREDICTIONS, WEIGHTS, CHECKPOINT, METRICS, COSTS, *_pictures(out)])
    config = read_run(out).config
    remove_files(out, list_snapshots(out, evaluate_every=config.evaluate_every, steps=config.steps))
    remove_files(out, list_events(out))
    for folder in sorted(out.glob(f"{VARIANTS}/*")):
        name = folder.relative_to(out).as_posix()
        remove_files(out, [f"{name}/{PREDICTIONS}", *(f"{name}/{file}" for file in _pictures(folder))])


def _pictures(folder: Path) -> list[str]:
    """The predictions in a folder, by path relative to it, without files that others may have put there.

    These are the listed ones; if rendering was stopped before the list was written, those that it makes one by one.
    """
    try:
        return list(read_prediction_hashes(folder))
    except HyalineError:
        found = []
    for split in (*TEST_SPLITS, *ANGLE_SPLITS):
        names = (f"predictions/{split}/{view_name(view)}.png" for view in itertools.count())
        found += itertools.takewhile(lambda name: (folder / name).is_file(), names)
    return found


def write_metrics(out: Path, metrics: list[dict[str, Json]]) -> None:
    """Commits the lines of metrics.jsonl, or deletes it if there are none."""
    if metrics:
        commit(out / METRICS, "".join(json.dumps(line, allow_nan=False) + "\n" for line in metrics).encode())
    else:
        (out / METRICS).unlink(missing_ok=True)


def read_metrics(out: Path) -> list[dict[str, float | None]]:
    """The lines of metrics.jsonl, one per evaluation: step, loss, held_out_psnr in dB (None without held-out views)."""
    path = out / METRICS
    lines = read_regular(path).splitlines() if path.is_file() else []
    found = []
    for number, line in enumerate(lines, start=1):
        where = f"{path}: line {number}"
        found.append(from_json(dict[str, float | None], parse_json(line, where=where), where=where))
    return found


def _entries(config: TrainConfig) -> dict[str, Json]:
    """All settings by name."""
    data = cast(dict[str, dict[str, Json]], to_json(config))
    return {**data.pop("net"), **data.pop("loss"), **data}


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
