"""Runs on disk: folders of predicted pictures, with or without a record of how they were made.

    RUNS/SCENE/NAME/predictions/SPLIT/0000.png ...   8-bit sRGB, one a view of the split, the size of the truth
    RUNS/SCENE/NAME/variants/VARIANT/predictions/... the same of a variant of the dataset (datagen/data/variants.py)
    RUNS/SCENE/NAME/run.json                         optional: any of the keys of `Record`

    .../predictions.json                             next to each folder `predictions`, with checksum: SHA-256 of each
                                                     picture, to verify them, and dataset_seal and run_seal (of
                                                     run.json); optional if run.json has no checksum

A PNG's own checksums are always verified.
Test splits are scored; pictures of the training split are ignored.
"""

import dataclasses
import io
import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TypeGuard

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from datagen.data.config import SPLITS, Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.images import MAX_PNG_BYTES, decode_png
from datagen.data.paths import view_name
from datagen.data.variants import VARIANTS_FOLDER as VARIANTS
from datagen.disk.errors import HyalineError, printable, shown
from datagen.disk.records import MAX_JSON_BYTES, SEAL, Json, from_json, load_json, load_sealed, parse_json, seal_of
from datagen.disk.storage import check_regular, read_regular, real_path, sha256
from datagen.terminal.command import choose

RUN_VERSION = 5
"""The version of `model train`'s run.json (model/run/run_folder.py)."""
SRGB = (0.45455, 0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
"""As gAMA and cHRM chunks describe it: exponent; x and y of white, red, green and blue."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """The content of run.json, as `model train` writes it; a foreign method may leave out anything."""

    version: int | None = None
    method: str | None = None
    geometry: str | None = None
    knowledge: str | None = None
    """The method's inputs besides pictures and cameras, in words."""
    uses_materials: bool | None = None
    """Whether the method reads materials of surfaces."""
    told: tuple[str, ...] | None = None
    """Objects of which a fitted geometry tells more than was found of them: glass, and other materials than matt."""
    dataset: str | None = None
    """The dataset's folder."""
    dataset_seal: str | None = None
    layers_seal: str | None = None
    """Digest of the layers that it was trained on."""
    seed: int | None = None
    num_parameters: int | None = None
    num_texture_parameters: int | None = None
    num_layers: int | None = None
    """Straight layers that it uses."""
    label: str | None = None
    """What else distinguishes runs of one method, such as a preset."""
    config: dict[str, Json] | None = None
    """All settings; runs with equal settings and different seeds are averaged."""
    flags: dict[str, str] | None = None
    """The flags of `model train METHOD` that train it again, without dashes; a switch has no value."""
    torch: str | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One method's predictions for one dataset."""

    folder: Path
    name: str
    dataset: Dataset
    record: Record
    seal: str | None
    """Digest of the run.json of `model train`, whose pictures need their predictions.json; None for other methods."""
    promised: dict[str, str] | None
    """SHA-256 of each picture by path relative to the folder; None if it is not recorded."""


def list_run_folders(root: Path, *, besides: Path) -> list[Path]:
    """Every folder RUNS/SCENE/NAME, and runs at RUNS/NAME (`model train --out`), sorted.

    Links to neighbours (such as `latest`) are left out.

    Args:
        besides: the report's own folder, which is left out.
    """
    direct = {path for path in root.glob("*") if (path / "run.json").is_file() or (path / "predictions").is_dir()}
    nested = {path for path in root.glob("*/*") if path.parent not in direct and not path.name.startswith(".")}
    own = real_path(besides)

    def is_one(path: Path) -> bool:
        place = real_path(path)
        is_alias = path.is_symlink() and place.parent == real_path(path.parent)
        return path.is_dir() and not is_alias and own not in (place, *place.parents)

    return sorted(filter(is_one, direct | nested))


def has_predictions(folder: Path) -> bool:
    """True if the run has predictions; checks the names of splits."""
    splits = [path for path in sorted((folder / "predictions").glob("*")) if path.is_dir()]
    for path in splits:
        choose(f"{path}: split", path.name, SPLITS)
    return bool(splits)


def open_run(folder: Path, data_root: Path, given: Dataset | None = None) -> Run:
    """The run in a folder, with its dataset: the given one, the one that run.json names, or `data_root`/SCENE."""
    path = folder / "run.json"
    content = load_json(path) if os.path.lexists(path) else {}
    seal = None
    if SEAL in content:
        content = load_sealed(path)
        if (version := content.get("version")) != RUN_VERSION:
            raise HyalineError(
                f"{path}: format version {shown(version)}; this program reads {RUN_VERSION}; train it again"
            )
        seal = seal_of(content)
    config = content.pop("config", None)  # Of any keys: not a record here.
    if config is not None and not isinstance(config, dict):
        raise HyalineError(f"{path}: config is {shown(config)}; expected an object")
    record = from_json(Record, {key: item for key, item in content.items() if key != "type"}, where=str(path))
    texts = {key: printable(text) for key, text in vars(record).items() if isinstance(text, str)}
    record = dataclasses.replace(record, config=config, **texts)
    scenes = dict.fromkeys(path.parent.name for path in (folder.absolute(), real_path(folder)))
    own = given if given and (record.dataset_seal == given.seal or given.name in scenes) else None
    places = [own and own.root, record.dataset, *(data_root / scene for scene in scenes)]
    dataset = _find_dataset(folder, [Path(place) for place in places if place is not None], record.dataset_seal)
    promised = _read_promised(folder, dataset, seal)
    return Run(folder=folder, name=printable(folder.name), dataset=dataset, record=record, seal=seal, promised=promised)


def within(run: Run, folder: Path, dataset: Dataset) -> Run:
    """A run's predictions of a variant, in a folder inside the run's, as a run."""
    promised = _read_promised(folder, dataset, run.seal)
    return dataclasses.replace(run, folder=folder, dataset=dataset, promised=promised)


def _read_promised(folder: Path, dataset: Dataset, run_seal: str | None) -> dict[str, str] | None:
    """The pictures in a folder's list; raises a HyalineError if the list belongs to other data or another run."""
    path = folder / "predictions.json"
    if not path.is_file():
        return None
    content = load_sealed(path)
    for key, own in (("dataset_seal", dataset.seal), ("run_seal", run_seal)):
        if None not in (own, found := content.get(key)) and found != own:
            raise HyalineError(
                f"{path}: {key} is {str(found)[:12]}..., of other data or another run; expected {str(own)[:12]}...; "
                f"draw its pictures again with `{_render_command(folder)}`"
            )
    return from_json(dict[str, str], content.get("files"), where=f"{path}: files")


def prediction_path(run: Run, split: Split, view: int) -> Path:
    return run.folder / "predictions" / split / f"{view_name(view)}.png"


def has_split(run: Run, split: Split) -> bool:
    """True if the run predicted the split: all of its views, and no others."""
    folder = run.folder / "predictions" / split
    if not folder.is_dir():
        return False
    expected = [f"{view_name(view)}.png" for view in range(run.dataset.config.split(split).views)]
    if wrong := sorted({path.name for path in folder.glob("*.png")} ^ {*expected}):
        what = "missing" if wrong[0] in expected else "not a view of the split"
        span = f"{expected[0]} to {expected[-1]}, the {len(expected)} views of {run.dataset.root}"
        raise HyalineError(f"{folder / wrong[0]}: {what}; expected {span}")
    return True


def read_prediction(run: Run, split: Split, view: int) -> UInt8[np.ndarray, "h w 3"]:
    """One predicted picture."""
    path = prediction_path(run, split, view)
    data = _read_bytes(run, split, view)
    picture = decode_png(data, where=str(path), size=run.dataset.config.resolution)
    check_png(data, where=str(path))
    if picture.mode not in ("RGB", "RGBA", "L", "LA", "P"):
        raise HyalineError(f"{path}: its pixels are {picture.mode!r}; expected 8-bit sRGB")
    if picture.has_transparency_data and picture.convert("RGBA").getchannel("A").getextrema() != (255, 255):
        raise HyalineError(f"{path}: has transparent pixels; expected opaque ones, so blend it with its background")
    return np.asarray(picture.convert("RGB"))


def check_png(data: bytes, *, where: str) -> None:
    """Raises a HyalineError for a picture that can be decoded, but has a chunk with a wrong checksum, no end, or
    colours other than sRGB."""
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            picture.verify()
            said = picture.info
    except Exception as error:  # Of many kinds, as in `decode_png`.
        raise HyalineError(f"{where}: damaged ({error})") from error
    if "icc_profile" in said:
        profile = (said["icc_profile"] or b"").replace(b"\0", b"").lower()  # Version 4 has UTF-16.
        is_srgb = b"srgb" in profile and b"linear" not in profile
    else:
        found = said.get("gamma", SRGB[0]), *said.get("chromaticity", SRGB[1:])
        is_srgb = "srgb" in said or np.allclose(found, SRGB, rtol=0, atol=0.005)
    if not is_srgb:
        raise HyalineError(f"{where}: its ICC profile, gAMA or cHRM chunk is not sRGB's; convert it to 8-bit sRGB")


def _read_bytes(run: Run, split: Split, view: int) -> bytes:
    """The bytes of a prediction, verified against the recorded checksum if there is one."""
    path = prediction_path(run, split, view)
    if os.path.lexists(path):
        check_regular(path, run.folder, where=str(path.parent))
    data = read_regular(path, at_most=MAX_PNG_BYTES)
    relative = path.relative_to(run.folder).as_posix()
    if run.promised is None and run.seal is not None:
        what = f"{run.folder / 'predictions.json'}: missing, so the pictures cannot be verified"
    elif run.promised is not None and run.promised.get(relative) != sha256(data):
        what = "damaged (checksum differs)" if relative in run.promised else "not one of the run's pictures"
        what = f"{path}: {what}, according to {run.folder / 'predictions.json'}"
    else:
        return data
    raise HyalineError(f"{what}; render it again with `{_render_command(run.folder)}`")


def _render_command(folder: Path) -> str:
    """The command that renders the pictures of a run, or of a variant inside it."""
    is_variant = folder.parent.name == VARIANTS
    words = [str(folder.parent.parent), "--variant", folder.name] if is_variant else [str(folder)]
    return shlex.join(["model", "predict", *words])


def prediction_digests(run: Run, split: Split) -> list[str]:
    """SHA-256 of each of a run's pictures of a split, all verified."""
    return [sha256(_read_bytes(run, split, view)) for view in range(run.dataset.config.split(split).views)]


def _find_dataset(folder: Path, places: list[Path], seal: str | None) -> Dataset:
    """The first dataset of `places` with this digest; the first of all if the run has none."""
    datasets = [open_dataset(place) for place in places if (place / "dataset.json").is_file()]
    if not datasets:
        raise HyalineError(
            f"{folder}: no dataset at {' or '.join(dict.fromkeys(map(str, places)))}; name it by `report --dataset`, "
            "or set --data to the folder that contains it under the scene's name"
        )
    for dataset in datasets:
        if seal in (None, dataset.seal):
            return dataset
    raise HyalineError(
        f"{folder}: the predictions are for other data (dataset {str(seal)[:12]}...) than {datasets[0].root} "
        f"({datasets[0].seal[:12]}...); train again, or set --data to the right folder"
    )


def read_costs(folder: Path) -> dict[str, float]:
    """Seconds and bytes that `model train --costs` counted, by name; empty if the file is missing or damaged."""
    path = folder / "costs.json"
    if not path.is_file():
        return {}
    try:
        found = parse_json(read_regular(path, at_most=MAX_JSON_BYTES), where=str(path))
    except HyalineError:
        return {}
    return {key: float(value) for key, value in found.items() if is_number(value) and float(value) >= 0}


def is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
