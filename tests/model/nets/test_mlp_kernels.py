"""Tests of the compiled layers: equal to torch's own in float64, and not needed."""

import copy
import dataclasses
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from datagen.data.config import Resolution
from datagen.disk.storage import is_intact, make_private, write_hashed
from model.batches.rays import Pixels
from model.methods.paper import renderer as renderer_module
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.nets.cpu import fused_mlp, mlp_kernels
from model.nets.cpu.mlp_kernels import SWITCH, find_kernels
from model.nets.pixel_mlp import Norm, PixelMlp
from model.run.predict import predict_colors


@pytest.mark.skipif(
    not (sys.platform == "linux" and platform.machine() == "x86_64" and shutil.which("g++")),
    reason="no C++ compiler, or not Linux on x86-64",
)
def test_where_a_compiler_is_there_the_layers_are_built() -> None:
    assert find_kernels() is not None


needs_kernels = pytest.mark.skipif(find_kernels() is None, reason="no C++ compiler, or not Linux on x86-64")


def reference(net: PixelMlp, x: Tensor) -> Tensor:
    """What a network in float64 makes, by torch's own operations alone."""

    def unit(module: nn.Module, x: Tensor) -> Tensor:
        linear = module.get_submodule("linear")
        x = functional.linear(x, linear.get_parameter("weight"), linear.get_parameter("bias"))
        return functional.leaky_relu(module.get_submodule("norm")(x), 0.2)

    x = unit(net.first, x)
    for block in net.residual_blocks():
        x = unit(block.halve, x + unit(block.second, unit(block.first, x)))
    return functional.linear(x, net.last.weight, net.last.bias)


def distance(found: Tensor, expected: Tensor) -> float:
    found, expected = found.detach().double(), expected.detach()
    return float((found - expected).norm() / expected.norm().clamp_min(1e-30))


@needs_kernels
@pytest.mark.parametrize("norm", ["batch", "none"])
@pytest.mark.parametrize(("rows", "inputs", "width"), [(7, 5, 24), (64, 16, 16), (1000, 33, 40), (4097, 96, 88)])
def test_a_training_step_is_that_of_torch_in_float64(norm: Norm, rows: int, inputs: int, width: int) -> None:
    torch.manual_seed(rows)
    net = PixelMlp(inputs, width=width, blocks=3, norm=norm)
    for name, value in net.named_parameters():
        if "norm" in name:
            nn.init.uniform_(value, 0.5, 1.5)
    exact = copy.deepcopy(net).double()
    x = 3 + 2 * torch.randn(rows, inputs)
    upstream = torch.randn(rows, 3)
    own, exact_own = x.clone().requires_grad_(), x.double().requires_grad_()
    found, expected = net(own), reference(exact, exact_own)
    assert found.grad_fn is not None and "Chain" in type(found.grad_fn).__name__
    found.backward(upstream)
    expected.backward(upstream.double())
    assert distance(found, expected) < 1e-5
    assert own.grad is not None and exact_own.grad is not None
    # Where rounding moves a value across the kink of an activation, that pixel's gradient is another one.
    assert distance(own.grad, exact_own.grad) < 2e-3
    for (name, ours), theirs in zip(net.named_parameters(), exact.parameters(), strict=True):
        assert ours.grad is not None and theirs.grad is not None
        is_lost = norm == "batch" and name.endswith("linear.bias")  # Batch norm takes it away again.
        assert is_lost or distance(ours.grad, theirs.grad) < 2e-3, name
    for (name, ours), theirs in zip(net.named_buffers(), exact.buffers(), strict=True):
        assert distance(ours, theirs.double()) < 1e-5, name


@needs_kernels
def test_a_large_mean_does_not_drown_the_variance() -> None:
    torch.manual_seed(0)
    net = PixelMlp(4, width=8, blocks=0, norm="batch")
    with torch.no_grad():
        net.first.linear.bias.fill_(1000)
    x = torch.randn(5000, 4)
    exact = copy.deepcopy(net).double()
    assert distance(net(x), reference(exact, x.double())) < 1e-3


@needs_kernels
def test_equal_numbers_of_threads_give_equal_bits() -> None:
    torch.manual_seed(0)
    net, x = PixelMlp(96, width=88, blocks=3, norm="batch"), torch.randn(8191, 96)
    results = []
    for _ in range(3):
        net.zero_grad()
        y = net(x)
        y.square().sum().backward()
        results.append([y.detach(), *(value.grad.clone() for value in net.parameters() if value.grad is not None)])
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


def made_up_pixels(rows: int, layers: int, rng: np.random.Generator, *, share_empty: float) -> Pixels:
    there = (rng.random((rows, 1)) >= share_empty) & (rng.random((rows, layers)) < 0.6)
    return Pixels(
        uv=torch.from_numpy(rng.integers(0, 1 << 16, (rows, layers, 2)).astype(np.uint16).view(np.int16)),
        object_id=torch.from_numpy((rng.integers(1, 4, (rows, layers)) * there).astype(np.uint8)),
        rgb=torch.zeros(rows, 3, dtype=torch.uint8),
        p_camera=torch.from_numpy(rng.normal(size=(2, 3)).astype(np.float32)),
        resolution=Resolution(width=rows // 2, height=1),
    )


@needs_kernels
@pytest.mark.parametrize("extrinsics", ["none", "view"])
@pytest.mark.parametrize("zero_layer", [False, True])
@pytest.mark.parametrize(("rows", "features", "share_empty"), [(2, 3, 0.0), (3000, 16, 0.4), (66, 21, 1.0)])
def test_pictures_are_those_of_torch(
    extrinsics: str,
    zero_layer: bool,
    rows: int,
    features: int,
    share_empty: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    config = PaperConfig(
        texture_size=8,
        width=40,
        extrinsics="view" if extrinsics == "view" else "none",
        zero_layer=zero_layer,
        texture_features=features,
        position_size=8,
    )
    positions = torch.randn(3 * 64, 3) if extrinsics == "view" else None
    renderer = PaperRenderer(config, num_layers=5, num_objects=3, positions=positions).eval()
    nn.init.normal_(renderer.textures.get_parameter("table"))
    pixels = made_up_pixels(rows, 5, rng, share_empty=share_empty)
    found = predict_colors(renderer, pixels)
    for module in (renderer_module, fused_mlp):
        monkeypatch.setattr(module, "find_kernels", lambda: None)
    expected = predict_colors(renderer, pixels)
    error = (found - expected).abs().max() / expected.abs().max()
    assert error < 1e-5


@needs_kernels
def test_layers_may_lie_behind_each_other_in_memory() -> None:
    torch.manual_seed(0)
    rng = np.random.default_rng(1)
    renderer = PaperRenderer(
        PaperConfig(texture_size=8, width=32, extrinsics="none"), num_layers=4, num_objects=3, positions=None
    ).eval()
    nn.init.normal_(renderer.textures.get_parameter("table"))
    pixels = made_up_pixels(500, 4, rng, share_empty=0.2)
    uv, object_id = pixels.uv.transpose(0, 1).contiguous().transpose(0, 1), pixels.object_id.T.contiguous().T
    expected = predict_colors(renderer, pixels)
    assert torch.equal(expected, predict_colors(renderer, dataclasses.replace(pixels, uv=uv, object_id=object_id)))
    assert torch.equal(expected, predict_colors(renderer, dataclasses.replace(pixels, uv=uv)))


@pytest.fixture
def fresh_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache, in which the compiled layers are looked for anew."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    find_kernels.cache_clear()
    yield tmp_path / "hyaline" / "kernels"
    find_kernels.cache_clear()


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled layers in a cache of their own, as they were built."""
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        find_kernels.cache_clear()
        assert find_kernels() is not None
    find_kernels.cache_clear()
    (built,) = (cache / "hyaline" / "kernels").iterdir()
    return built


@pytest.fixture
def builds(library: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The libraries that were built; each is a copy, since compiling one takes a second."""
    paths: list[Path] = []

    def build(compiler: str, path: Path) -> Path:
        paths.append(path)
        return Path(shutil.copy(library, path))

    monkeypatch.setattr(mlp_kernels, "_build", build)
    return paths


def told_when_found(capsys: pytest.CaptureFixture[str]) -> str:
    """What is said while the compiled layers are looked for, as another process would."""
    find_kernels.cache_clear()
    assert find_kernels() is not None
    return capsys.readouterr().err


@needs_kernels
@pytest.mark.parametrize("damage", ["half", "flipped", "empty", "foreign", "link", "writable"])
def test_a_library_in_doubt_is_never_loaded_but_built_anew_and_then_kept(
    library: Path, fresh_search: Path, builds: list[Path], capsys: pytest.CaptureFixture[str], damage: str
) -> None:
    assert library.stat().st_mode & 0o777 == 0o600 and library.parent.stat().st_mode & 0o777 == 0o700
    built = Path(shutil.copytree(library.parent, fresh_search)) / library.name
    assert told_when_found(capsys) == "" and builds == []
    intact = built.read_bytes()
    flipped = bytearray(intact)
    flipped[len(intact) // 3] ^= 8
    place = fresh_search.parent
    (place / "foreign.c").write_text(
        f'#include <stdio.h>\n__attribute__((constructor)) static void run() {{ fopen("{place}/it ran", "w"); }}'
    )
    subprocess.run(["g++", "-shared", "-fPIC", "-o", place / "foreign.so", place / "foreign.c"], check=True)
    built.unlink()
    match damage:
        case "half":
            built.write_bytes(intact[: len(intact) // 2])
        case "flipped":
            built.write_bytes(flipped)
        case "empty":
            built.touch()
        case "foreign":
            built.write_bytes((place / "foreign.so").read_bytes())
        case "link":
            write_hashed(place / "elsewhere.so", (place / "foreign.so").read_bytes())
            built.symlink_to(place / "elsewhere.so")
        case _:
            built.write_bytes(intact)
            built.chmod(0o666)
    told = told_when_found(capsys)
    assert told == f"{built}: damaged, or not written by this user; building the compiled layers again\n"
    assert is_intact(built) and not built.is_symlink()
    assert told_when_found(capsys) == "" and len(builds) == 1
    assert not (place / "it ran").exists()


@needs_kernels
@pytest.mark.usefixtures("builds")
@pytest.mark.parametrize("wrong", ["open to others", "a link", "a file"])
def test_a_cache_in_which_others_may_write_is_not_used(
    fresh_search: Path, capsys: pytest.CaptureFixture[str], wrong: str
) -> None:
    fresh_search.parent.mkdir()
    match wrong:
        case "open to others":
            fresh_search.mkdir()
            fresh_search.chmod(0o777)
        case "a link":
            (fresh_search.parent / "other").mkdir()
            fresh_search.symlink_to(fresh_search.parent / "other")
        case _:
            fresh_search.touch()
    told = told_when_found(capsys)
    assert told.startswith(f"{fresh_search}: ") and told.count("\n") == 1
    assert "the compiled layers are built for this run only" in told
    assert not fresh_search.is_dir() or not list(fresh_search.iterdir())


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to somebody else")
def test_what_belongs_to_somebody_else_is_not_trusted(tmp_path: Path) -> None:
    write_hashed(tmp_path / "library.so", b"code")
    assert is_intact(tmp_path / "library.so") and make_private(tmp_path) is None
    os.chown(tmp_path / "library.so", 1, 1)
    assert not is_intact(tmp_path / "library.so")
    os.chown(tmp_path, 1, 1)
    assert make_private(tmp_path) == f"{tmp_path}: belongs to user 1"


@needs_kernels
def test_a_compiler_that_fails_leaves_everything_to_torch_and_says_so(
    fresh_search: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    broken = tmp_path / "c++"
    broken.write_text('#!/bin/sh\n[ "$1" = --version ] && echo broken && exit 0\necho no such header >&2\nexit 1\n')
    broken.chmod(0o755)
    monkeypatch.setenv("CXX", str(broken))
    assert find_kernels() is None
    said = capsys.readouterr()
    assert "torch" in said.err and "no such header" in said.err and SWITCH in said.err
    assert not list(fresh_search.iterdir())


def test_the_switch_leaves_everything_to_torch(fresh_search: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, "off")
    assert find_kernels() is None
    torch.manual_seed(0)
    net = PixelMlp(10, width=8, blocks=1, norm="batch")
    assert "Chain" not in type(net(torch.randn(5, 10)).grad_fn).__name__
    assert not fresh_search.exists()
