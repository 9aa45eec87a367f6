"""Owns the contract: what a dataset is, on disk and in memory. Imports neither Mitsuba nor torch.

Axis words, used in every annotation: `b` image in a batch, `ray`, `layer` (0 = nearest), `h`, `w`, `c` feature
channel, `tex_h`, `tex_w`, `vertex`, `face`, `view`. Images are `h w 3`; `uv` keeps its pair last.

Conventions: metres, radians, +z up. Cameras are `world_from_camera` (4, 4) in the OpenGL convention (+x right, +y up,
the camera looks along -z). Pixel (column i, row j) has its centre at (i + 0.5, j + 0.5), row 0 on top. Object ids are
1 + the object's place in the scene, 0 where a layer is empty. uv is in [0, 1], v up: texel row `(1 - v) tex_h - 0.5`.

    data/SCENE/
      dataset.json                       sealed, written first: version, configuration, objects, SHA-256 of the
                                         files of the next two lines
      scene/                             the scene as rendered: scene.json, meshes/*.ply; `--scene FOLDER` reads it
      transforms_{train,test,extrapolating}.json   cameras as NeRF tools read them; `test` is the interpolating split
      images/SPLIT/0000.png              8-bit sRGB: what metrics compare
      images/SPLIT/0000.exr              linear R G B, half floats, and `noise.*`: half the difference of two
                                         independent halves A and B (so A = RGB + noise, B = RGB - noise)
      records/SPLIT/0000.json            sealed, written last: a view exists only when its record verifies
      layers/straight/                   peeled layers of the true geometry (format: datagen/data/layers.py)
      layers/light-path/                 its light paths, when asked for (format: datagen/trace/light_path_layers.py)
      proxies/KIND/proxies.json          sealed: one mesh per object, with SHA-256 and statistics
      proxies/KIND/meshes/NAME.ply
      proxies/KIND/layers/...            the same of the proxies
      heads/                             a second copy of every head (datagen/disk/heads.py)
      variants/NAME/                     more truth, when asked for (data/variants.py): a dataset with the same scene or
                                         the same cameras
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import UInt8

from datagen.data.cameras import TRANSFORMS_FILES, Cameras
from datagen.data.config import SPLITS, DatasetConfig, Split
from datagen.data.paths import image_path, record_path
from datagen.data.png import read_png
from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.homes import mend_command
from datagen.disk.names import check_name, check_relative
from datagen.disk.ownership import DATASET
from datagen.disk.promises import check_files
from datagen.disk.reading import load_json
from datagen.disk.records import Json, entry, from_json, shown, to_json
from datagen.disk.storage import (
    SEAL,
    commit,
    commit_sealed,
    load_sealed,
    sha256,
    sha256_file,
)

DATASET_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class DatasetObject:
    """One object as users of the dataset see it; its id is 1 + its place in `Dataset.objects`."""

    name: str
    is_glass: bool

    def __post_init__(self) -> None:
        check_name(self.name, where="object name")


@dataclass(frozen=True, kw_only=True)
class SceneEdit:
    """How the scene of a variant differs from that of the dataset around it."""

    edits: tuple[str, ...]
    """As `datagen.scene.edits.parse_edit` reads them, in the order in which they were made."""
    changed: tuple[str, ...]
    """Names of the objects that are not what they were: removed, moved, copied, of another material."""
    copies: dict[str, str]
    """The original's name by the name of each copy: objects that no renderer was trained on look like these."""

    def __post_init__(self) -> None:
        for name in (*self.changed, *self.copies, *self.copies.values()):
            check_name(name, where="object name")


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What a dataset inside another one says of itself."""

    of: str
    """Seal of the dataset around it."""
    splits: tuple[Split, ...]
    """The splits that it has."""
    edit: SceneEdit | None = None
    """None: scene, meshes and proxies are those of the dataset around it. Otherwise its test cameras are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """An opened dataset: its immutable head. Views are read one by one."""

    root: Path
    config: DatasetConfig
    objects: tuple[DatasetObject, ...]
    seal: str
    """Hash of the head, which includes the hash of scene and cameras: names the data in a run's record."""
    variant: Variant | None = None
    """None unless this is a variant of the dataset around it."""
    parent: "Dataset | None" = None
    """The dataset that this one is a variant of."""

    @property
    def name(self) -> str:
        return self.root.resolve().name

    @property
    def home(self) -> "Dataset":
        """The dataset that has the scene and the proxies: the parent, or itself."""
        return self if self.parent is None or self.edit is not None else self.parent

    @property
    def splits(self) -> tuple[Split, ...]:
        """The splits that are there."""
        return SPLITS if self.variant is None else self.variant.splits

    @property
    def edit(self) -> SceneEdit | None:
        """How the scene differs from the parent's; None where it does not, or there is none."""
        return None if self.variant is None else self.variant.edit


@dataclass(frozen=True, kw_only=True)
class ViewRecord:
    """What is known of one rendered view; written last."""

    dataset: str
    """The seal of the dataset that the view belongs to."""
    split: Split
    view: int
    seed: int
    spp: int
    """Samples per pixel that were really drawn, both halves together."""
    noise_mse: float
    """Estimated mean squared error of the clipped sRGB image against its own limit of infinitely many samples."""
    variant: str
    """The Mitsuba variant that rendered it."""
    files: dict[str, str]
    """SHA-256 by path, relative to the dataset."""


def open_dataset(root: Path) -> Dataset:
    """The dataset in a folder, its head verified (its views are verified as they are read).

    Raises:
        HyalineError: no dataset there, a damaged head, another format version, or a variant of another dataset.
    """
    path = root / "dataset.json"
    if not path.is_file():
        from datagen.data.finding import where_datasets_are

        raise HyalineError(f"{root}: no dataset; {where_datasets_are(root)}")
    head = load_sealed(path)
    if head.get("version") != DATASET_VERSION:
        raise HyalineError(f"{path}: format version {shown(head.get('version'))}; this program reads {DATASET_VERSION}")
    variant = variant_of(head, path)
    parent = None if variant is None else open_dataset(root.parent.parent)
    if variant is not None and parent is not None and parent.seal != variant.of:
        raise HyalineError(f"{path}: belongs to a dataset that stood there before; build it again, or delete {root}")
    return Dataset(
        root=root,
        config=from_json(DatasetConfig, entry(head, "config", where=path), where=f"{path}: config"),
        objects=from_json(tuple[DatasetObject, ...], entry(head, "objects", where=path), where=f"{path}: objects"),
        seal=cast(str, load_json(path)[SEAL]),
        variant=variant,
        parent=parent,
    )


def variant_of(head: Mapping[str, Json], path: Path) -> Variant | None:
    """What a variant's head says of it; None in the head of another dataset."""
    if old := sorted({"edit", "annex_of"} & head.keys()):
        raise HyalineError(
            f"{path}: says {old[0]!r}, as the format before `variants/` did; delete {path.parent} and build it again"
        )
    return from_json(Variant, head["variant"], where=f"{path}: variant") if "variant" in head else None


def head_files(root: Path) -> dict[str, str]:
    """SHA-256 of scene and camera files by path relative to the dataset, as the head promises them."""
    path = root / DATASET.head
    files = from_json(dict[str, str], entry(load_sealed(path), "files", where=path), where=f"{path}: files")
    return {check_relative(file, where=f"{path}: files"): promised for file, promised in files.items()}


def read_cameras(dataset: Dataset, split: Split) -> Cameras:
    """The cameras of one split, verified against the head."""
    relative = TRANSFORMS_FILES[split]
    path = dataset.root / relative
    if sha256_file(path) != entry(head_files(dataset.root), relative, where=dataset.root):
        raise DamagedError(f"{path}: damaged or edited (checksum differs); mend it with `{mend_command(path)}`")
    data = load_json(path)
    try:
        frames = cast(list[dict[str, Json]], data["frames"])
        return Cameras(
            world_from_camera=np.array([frame["transform_matrix"] for frame in frames], np.float64).reshape(-1, 4, 4),
            fov_x=float(cast(float, data["camera_angle_x"])),
            width=int(cast(int, data["w"])),
            height=int(cast(int, data["h"])),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise HyalineError(
            f"{path}: holds no cameras ({type(error).__name__}: {error}); expected those that `datagen build` writes"
        ) from error


# Views


def read_record(dataset: Dataset, split: Split, view: int) -> ViewRecord:
    """The record of a rendered view.

    Raises:
        HyalineError: the view is not built, damaged, or belongs to another dataset.
    """
    path = record_path(dataset.root, split, view)
    if not path.is_file():
        raise HyalineError(f"{path}: the view is not built yet; finish with `{mend_command(path)}`")
    record = from_json(ViewRecord, cast(Json, load_sealed(path)), where=str(path))
    if (record.dataset, record.split, record.view) != (dataset.seal, split, view):
        raise HyalineError(
            f"{path}: belongs to {record.split} view {record.view} of another dataset; "
            f"mend it with `{mend_command(path)}`"
        )
    picture = image_path(Path(), split, view)
    if set(record.files) != {picture.as_posix(), picture.with_suffix(".exr").as_posix()}:
        raise HyalineError(f"{path}: promises {', '.join(sorted(record.files))}; expected its view's pictures, "
                           f"mend it with `{mend_command(path)}`")  # fmt: skip
    return record


def commit_view(
    dataset: Dataset,
    split: Split,
    view: int,
    *,
    png: bytes,
    exr: bytes,
    seed: int,
    spp: int,
    noise_mse: float,
    variant: str,
) -> None:
    """Commits one rendered view: its pictures, then the record that makes them exist."""
    path = image_path(dataset.root, split, view)
    files = {}
    for file, data in ((path, png), (path.with_suffix(".exr"), exr)):
        commit(file, data)
        files[file.relative_to(dataset.root).as_posix()] = sha256(data)
    record = ViewRecord(
        dataset=dataset.seal,
        split=split,
        view=view,
        seed=seed,
        spp=spp,
        noise_mse=noise_mse,
        variant=variant,
        files=files,
    )
    commit_sealed(record_path(dataset.root, split, view), cast(dict[str, Json], to_json(record)))


def read_image(dataset: Dataset, split: Split, view: int) -> UInt8[np.ndarray, "h w 3"]:
    """The 8-bit sRGB picture of a view, verified against its record."""
    path = image_path(dataset.root, split, view)
    files = read_record(dataset, split, view).files
    check_files(dataset.root, {key: value for key, value in files.items() if key.endswith(".png")})
    return read_png(path)


def is_view_built(dataset: Dataset, split: Split, view: int) -> bool:
    """True when the view's record and all of its files verify."""
    try:
        check_files(dataset.root, read_record(dataset, split, view).files)
    except HyalineError:
        return False
    return True


def noise_ceiling_db(dataset: Dataset, split: Split) -> float:
    """The mean PSNR in dB that the truth's own noise would allow a perfect method on this split."""
    views = range(dataset.config.split(split).views)
    errors = [read_record(dataset, split, view).noise_mse for view in views]
    return float(np.mean([-10 * math.log10(max(error, 1e-12)) for error in errors]))
