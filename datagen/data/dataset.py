"""A dataset, on disk and in memory: opened once, then read view by view. Imports neither Mitsuba nor torch.

Axis words, used in every annotation: `b` image in a batch, `ray`, `layer` (0 = nearest), `h`, `w`, `c` feature
channel, `tex_h`, `tex_w`, `vertex`, `face`, `view`. Images are `h w 3`; `uv` keeps its pair last.

Conventions: metres, radians, +z up; cameras and pixels as in data/cameras.py. Object ids are 1 + the object's place in
the scene, 0 where a layer is empty. uv is in [0, 1], v up: texel row `(1 - v) tex_h - 0.5`.

    data/SCENE/
      dataset.json                       sealed, written first: version, configuration, objects, licence, SHA-256 of
                                         the files of the next two lines
      scene/                             the scene as rendered: scene.json, meshes/*.ply; `--scene FOLDER` reads it,
                                         with the cameras beside it where the scene lists them
      transforms_{train,test,extrapolating}.json   cameras as NeRF tools read them, with near and far (metres along the
                                         ray, data/cameras.py); `test` is the interpolating split
      images/SPLIT/0000.png              8-bit sRGB: what metrics compare
      images/SPLIT/0000.exr              linear R G B, half floats, and `noise.*`: half the difference of two
                                         independent halves A and B (so A = RGB + noise, B = RGB - noise)
      images/SPLIT/0000.mask.png         instead of the EXR, where pictures were imported with masks: 255 on glass
      images/SPLIT/0000.objects.png      and with one for each object of glass: 8-bit object ids, 0 elsewhere
      images/SPLIT/0000.depth.npy        and with depth: float32, metres along the axis to the first surface, 0: none
      records/SPLIT/0000.json            sealed, written last: a view exists only when its record verifies
      layers/straight/                   peeled layers of the true geometry (format: datagen/data/layers.py)
      proxies/KIND/proxies.json          sealed: one mesh per object, with SHA-256 and statistics
      proxies/KIND/meshes/NAME.ply
      proxies/KIND/layers/...            the same of the proxies
      variants/NAME/                     more truth, when asked for (data/variants.py): a dataset with the same scene or
                                         the same cameras
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import Image

from datagen.data.cameras import Camera, Cameras
from datagen.data.config import (
    DATASET_VERSION,
    RENDERED,
    SPLITS,
    TEST_SPLITS,
    DatasetConfig,
    DatasetObject,
    Head,
    Imported,
    SceneEdit,
    Split,
    Variant,
    ViewRecord,
    unknown_license,
)
from datagen.data.images import decode_exr, decode_png, read_npy
from datagen.data.layers import Layers, LayerStore, open_layers
from datagen.data.paths import HIDDEN, TRUTH, layers_root, where_datasets_are
from datagen.data.transforms import TRANSFORMS_FILES, parse_transforms
from datagen.disk.errors import DamagedError, HyalineError, shown
from datagen.disk.ownership import LAYERS
from datagen.disk.records import Json, checked, entry, from_json, load_sealed, seal_of
from datagen.disk.storage import MAKE_AGAIN, check_files, read_promised, real_path

Value = TypeVar("Value")


def read_head(root: Path) -> tuple[Head, str]:
    """The head of the dataset in a folder, and its seal."""
    path = root / "dataset.json"
    content = load_sealed(path)
    if (version := content.get("version")) != DATASET_VERSION:
        is_older = version in range(1, DATASET_VERSION)
        again = "build or import the dataset again in another folder" if is_older else "update hyaline"
        raise HyalineError(f"{path}: format version {shown(version)}; this program reads {DATASET_VERSION}, {again}")
    return from_json(Head, content, where=str(path)), seal_of(content)


class Opened:
    """What was made of files, kept for as long as each is the same one, unchanged. Another process opens its own."""

    def __init__(self) -> None:
        self._kept: dict[Path, tuple[tuple[int, int, int], object]] = {}

    def __reduce__(self) -> "tuple[type[Opened], tuple[()]]":
        return Opened, ()

    def get(self, path: Path, open_it: Callable[[], Value]) -> Value:
        """What `open_it` returned when the file at `path` was last new or changed."""
        try:
            status = path.stat()
        except OSError:
            return open_it()  # Which says what is wrong.
        mark = (status.st_ino, status.st_size, status.st_mtime_ns)
        if path not in self._kept or self._kept[path][0] != mark:
            self._kept[path] = (mark, open_it())
        return cast(Value, self._kept[path][1])


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """An opened dataset: its immutable head. What lies below it is opened when it is first asked for, and once.

    Every file is verified by the process that opens it: against the head, or a record that the head leads to.
    """

    root: Path
    config: DatasetConfig
    objects: tuple[DatasetObject, ...]
    seal: str
    """Hash of the head, which includes the hash of scene and cameras: names the data in a run's record."""
    files: Mapping[str, str]
    """SHA-256 of the files of scene and cameras, by path relative to `root`."""
    splits: tuple[Split, ...] = SPLITS
    """The splits that are there."""
    endings: tuple[str, ...] = RENDERED
    """Endings of the files of each view."""
    variant: Variant | None = None
    """None unless this is a variant of the dataset around it."""
    parent: "Dataset | None" = None
    """The dataset that this one is a variant of."""
    imported: Imported | None = None
    """None unless its pictures were rendered elsewhere."""
    stated_license: str | None = None
    """None in a variant, which has that of the dataset around it."""
    _opened: Opened = field(default_factory=Opened, repr=False)

    @property
    def name(self) -> str:
        return real_path(self.root).name

    @property
    def license(self) -> str:
        """An SPDX name such as CC0-1.0, what a foreign file said, or whom to ask."""
        if self.parent is not None:
            return self.parent.license
        return self.stated_license or unknown_license(f"dataset {self.name}")

    @property
    def home(self) -> "Dataset":
        """The dataset that has the scene and the proxies: the parent, or itself."""
        return self if self.parent is None or self.edit is not None else self.parent

    @property
    def edit(self) -> SceneEdit | None:
        """How the scene differs from the parent's; None where it does not, or there is none."""
        return None if self.variant is None else self.variant.edit

    @property
    def is_hidden(self) -> bool:
        """True for a hidden scene of hyaline-bench: only a verifier knows its light and colours."""
        return HIDDEN.fullmatch(self.config.scene) is not None

    @property
    def withheld(self) -> tuple[Split, ...]:
        """The splits whose pictures a verifier keeps: the test splits of a hidden scene as it is published."""
        kept = self.is_hidden and not any((self.root / "records" / split).exists() for split in TEST_SPLITS)
        return TEST_SPLITS if kept else ()

    @property
    def num_views(self) -> dict[Split, int]:
        """How many views each split has when it is complete."""
        return {split: self.config.split(split).views for split in self.splits}

    @checked
    def view(self, split: Split, index: int) -> "View":
        """One view; nothing is read yet."""
        self._check_split(split)
        if index not in range(self.num_views[split]):
            raise HyalineError(f"{self.root}: {split} has no view {index}; expected 0 to {self.num_views[split] - 1}")
        return View(dataset=self, split=split, index=index)

    def _check_split(self, split: Split) -> None:
        if split not in self.splits:
            raise HyalineError(f"{self.root}: has no split {split!r}; expected one of {', '.join(self.splits)}")

    def views(self, split: Split) -> "list[View]":
        """Every view of a split, in order."""
        self._check_split(split)
        return [View(dataset=self, split=split, index=index) for index in range(self.config.split(split).views)]

    def cameras(self, split: Split) -> Cameras:
        """The cameras of one split, verified against the head."""
        self._check_split(split)
        file = TRANSFORMS_FILES[split]

        def read() -> Cameras:
            promised = entry(self.files, file, where=self.root)
            return parse_transforms(read_promised(self.root, file, promised), where=str(self.root / file))

        return self._opened.get(self.root / file, read)

    @checked
    def layer_store(self, geometry: str = TRUTH) -> LayerStore:
        """The layers of a geometry, opened."""
        check_has_meshes(self)
        head = layers_root(self.root, geometry) / LAYERS.head
        return self._opened.get(head, lambda: open_layers(self.root, geometry, self.config.resolution))

    def object_id(self, name: str) -> int:
        """The id that layers hold of an object: 1 + its place among the dataset's objects."""
        names = [item.name for item in self.objects]
        if name not in names:
            raise HyalineError(f"{self.root}: has no object {name!r}; expected one of {', '.join(names)}")
        return 1 + names.index(name)

    def noise_ceiling_db(self, split: Split) -> float | None:
        """The mean PSNR in dB that the truth's noise and 8 bits would allow a perfect method on this split.

        None for imported pictures, whose noise is unknown, and for those that a verifier keeps.
        """
        views = () if split in self.withheld else self.views(split)
        known = [ceiling for view in views if (ceiling := view.record.ceiling_db) is not None]
        return float(np.mean(known)) if known else None


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """One view of a dataset. Each attribute is read from disk when it is asked for, and every byte of it verified."""

    dataset: Dataset
    split: Split
    index: int

    @property
    def record_path(self) -> Path:
        """Where the record is, once the view is there."""
        return self.dataset.root / f"records/{self.split}/{self.index:04d}.json"

    @property
    def record(self) -> ViewRecord:
        """How the view was rendered."""
        if self.split in self.dataset.withheld:
            raise HyalineError(
                f"{self.dataset.root}: has no pictures of test views, which a verifier of hyaline-bench keeps; predict "
                "these views, and send the verifier your runs"
            )
        return self.dataset._opened.get(self.record_path, self._read_record)

    def _read_record(self) -> ViewRecord:
        path = self.record_path
        if not path.is_file():
            raise HyalineError(f"{path}: the view is not built yet; {MAKE_AGAIN}")
        record = from_json(ViewRecord, cast(Json, load_sealed(path)), where=str(path))
        if (record.dataset, record.split, record.view) != (self.dataset.seal, self.split, self.index):
            raise HyalineError(f"{path}: belongs to {record.split} view {record.view} of another dataset; {MAKE_AGAIN}")
        if set(record.files) != set(map(self.file, self.dataset.endings)):
            raise HyalineError(f"{path}: promises other files than its view's pictures; {MAKE_AGAIN}")
        return record

    @property
    def is_built(self) -> bool:
        """True when the record and all files of the view verify."""
        try:
            check_files(self.dataset.root, self.record.files)
        except HyalineError:
            return False
        return True

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The 8-bit sRGB picture: what metrics compare."""
        return np.asarray(self._picture(".png").convert("RGB"))

    @property
    def radiance(self) -> Float32[np.ndarray, "h w 3"]:
        """Linear radiance (Rec. 709), unclipped: the mean of two independent halves A and B of the samples."""
        return self.radiance_and_noise()[0]

    @property
    def noise(self) -> Float32[np.ndarray, "h w 3"]:
        """(A - B) / 2, linear: one draw of the noise that is left in `radiance`, of which it has the variance."""
        return self.radiance_and_noise()[1]

    def radiance_and_noise(self) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]:
        """Both from one reading of their file."""
        if self.dataset.imported is not None:
            raise HyalineError(
                f"{self.dataset.root}: its radiance and noise are unknown; its pictures were imported, take `image`"
            )
        return decode_exr(self._read(".exr"), where=self._place(".exr"))

    @property
    def camera(self) -> Camera:
        """The view's camera."""
        return self.dataset.cameras(self.split)[self.index]

    @checked
    def layers(self, geometry: str = TRUTH) -> Layers:
        """The surfaces along each pixel's straight ray: of the scene's own meshes, or of proxies, such as `box`."""
        arrays = self.dataset.layer_store(geometry).read(self.split, self.index)
        return Layers(uv=np.moveaxis(arrays["uv"], 0, -1), object_id=arrays["object_id"], depth=arrays["depth"])

    @checked
    def object_ids(self, geometry: str = TRUTH) -> UInt8[np.ndarray, "layer h w"]:
        """The object ids of `layers` alone: a small part of what that reads."""
        return self.dataset.layer_store(geometry).read(self.split, self.index, only=["object_id"])["object_id"]

    @property
    def imported_mask(self) -> Bool[np.ndarray, "h w"] | None:
        """Pixels that see glass, by the mask that was imported; None where there was none."""
        has_mask = ".mask.png" in self.dataset.endings
        return np.asarray(self._picture(".mask.png").convert("L")) > 127 if has_mask else None

    @property
    def imported_depth(self) -> Float32[np.ndarray, "h w"] | None:
        """Metres along the axis to the first surface, 0 where there is none, as imported; None where there was none."""
        has_depth = ".depth.npy" in self.dataset.endings
        return read_npy(self._read(".depth.npy"), where=self._place(".depth.npy")) if has_depth else None

    @property
    def imported_object_ids(self) -> UInt8[np.ndarray, "h w"] | None:
        """Id of the object of glass that a pixel sees, by the masks that were imported, 0 elsewhere; None without."""
        return np.asarray(self._picture(".objects.png")) if ".objects.png" in self.dataset.endings else None

    @checked
    def mask(self, what: Literal["glass"]) -> Bool[np.ndarray, "h w"]:  # noqa: ARG002
        """Pixels whose centre ray meets glass before anything opaque, by the true geometry.

        Where that has no layers, or stand-ins for meshes, by the mask that was imported with the picture.
        """
        if (given := self.imported_mask) is not None and takes_imported_masks(self.dataset):
            return given
        is_glass = np.array([False, *(item.is_glass for item in self.dataset.objects)])
        return is_glass[self.object_ids()[0]]

    def file(self, ending: str) -> str:
        """Where the file with an ending is, by path relative to the dataset."""
        return f"images/{self.split}/{self.index:04d}{ending}"

    def _place(self, ending: str) -> str:
        return str(self.dataset.root / self.file(ending))

    def _picture(self, ending: str) -> Image.Image:
        return decode_png(self._read(ending), where=self._place(ending))

    def _read(self, ending: str) -> bytes:
        file = self.file(ending)
        return read_promised(self.dataset.root, file, self.record.files[file])


def has_layers(dataset: Dataset) -> bool:
    """True when the true geometry has straight layers."""
    return (layers_root(dataset.root, TRUTH) / LAYERS.head).is_file()


def check_has_meshes(dataset: Dataset) -> None:
    """Raises a HyalineError for a dataset whose pictures were imported without any mesh."""
    if not dataset.objects:
        raise HyalineError(
            f"{dataset.root}: has no meshes, since none were imported with its pictures; import them again with --mesh "
            "FILE and --overwrite"
        )


def takes_imported_masks(dataset: Dataset) -> bool:
    """True when imported masks tell the pixels that see glass: there are no layers, or those are of stand-ins."""
    given = dataset.imported
    return given is not None and given.has_masks and (given.has_objects or not has_layers(dataset))


def has_glass_mask(dataset: Dataset) -> bool:
    """True when layers of the true geometry, or imported masks, tell the pixels that see glass."""
    return has_layers(dataset) or takes_imported_masks(dataset)


def find_num_layers(dataset: Dataset, geometry: str) -> int | None:
    """How many layers a geometry was peeled into; None if it was not."""
    try:
        return dataset.layer_store(geometry).head.num_layers
    except HyalineError:
        return None


def open_dataset(root: Path) -> Dataset:
    """The dataset in a folder, its head verified (its views are verified as they are read)."""
    path = root / "dataset.json"
    if not path.is_file() and (root / "records").is_dir():
        raise DamagedError(f"{path}: is lost; restore it, or make the dataset in another folder")
    if not path.is_file():
        raise HyalineError(f"{root}: no dataset; {where_datasets_are()}")
    head, seal = read_head(root)
    parent = None if head.variant is None else open_dataset(root.parent.parent)
    if head.variant is not None and parent is not None and parent.seal != head.variant.of:
        raise HyalineError(f"{path}: belongs to a dataset that stood there before; build it again, or delete {root}")
    return Dataset(
        root=root,
        config=head.config,
        objects=head.objects,
        seal=seal,
        files=head.files,
        splits=head.splits,
        endings=head.endings,
        variant=head.variant,
        parent=parent,
        imported=head.imported,
        stated_license=head.license,
    )
