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
      edits/NAME/                        a dataset of its own: the scene after an edit, test splits alone, and
                                         footprints/ (format: datagen/data/edit_masks.py)
      proxies/KIND/proxies.json          sealed: one mesh per object, with SHA-256 and statistics
      proxies/KIND/meshes/NAME.ply
      proxies/KIND/layers/...            the same of the proxies
      heads/                             a second copy of every head (datagen/disk/heads.py)
      annexes/NAME/                      more truth, when asked for (data/variants.py): laid out like a dataset, but
                                         without a scene and meshes of its own
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
from jaxtyping import Float, UInt8

from datagen.disk.errors import DamagedError, HyalineError
from datagen.disk.heads import HEADS, keep_head, mend_command
from datagen.disk.names import check_name, check_relative, find_file
from datagen.disk.ownership import DATASET, begin, is_ours
from datagen.disk.reading import load_json, read_regular
from datagen.disk.records import Json, entry, from_json, shown, to_json
from datagen.disk.storage import (
    SEAL,
    commit,
    commit_same,
    commit_sealed,
    load_sealed,
    seal_bytes,
    seal_of,
    sha256,
    sha256_file,
)

if TYPE_CHECKING:
    from PIL.Image import Image

DATASET_VERSION = 1

Split = Literal[
    "train", "interpolating", "extrapolating", "extrapolating-10deg", "extrapolating-20deg", "extrapolating-40deg"
]
SPLITS: tuple[Split, ...] = ("train", "interpolating", "extrapolating")
"""Those that every dataset has."""
TEST_SPLITS: tuple[Split, ...] = ("interpolating", "extrapolating")
ANGLE_SPLITS: dict[Split, float] = {"extrapolating-10deg": 10, "extrapolating-20deg": 20, "extrapolating-40deg": 40}
"""Those that a dataset may have besides, in an annex: degrees outside of what training cameras cover."""

TRANSFORMS_FILES: dict[Split, str] = {
    "train": "transforms_train.json",
    "interpolating": "transforms_test.json",
    "extrapolating": "transforms_extrapolating.json",
    **{split: f"transforms_{split}.json" for split in ANGLE_SPLITS},
}

SPLIT_ORDER: dict[Split, int] = {split: place for place, split in enumerate(TRANSFORMS_FILES)}

MAX_VIEWS, MAX_SPP, MAX_DEPTH = 10_000, 1 << 20, 1000
"""Of a split, of a picture and of a light path: what is beyond has a slip in it."""
MAX_PNG_SIDE = 16384
"""Pixels: twice the largest dataset, whose decoding takes 1 GB."""
MAX_PNG_BYTES = 1 << 30

DATA_ROOT = Path("data")
"""Where commands put and look for datasets, relative to the working directory."""


@dataclass(frozen=True, kw_only=True)
class SplitConfig:
    """How one split is rendered."""

    views: int
    spp: int
    """Samples per pixel, both halves together; with a noise ceiling the number to start from."""

    def __post_init__(self) -> None:
        if not 0 <= self.views <= MAX_VIEWS or not 2 <= self.spp <= MAX_SPP:
            raise HyalineError(
                f"split: has {self.views} views of {self.spp} spp; expected at least 1 view and 2 spp, "
                f"at most {MAX_VIEWS:,} and {MAX_SPP:,}"
            )


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """What `datagen build` makes; two builds with equal configurations give equal bytes."""

    scene: str
    preset: str
    resolution: int
    """Width and height of the square images in pixels."""
    train: SplitConfig
    """0 views only in the dataset of an edited scene, on which nothing is trained."""
    interpolating: SplitConfig
    extrapolating: SplitConfig
    ceiling_db: float | None = None
    """Render each test view until its own noise ceiling reaches this; None renders a fixed number of samples."""
    max_depth: int = 24
    """Longest light path in segments."""
    seed: int = 0

    def __post_init__(self) -> None:
        check_name(self.scene, where="scene name")
        if not 1 <= self.resolution <= 8192:
            raise HyalineError(f"resolution: is {self.resolution}; expected 1 to 8192 pixels")
        for split in TEST_SPLITS:
            if self.split(split).views < 1:
                raise HyalineError(f"{split}: has {self.split(split).views} views; expected at least 1")
        if not 2 <= self.max_depth <= MAX_DEPTH:
            raise HyalineError(f"max_depth: is {self.max_depth}; expected 2 to {MAX_DEPTH} (12 or more for glass)")
        if not 0 <= self.seed < 2**63:
            raise HyalineError(f"seed: is {self.seed}; expected 0 or more, and at most 63 bits")
        if self.ceiling_db is not None and not 10 <= self.ceiling_db <= 80:
            raise HyalineError(f"ceiling_db: is {self.ceiling_db}; expected 10 to 80 dB")

    def split(self, split: Split) -> SplitConfig:
        """The size of a split; an annex with splits by angle has theirs as that of `extrapolating`."""
        sizes = {"train": self.train, "interpolating": self.interpolating, "extrapolating": self.extrapolating}
        return sizes["extrapolating" if split in ANGLE_SPLITS else split]


@dataclass(frozen=True, kw_only=True)
class DatasetObject:
    """One object as users of the dataset see it; its id is 1 + its place in `Dataset.objects`."""

    name: str
    is_glass: bool

    def __post_init__(self) -> None:
        check_name(self.name, where="object name")


@dataclass(frozen=True, kw_only=True)
class DatasetEdit:
    """What the dataset of an edited scene says of its edit."""

    base: str
    """Seal of the dataset whose scene was edited; both have the same test cameras."""
    edits: tuple[str, ...]
    """As `datagen.scene.edits.parse_edit` reads them, in the order in which they were made."""
    changed: tuple[str, ...]
    """Names of the objects that are not what they were: removed, moved, copied, of another material."""
    copies: dict[str, str]
    """The original's name by the name of each copy: objects that no renderer was trained on look like these."""

    def __post_init__(self) -> None:
        for name in (*self.changed, *self.copies, *self.copies.values()):
            check_name(name, where="object name")


@dataclass(frozen=True, kw_only=True, eq=False)
class Cameras:
    """The cameras of one split, all with square pixels and the same lens."""

    world_from_camera: Float[np.ndarray, "view 4 4"]
    """float64, OpenGL convention."""
    fov_x: float
    """Horizontal field of view in radians."""
    width: int
    height: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """An opened dataset: its immutable head. Views are read one by one."""

    root: Path
    config: DatasetConfig
    objects: tuple[DatasetObject, ...]
    seal: str
    """Hash of the head, which includes the hash of scene and cameras: names the data in a run's record."""
    edit: DatasetEdit | None = None
    """None unless this is another dataset's scene after an edit."""
    splits: tuple[Split, ...] = SPLITS
    """The splits that are there."""
    parent: "Dataset | None" = None
    """The dataset that this one is an annex of; scene and meshes are the parent's."""

    @property
    def name(self) -> str:
        return self.root.resolve().name

    @property
    def home(self) -> "Dataset":
        """The dataset that has the scene and the proxies: the parent, or itself."""
        return self.parent or self


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


def view_name(view: int) -> str:
    return f"{view:04d}"


def describe_views(views: Iterable[tuple[Split, int]]) -> str:
    """Views in words, such as `train 3-7, 12; extrapolating 0`."""
    by_split: dict[str, list[int]] = {}
    for split, view in sorted(views, key=lambda item: (SPLIT_ORDER[item[0]], item[1])):
        by_split.setdefault(split, []).append(view)
    parts = []
    for split, numbers in by_split.items():
        starts = [view for view in numbers if view - 1 not in numbers]
        ends = [view for view in numbers if view + 1 not in numbers]
        runs = [f"{start}" if start == end else f"{start}-{end}" for start, end in zip(starts, ends, strict=True)]
        parts.append(f"{split} {', '.join(runs)}")
    return "; ".join(parts)


def image_path(root: Path, split: Split, view: int) -> Path:
    """The 8-bit sRGB picture; its neighbour `.exr` holds the linear one."""
    return root / "images" / split / f"{view_name(view)}.png"


def record_path(root: Path, split: Split, view: int) -> Path:
    return root / "records" / split / f"{view_name(view)}.json"


# The head: dataset.json, scene/ and transforms_*.json


def write_head(root: Path, config: DatasetConfig, objects: tuple[DatasetObject, ...], cameras: dict[Split, Cameras],
               scene: Mapping[str, bytes], *, edit: DatasetEdit | None = None, parent: Dataset | None = None,
               replace: bool = False) -> Dataset:  # fmt: skip
    """Commits the head of a dataset, then the scene and the cameras that it promises; the caller holds the folder.

    Several processes may do the same at once. A head that stands there stays: whose it is says what is returned. Where
    it is the same, files of it that were lost or damaged are written anew.

    Args:
        scene: the files of the scene's folder, by path relative to it; none in an annex.
        parent: the dataset that this one is an annex of; it has the splits of `cameras` only.
        replace: take the place of a head of ours, whose views and further files the caller has removed.

    Raises:
        HyalineError: something else stands at `root`.
    """
    files = head_contents(scene, cameras)
    head: dict[str, Json] = {
        "version": DATASET_VERSION,
        "config": to_json(config),
        "objects": to_json(objects),
        "files": {path: sha256(data) for path, data in sorted(files.items())},
        **({} if edit is None else {"edit": to_json(edit)}),
    }
    if parent is not None:
        head |= {"annex_of": parent.seal, "splits": list(cameras)}
    if replace and is_ours(root, DATASET):
        commit(root / DATASET.head, seal_bytes(head))
    else:
        begin(root, DATASET, seal_bytes(head), files, is_proven=lambda: _has_record_of(root, seal_of(head)))
    dataset = open_dataset(root)
    if dataset.seal == seal_of(head):
        for path, data in files.items():
            commit_same(root / path, data)
    keep_head(root, root / DATASET.head)
    return dataset


def head_contents(scene: Mapping[str, bytes], cameras: Mapping[Split, Cameras]) -> dict[str, bytes]:
    """The files that a head promises, by path relative to the dataset."""
    files = {f"scene/{path}": data for path, data in scene.items()}
    return files | {TRANSFORMS_FILES[split]: transforms_bytes(poses, split) for split, poses in cameras.items()}


def _has_record_of(root: Path, seal: str) -> bool:
    """True when a view there was made under the head of this seal, which may have been lost since."""
    for path in root.glob("records/*/*.json"):
        try:
            if load_sealed(path).get("dataset") == seal:
                return True
        except HyalineError:
            continue
    return False


def dataset_files(root: Path) -> list[str]:
    """What may stand in a dataset's folder besides its head, its layers and what has a head of its own.

    By path relative to `root`, records first: without them, no view is there any more.
    """
    path = root / DATASET.head
    head = load_sealed(path)
    if head.get("version") != DATASET_VERSION:
        raise HyalineError(f"{path}: format version {head.get('version')!r}; this program reads {DATASET_VERSION}")
    config = from_json(DatasetConfig, head.get("config"), where=f"{path}: config")
    splits = from_json(tuple[Split, ...], head.get("splits", list(SPLITS)), where=f"{path}: splits")
    return [*view_files(config, splits), *head_files(root)]


def view_files(config: DatasetConfig, splits: Sequence[Split]) -> list[str]:
    """The files of all views, by path relative to the dataset: records first."""
    here = Path()
    views: list[tuple[Split, int]] = [(split, view) for split in splits for view in range(config.split(split).views)]
    records = [record_path(here, split, view) for split, view in views]
    pictures = [image_path(here, split, view) for split, view in views]
    return [path.as_posix() for path in (*records, *pictures, *(path.with_suffix(".exr") for path in pictures))]


def open_dataset(root: Path) -> Dataset:
    """The dataset in a folder, its head verified (its views are verified as they are read).

    Raises:
        HyalineError: no dataset there, a damaged head, another format version, or an annex of another dataset.
    """
    path = root / "dataset.json"
    if not path.is_file():
        from datagen.data.advice import where_datasets_are

        raise HyalineError(f"{root}: no dataset; {where_datasets_are(root)}")
    head = load_sealed(path)
    if head.get("version") != DATASET_VERSION:
        raise HyalineError(f"{path}: format version {shown(head.get('version'))}; this program reads {DATASET_VERSION}")
    parent = open_dataset(root.parent.parent) if "annex_of" in head else None
    if parent is not None and parent.seal != head["annex_of"]:
        raise HyalineError(f"{path}: belongs to a dataset that stood there before; build it again, or delete {root}")
    return Dataset(
        root=root,
        config=from_json(DatasetConfig, entry(head, "config", where=path), where=f"{path}: config"),
        objects=from_json(tuple[DatasetObject, ...], entry(head, "objects", where=path), where=f"{path}: objects"),
        seal=cast(str, load_json(path)[SEAL]),
        edit=from_json(DatasetEdit, head["edit"], where=f"{path}: edit") if "edit" in head else None,
        splits=SPLITS
        if parent is None
        else from_json(tuple[Split, ...], entry(head, "splits", where=path), where=f"{path}: splits"),
        parent=parent,
    )


def find_dataset(given: str | None, root: Path = DATA_ROOT) -> Path:
    """The dataset that `--dataset` means: a folder, a name under `root`, or the only one there.

    Raises:
        HyalineError: none or several fit.
    """
    if given is not None:
        named = Path(given)
        is_there = any((named / path).is_file() for path in ("dataset.json", f"{HEADS}/dataset.json"))
        return named if is_there or len(named.parts) > 1 else root / given
    found = list_datasets(root)
    if len(found) == 1:
        return found[0]
    if not found:
        from datagen.data.advice import build_command

        place = root if root == DATA_ROOT else root / "glass_table"
        raise HyalineError(f"{root}: no dataset there; make one with `{build_command(place)}`")
    raise HyalineError(f"{root}: holds {len(found)} datasets; choose one with --dataset: {', '.join(map(str, found))}")


def list_datasets(root: Path = DATA_ROOT) -> list[Path]:
    """Every dataset folder under `root`, sorted."""
    return sorted(path.parent for path in root.glob("*/dataset.json"))


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


def transforms_bytes(cameras: Cameras, split: Split) -> bytes:
    """The cameras of a split as NeRF tools read them."""
    from datagen.disk.storage import dump_json

    focal = 0.5 * cameras.width / math.tan(0.5 * cameras.fov_x)
    return dump_json({
        "convention": "transform_matrix is world_from_camera, OpenGL: +x right, +y up, looks along -z; world +z up; m",
        "camera_angle_x": cameras.fov_x,
        "fl_x": focal,
        "fl_y": focal,
        "cx": 0.5 * cameras.width,
        "cy": 0.5 * cameras.height,
        "w": cameras.width,
        "h": cameras.height,
        "frames": [
            {"file_path": f"images/{split}/{view_name(view)}", "transform_matrix": matrix.tolist()}
            for view, matrix in enumerate(cameras.world_from_camera)
        ],
    })  # fmt: skip


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


def check_files(root: Path, files: dict[str, str]) -> None:
    """Raises a DamagedError that names the first file whose bytes are not the promised ones."""
    for relative, promised in files.items():
        if sha256_file(find_file(root, relative, where=str(root))) != promised:
            path = root / relative
            raise DamagedError(f"{path}: damaged (checksum differs); mend it with `{mend_command(path)}`")


def read_image(dataset: Dataset, split: Split, view: int) -> UInt8[np.ndarray, "h w 3"]:
    """The 8-bit sRGB picture of a view, verified against its record."""
    path = image_path(dataset.root, split, view)
    files = read_record(dataset, split, view).files
    check_files(dataset.root, {key: value for key, value in files.items() if key.endswith(".png")})
    return read_png(path)


def read_png(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit RGB picture from any PNG.

    Raises:
        HyalineError: missing or not a picture.
    """
    return np.asarray(open_png(path).convert("RGB"))


def open_png(path: Path, *, size: int | None = None) -> "Image":
    """The picture in a PNG file, decoded, in the file's own mode; see `decode_png`.

    Raises:
        HyalineError: missing, or no regular file.
    """
    return decode_png(read_regular(path, at_most=MAX_PNG_BYTES), where=str(path), size=size)


def decode_png(data: bytes, *, where: str, size: int | None = None) -> "Image":
    """The picture in the bytes of a PNG file, in the file's own mode.

    Args:
        size: its width and height; nothing of a picture of another size is decoded.

    Raises:
        HyalineError: not a PNG of at most 8 bits a channel, too large, or of another size.
    """
    import io

    from PIL import Image

    if len(data) < 33 or data[:8] != b"\x89PNG\r\n\x1a\n" or data[12:16] != b"IHDR":
        raise HyalineError(f"{where}: not a PNG that can be read; expected an 8-bit sRGB PNG")
    width, height, depth = (int.from_bytes(data[at:end]) for at, end in ((16, 20), (20, 24), (24, 25)))
    if size is not None and (width, height) != (size, size):
        raise HyalineError(f"{where}: is {width} x {height} pixels; expected {size} x {size}, as the truth has")
    if not (0 < width <= MAX_PNG_SIDE and 0 < height <= MAX_PNG_SIDE):
        raise HyalineError(f"{where}: is {width} x {height} pixels; expected 1 to {MAX_PNG_SIDE} a side")
    if depth > 8:
        raise HyalineError(f"{where}: has {depth} bits a channel; expected 8-bit sRGB")
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            picture.load()
            return picture
    # Pillow answers a broken file with many kinds of exception (OSError, SyntaxError, ValueError, struct.error, ...).
    except Exception as error:
        raise HyalineError(f"{where}: not a PNG that can be read ({error})") from error


def png_bytes(image: UInt8[np.ndarray, "h w c"]) -> bytes:
    """The PNG file of an 8-bit picture; the same picture gives the same bytes."""
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()


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


def config_difference(old: object, new: object) -> str | None:
    """The first field in which two records of one class differ, as `name: old -> new`; None when equal."""
    for item in dataclasses.fields(cast(DatasetConfig, old)):
        before, after = getattr(old, item.name), getattr(new, item.name)
        if before != after:
            return f"{item.name}: {before} -> {after}"
    return None
