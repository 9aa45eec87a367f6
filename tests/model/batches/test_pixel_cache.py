"""Tests training data in mapped files: the same bits as in memory, bounded memory, and no damage unnoticed."""

import dataclasses
import errno
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from support.synthetic import write_synthetic_dataset
from support.training import SMALL, call, load, quick, run_bytes

from datagen.data.dataset import Dataset
from datagen.data.layer_writing import write_layers
from datagen.data.layers import Layers
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from model.batches import pixel_cache
from model.batches.pixel_cache import MappedPixels, cache_root, choose_memory, map_pixels
from model.batches.rays import Pixels, load_pixels, take_colors
from model.methods.table import BUILT_IN, METHODS
from model.run.train import train

CPU = torch.device("cpu")
VIEWS = [0, 1, 3, 6]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache/hyaline/pixels"


def assert_same_batches(one: Pixels, other: MappedPixels, index: torch.Tensor) -> None:
    expected, found = one.take(index, None), other.take(index, None)
    for item in dataclasses.fields(expected):
        before, after = getattr(expected, item.name), getattr(found, item.name)
        if isinstance(before, torch.Tensor):
            assert before.dtype == after.dtype and torch.equal(before, after), item.name
        else:
            assert before == after, item.name
    flat = index.flatten()
    assert torch.equal(take_colors(one, flat), take_colors(other, flat))


@pytest.mark.parametrize("max_layers", [None, 1, 3])
@pytest.mark.parametrize("whole_views", [False, True])
def test_mapped_pixels_make_the_batches_of_pixels_in_memory(
    dataset: Dataset, max_layers: int | None, whole_views: bool
) -> None:
    choices = {"max_layers": max_layers, "whole_views": whole_views}
    one = load_pixels(dataset, TRUTH, "train", VIEWS, **choices)
    other = map_pixels(dataset, TRUTH, "train", VIEWS, **choices)
    assert len(one.rgb) == len(other.rgb) == 4 * 32 * 32
    assert (one.chunk, one.pixels_per_view) == (other.chunk, other.pixels_per_view)
    rng = np.random.default_rng(0)
    assert_same_batches(one, other, torch.arange(len(one.rgb)))
    assert_same_batches(one, other, torch.from_numpy(rng.integers(len(one.rgb), size=(3, 8, 8))))
    if not whole_views:
        assert_same_batches(one, other, torch.from_numpy(rng.integers(len(one.rgb), size=500)))


@pytest.mark.parametrize("method", ["paper", "mlp-first"])
def test_a_run_from_mapped_files_has_the_same_bytes(dataset: Dataset, tmp_path: Path, method: str) -> None:
    net = dataclasses.replace(SMALL.net, zero_layer=True)  # pyright: ignore[reportArgumentType]
    config = dataclasses.replace(SMALL, method=method, net=net)
    for memory in ("ram", "mapped"):
        train(config, dataset, tmp_path / memory, label="it", device=CPU, memory=memory)
    assert run_bytes(tmp_path / "ram") == run_bytes(tmp_path / "mapped")


def test_a_cache_is_made_once_and_again_only_when_it_is_damaged(
    dataset: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one = load_pixels(dataset, TRUTH, "train", VIEWS)
    first = map_pixels(dataset, TRUTH, "train", VIEWS)
    with monkeypatch.context() as patch:
        patch.setattr(pixel_cache, "read_stack", None)
        map_pixels(dataset, TRUTH, "train", VIEWS)
    (folder,) = cache.iterdir()
    for name in ("starts.bin", "hits.bin", "rgb.bin", "cache.json"):
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 16
        (folder / name).unlink()  # Those who have it mapped keep it.
        (folder / name).write_bytes(data)
        capsys.readouterr()
        again = map_pixels(dataset, TRUTH, "train", VIEWS)
        said = capsys.readouterr().err
        assert f"{folder / name}: " in said and "writing the cache again" in said
        assert_same_batches(one, again, torch.arange(len(one.rgb)))
    shutil.rmtree(cache)
    assert_same_batches(one, first, torch.arange(len(one.rgb)))
    (folder.parent).mkdir(parents=True)
    rest = folder.with_name(f"{folder.name}.00.partial")
    rest.mkdir()
    os.utime(rest, (0, time.time() - 2 * pixel_cache.DAY_S))
    map_pixels(dataset, TRUTH, "train", VIEWS)
    assert list(cache.iterdir()) == [folder]


def test_another_content_is_another_cache(tmp_path: Path, cache: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data", resolution=8, train_views=3)
    map_pixels(dataset, TRUTH, "train", [0, 1])
    map_pixels(dataset, TRUTH, "train", [0, 2])
    map_pixels(dataset, TRUTH, "train", [0, 1], max_layers=2)
    assert len(list(cache.iterdir())) == 3
    layers = dataset.view("train", 1).layers()
    empty = Layers(uv=0 * layers.uv, object_id=0 * layers.object_id, depth=0 * layers.depth)
    write_layers(dataset, TRUTH, "train", 1, empty, overflow_share=0.0)
    mapped = map_pixels(dataset, TRUTH, "train", [0, 1])
    assert len(list(cache.iterdir())) == 4
    assert not mapped.take(torch.arange(64, 128), None).object_id.any()
    assert_same_batches(load_pixels(dataset, TRUTH, "train", [0, 1]), mapped, torch.arange(128))


def test_a_hit_behind_an_empty_layer_is_refused(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data", resolution=8, train_views=2)
    layers = dataset.view("train", 1).layers()
    object_id = layers.object_id.copy()
    object_id[0, object_id[1] > 0] = 0
    write_layers(dataset, TRUTH, "train", 1, dataclasses.replace(layers, object_id=object_id), overflow_share=0.0)
    with pytest.raises(HyalineError, match="train view 1, have a hit behind an empty layer; peel it again"):
        map_pixels(dataset, TRUTH, "train", [0, 1])
    assert list(cache_root().iterdir()) == []


def test_several_processes_may_lay_out_one_cache_at_once(dataset: Dataset, cache: Path) -> None:
    one = load_pixels(dataset, TRUTH, "train", VIEWS)
    with ThreadPoolExecutor(4) as pool:
        for other in pool.map(lambda _: map_pixels(dataset, TRUTH, "train", VIEWS), range(4)):
            assert_same_batches(one, other, torch.arange(len(one.rgb)))
    assert len(list(cache.iterdir())) == 1


# 60 views of 512 x 512 pixels with 8 hits each. Zeros are not stored, but are read like anything else.
BOUNDED = """
import sys
from pathlib import Path
import numpy as np
import model.batches.pixel_cache as cache

views, pixels, hits, held = 60, 512 * 512, 8, 32 << 20
folder = Path(sys.argv[1])
starts = (np.arange(pixels + 1) * hits).astype("<u4").tobytes()
with (folder / cache.STARTS).open("wb") as file:
    for _ in range(views):
        file.write(starts)
for name, size in ((cache.HITS, views * pixels * hits * 5 + 5), (cache.RGB, views * pixels * 3)):
    with (folder / name).open("wb") as file:
        file.truncate(size)

def peak():
    return next(int(line.split()[1]) << 10 for line in open("/proc/self/status") if line.startswith("VmHWM"))

files = cache._map_files(folder, [view * pixels * hits for view in range(views)], held)
rng = np.random.default_rng(0)
before = peak()
for _ in range(250):
    row = rng.integers(views * pixels, size=256)
    uv, object_id = files.read(row, hits)
    assert uv.shape == (256, hits, 2) and not files.rgb[row].any()
    files.let_go()
print(sum(path.stat().st_size for path in folder.iterdir()), peak() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells what a process holds of mapped files")
def test_memory_stays_bounded_whatever_the_size_of_the_files(tmp_path: Path) -> None:
    answer = subprocess.run([sys.executable, "-c", BOUNDED, tmp_path], capture_output=True, text=True, check=True)
    size, grown = map(int, answer.stdout.split())
    assert size > 700e6
    # 32 MiB, and what one batch brings: three rows in different places for each pixel, each with 16 pages.
    assert grown < (32 << 20) + 256 * 3 * (64 << 10) + (16 << 20)


def test_data_is_mapped_when_asked_for_or_when_it_does_not_fit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sizes = {"num_pixels": 1000, "num_layers": 8, "processes": 1, "device": CPU}
    monkeypatch.setattr(pixel_cache, "available_bytes", lambda: 2 * 43_000)
    assert not choose_memory("auto", **sizes) and not choose_memory("ram", **sizes) and choose_memory("mapped", **sizes)
    assert capsys.readouterr().err == ""
    assert choose_memory("auto", **{**sizes, "processes": 2})
    assert "maps it from" in capsys.readouterr().err
    monkeypatch.setattr(pixel_cache, "available_bytes", lambda: 2 * 43_000 - 1)
    assert choose_memory("auto", **sizes) and not choose_memory("ram", **sizes)
    assert not choose_memory("auto", **{**sizes, "num_layers": 0})
    with pytest.raises(HyalineError, match="memory: is mapped, but this method traces its layers"):
        choose_memory("mapped", **{**sizes, "num_layers": 0})
    monkeypatch.setattr(pixel_cache, "available_bytes", lambda: None)
    assert not choose_memory("auto", **sizes)


def test_the_command_maps_and_refuses_to_map_what_is_traced(
    dataset: Dataset,
    tmp_path: Path,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert call(monkeypatch, *quick(dataset, tmp_path / "run"), "--memory", "mapped") == 0
    assert len(list(cache.iterdir())) == 1
    assert call(monkeypatch, *quick(dataset, tmp_path / "other"), "--memory", "mapped", "--rays", "4") == 1
    assert "memory: is mapped, but this method traces" in capsys.readouterr().err


@pytest.mark.parametrize("method", [name for name in BUILT_IN if METHODS.find(name).reads_layers])
def test_every_method_on_stored_layers_can_be_fed_from_files(dataset: Dataset, method: str) -> None:
    pixels = load(METHODS.find(method)(), dataset, VIEWS, mapped=True)
    assert isinstance(pixels, MappedPixels)
    loaded = load(METHODS.find(method)(), dataset, VIEWS)
    assert_same_batches(loaded, pixels, torch.arange(2048))  # pyright: ignore


def test_a_full_disk_is_told_with_the_folder_of_the_cache(
    dataset: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError) as caught:
        map_pixels(dataset, TRUTH, "train", VIEWS)
    assert Path(caught.value.filename).parent == cache
    assert list(cache.iterdir()) == []
