"""Training data larger than memory: the hits of all pixels in memory-mapped files, from which batches take rows.

    CACHE/KEY/cache.json   with checksum: SHA-256 of the other files, first hit of each view
    CACHE/KEY/starts.bin   (view, pixel + 1) uint32: place of each pixel's first hit among those of its view
    CACHE/KEY/hits.bin     (hit,) of 5 bytes: uv, two uint16, and object id; nearest first; one of zeros comes last
    CACHE/KEY/rgb.bin      (view, pixel, 3) uint8

CACHE is hyaline/pixels in $XDG_CACHE_HOME, or in ~/.cache. KEY is a hash of everything that the content depends on, so
a cache is never outdated; all runs on the same views share it. A folder is created atomically, and may be deleted at
any time.
"""

import contextlib
import dataclasses
import hashlib
import mmap
import os
import secrets
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float32, Int, Int16, UInt8
from torch import Tensor

from datagen.data.config import Resolution, Split
from datagen.data.dataset import Dataset
from datagen.data.layers import UV_SCALE
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import remove_files
from datagen.disk.records import Json
from datagen.disk.storage import TEMPORARY, commit_sealed, dump_json, load_sealed, make_private, sha256, user_cache
from datagen.terminal.command import say, track
from model.batches.rays import RayBatch, grid_of, pixels_at_once, read_stack, to_device
from model.settings.run_flags import Memory

CACHE_VERSION = 1
STARTS, HITS, RGB = "starts.bin", "hits.bin", "rgb.bin"
HIT = np.dtype([("uv", "<u2", 2), ("object_id", "u1")])

LEAST_HELD_BYTES = 1 << 30
"""Least size of the mapped part of the files; it is this or a quarter of the free memory, plus one batch. (The kernel
caches more if memory is free.) Mapping again costs 2 to 4 us a row; a fault maps 16 pages at once."""

DAY_S = 24 * 3600


@dataclass(frozen=True, kw_only=True, eq=False)
class MappedFiles:
    """The files of a cache, mapped to be read at random places."""

    starts: np.ndarray
    """(view, pixel + 1) uint32."""
    hits: np.ndarray
    """(hit,) of `HIT`."""
    rgb: np.ndarray
    """(pixel, 3) uint8."""
    first_hit: Int[np.ndarray, " view"]
    """Place of each view's first hit."""
    mappings: tuple[mmap.mmap, ...]
    most_resident: int
    """Bytes of resident mapped files above which these are unmapped."""

    def read(
        self, row: Int[np.ndarray, " ray"], num_layers: int
    ) -> tuple[Int16[np.ndarray, "ray layer 2"], UInt8[np.ndarray, "ray layer"]]:
        """uv, as the bits of uint16, and object ids of the pixels with these row numbers; 0 where a layer is empty."""
        view, pixel = np.divmod(row, self.starts.shape[1] - 1)
        first = self.starts[view, pixel].astype(np.int64)
        count = self.starts[view, pixel + 1] - first
        layer = np.arange(num_layers)
        is_hit = layer < count[:, None]
        found = self.hits[((self.first_hit[view] + first)[:, None] + layer)[is_hit]]
        uv, object_id = np.zeros((*is_hit.shape, 2), np.uint16), np.zeros(is_hit.shape, np.uint8)
        uv[is_hit], object_id[is_hit] = found["uv"], found["object_id"]
        return uv.view(np.int16), object_id

    def let_go(self) -> None:
        """Unmaps the files if much of them is resident; the next read maps them again, from the kernel's cache."""
        if resident_file_bytes() > self.most_resident:
            for mapping in self.mappings:
                mapping.madvise(mmap.MADV_DONTNEED)


@dataclass(frozen=True, kw_only=True, eq=False)
class MappedPixels:
    """`Pixels` in files: gives the same batches, bit by bit."""

    files: MappedFiles
    rgb: UInt8[Tensor, "pixel 3"]
    """8-bit sRGB, mapped, so never on a GPU."""
    p_camera: Float32[Tensor, "view 3"]
    resolution: Resolution
    num_layers: int
    whole_views: bool
    device: torch.device

    @property
    def pixels_per_view(self) -> int:
        return self.resolution.pixels

    @property
    def chunk(self) -> int:
        return self.pixels_per_view if self.whole_views else pixels_at_once(self.device)

    def to(self, device: torch.device) -> "MappedPixels":
        return dataclasses.replace(self, p_camera=self.p_camera.to(device), device=device)

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> RayBatch:  # noqa: ARG002
        """The rays of the pixels with these row numbers: always those through pixel centres."""
        grid = grid_of(self, index, whole_views=self.whole_views)
        row = index.flatten().cpu().numpy()
        uv, object_id = self.files.read(row, self.num_layers)
        self.files.let_go()
        moved = to_device({"uv": uv, "object_id": object_id, "view": row // self.pixels_per_view}, self.device)
        return RayBatch(
            uv=(moved["uv"].int() & 0xFFFF).float() / UV_SCALE,
            object_id=moved["object_id"],
            p_camera=self.p_camera[moved["view"]],
            grid=grid,
        )


def map_pixels(
    dataset: Dataset,
    geometry: str,
    split: Split,
    views: Sequence[int],
    *,
    with_images: bool = True,
    max_layers: int | None = None,
    whole_views: bool = False,
) -> MappedPixels:
    """The result of `load_pixels`, from a cache that is written if it is missing or damaged.

    Every byte is verified: of the dataset when the cache is written, of the cache when it is opened.
    """
    assert with_images, "only training data is large"
    store = dataset.layer_store(geometry)
    num_layers = min(store.head.num_layers, max_layers or store.head.num_layers)
    content: dict[str, Json] = {
        "version": CACHE_VERSION,
        "dataset": dataset.seal,
        "layers": store.seal,
        "geometry": geometry,
        "split": split,
        "views": list(views),
        "num_layers": num_layers,
        "pictures": [cast(Json, dataset.view(split, view).record.files) for view in views],
        "hits": [cast(Json, store.record(split, view).files) for view in views],
    }
    if (wrong := make_private(cache_root())) is not None:
        raise HyalineError(f"{wrong}; or use --memory ram")
    folder = cache_root() / sha256(dump_json(content))[:32]
    files = _open(folder)
    if files is None:
        _remove(folder)  # Damaged, if anything.
        _lay_out(folder, dataset, geometry, split, views, num_layers)
        files = _open(folder)
        if files is None:
            raise HyalineError(f"{folder}: damaged right after it was written; delete it, or use --memory ram")
    with warnings.catch_warnings():
        # torch warns that writing to a read-only map is undefined; training pictures are never written to.
        warnings.filterwarnings("ignore", "The given NumPy array is not writ", UserWarning)
        rgb = torch.from_numpy(files.rgb)
    p_camera = dataset.cameras(split).world_from_camera[list(views), :3, 3].astype(np.float32)
    return MappedPixels(
        files=files,
        rgb=rgb,
        p_camera=torch.from_numpy(p_camera),
        resolution=dataset.config.resolution,
        num_layers=num_layers,
        whole_views=whole_views,
        device=torch.device("cpu"),
    )


def cache_root() -> Path:
    """The folder of all caches."""
    return user_cache("pixels")


def choose_memory(asked: Memory, *, num_pixels: int, num_layers: int, processes: int, device: torch.device) -> bool:
    """True if training data is to be mapped; prints the reason if that was not asked for.

    Args:
        num_layers: stored layers that are looked up; 0: none, and the data is small.
        processes: processes on this machine that hold the data.
    """
    if asked == "mapped" and not num_layers:
        raise HyalineError("memory: is mapped, but this method traces its layers and only holds colours; use ram")
    if asked != "auto" or not num_layers:
        return asked == "mapped"
    # Two bytes for each of u and v, one for the object. Concatenating the views needs everything twice for a while.
    size = num_pixels * (5 * num_layers + 3)
    rooms = [("memory", 2 * size * processes, available_bytes())]
    if device.type == "cuda":
        rooms.append(("the GPU's memory", size, torch.cuda.mem_get_info(device)[0] // 2))
    for what, needed, free in rooms:
        if free is not None and needed > free:
            say(
                f"training data would take {needed / 1e9:.1f} GB of {what}, where {free / 1e9:.1f} GB are free: "
                f"maps it from {cache_root()} (--memory ram loads it)"
            )
            return True
    return False


def available_bytes() -> int | None:
    """Memory available without swapping, on the machine or in this process's control group; None: unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None
    group = Path("/sys/fs/cgroup")
    try:
        most, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
        counts = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except OSError:
        return free
    # The kernel's file cache counts as used, but is given up when memory is needed.
    kept = int(counts.get("active_file", 0)) + int(counts.get("inactive_file", 0))
    return free if most == "max" else min(free, int(most) - int(used) + kept)


def resident_file_bytes() -> int:
    """Bytes of mapped files that are resident in this process; 0 if the system does not report them."""
    if sys.platform != "linux":
        return 0
    return int(Path("/proc/self/statm").read_text().split()[2]) * mmap.PAGESIZE


def _open(folder: Path) -> MappedFiles | None:
    """The cache in a folder; None if it is missing, or damaged, which is reported."""
    if not (folder / "cache.json").is_file():
        return None
    try:
        record = load_sealed(folder / "cache.json")
        for name, promised in cast(dict[str, str], record["files"]).items():
            with (folder / name).open("rb") as file:
                if hashlib.file_digest(file, "sha256").hexdigest() != promised:
                    raise HyalineError(f"{folder / name}: damaged (checksum differs)")
    except (HyalineError, FileNotFoundError) as error:
        say(f"{error}; writing the cache again")
        return None
    held_bytes = max(LEAST_HELD_BYTES, (available_bytes() or 0) // 4)
    return _map_files(folder, cast(list[int], record["first_hit"]), held_bytes)


def _map_files(folder: Path, first_hit: list[int], held_bytes: int) -> MappedFiles:
    mappings = {name: _map(folder / name) for name in (STARTS, HITS, RGB)}
    return MappedFiles(
        starts=np.frombuffer(mappings[STARTS], "<u4").reshape(len(first_hit), -1),
        hits=np.frombuffer(mappings[HITS], HIT),
        rgb=np.frombuffer(mappings[RGB], np.uint8).reshape(-1, 3),
        first_hit=np.array(first_hit, np.int64),
        mappings=tuple(mappings.values()),
        most_resident=resident_file_bytes() + held_bytes,
    )


def _map(path: Path) -> mmap.mmap:
    with path.open("rb") as file:
        mapping = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    mapping.madvise(mmap.MADV_RANDOM)  # Otherwise each row would read 128 KiB of its neighbours from the disk.
    return mapping


def _lay_out(
    folder: Path, dataset: Dataset, geometry: str, split: Split, views: Sequence[int], num_layers: int
) -> None:
    """Writes a cache, view by view, in a temporary folder that is then renamed."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    for old in folder.parent.glob(f"{folder.name}.*.partial"):
        if time.time() - old.stat().st_mtime > DAY_S:  # Of a process that was killed.
            _remove(old)
    partial = folder.with_name(f"{folder.name}.{secrets.token_hex(8)}.partial")
    partial.mkdir()
    try:
        digests = {name: hashlib.sha256() for name in (STARTS, HITS, RGB)}
        first_hit = [0]
        with (
            (partial / STARTS).open("wb") as starts,
            (partial / HITS).open("wb") as hits,
            (partial / RGB).open("wb") as rgb,
        ):
            files = {STARTS: starts, HITS: hits, RGB: rgb}

            def add(name: str, values: np.ndarray) -> None:
                data = np.ascontiguousarray(values).tobytes()
                digests[name].update(data)
                files[name].write(data)

            for view in track(views, label=f"cache {geometry}", total=len(views)):
                uv, object_id = read_stack(dataset, geometry, split, view, num_layers)
                is_hit = object_id > 0
                if (is_hit[:, 1:] & ~is_hit[:, :-1]).any() or uv[~is_hit].any():
                    raise HyalineError(
                        f"{dataset.root}: layers of {geometry}, {split} view {view}, have a hit behind "
                        "an empty layer; peel it again"
                    )
                found = np.empty(int(is_hit.sum()), HIT)
                found["uv"], found["object_id"] = uv[is_hit], object_id[is_hit]
                add(STARTS, np.concatenate([[0], np.cumsum(is_hit.sum(axis=1))]).astype("<u4"))
                add(HITS, found)
                add(RGB, dataset.view(split, view).image)
                first_hit.append(first_hit[-1] + len(found))
            add(HITS, np.zeros(1, HIT))  # An empty file cannot be mapped.
            for file in files.values():
                file.flush()
                os.fsync(file.fileno())
        hashes: dict[str, Json] = {name: digest.hexdigest() for name, digest in digests.items()}
        commit_sealed(partial / "cache.json", {"files": hashes, "first_hit": cast(Json, first_hit[:-1])})
        try:
            partial.rename(folder)
        except OSError:
            # Another process has just laid out the same.
            if not (folder / "cache.json").is_file():
                raise
    except OSError as error:
        # When the disk is full, the errors of writing and closing name no file.
        error.filename = error.filename or str(folder)
        raise
    finally:
        _remove(partial)


def _remove(folder: Path) -> None:
    """Deletes a cache's own files, and then its folder if it is empty."""
    rests = [path.name for path in folder.glob("cache.json.*") if TEMPORARY.fullmatch(path.name)]
    remove_files(folder, ["cache.json", STARTS, HITS, RGB, *rests])
    with contextlib.suppress(OSError):
        folder.rmdir()
