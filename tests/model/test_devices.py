"""Tests that no operation of a method mixes devices, without having a GPU; and what a GPU does, where there is one."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.pretend_cuda import CUDA, pretended_cuda
from support.traced_dataset import write_traced_dataset
from support.training import configured

from datagen.data.dataset import Dataset
from model.batches.rays import to_device
from model.methods.protocol import METHODS, open_inputs
from model.nets.learned_sky import LearnedSky
from model.nets.texture import constant_on, places_on
from model.run.predict import predict_pixels
from model.run.run_folder import WEIGHTS
from model.run.train import build_renderer, train

pytestmark = pytest.mark.usefixtures("one_thread")

CPU = torch.device("cpu")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")


@pytest.fixture(scope="module")
def glasses(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("devices") / "data", resolution=32)


@needs_gpu
@pytest.mark.parametrize("method", ["paper", "paper-best", "mlp-first", "light-path", "dnr"])
def test_the_same_run_gives_the_same_bytes(method: str, glasses: Dataset, tmp_path: Path) -> None:
    config = dataclasses.replace(configured(glasses, method), batch=1024, held_out_views=0, steps=20)
    for out in (tmp_path / "a", tmp_path / "b"):
        train(config, glasses, out, label="x", device=torch.device("cuda"))
    assert (tmp_path / "a" / WEIGHTS).read_bytes() == (tmp_path / "b" / WEIGHTS).read_bytes()


@needs_gpu
@pytest.mark.parametrize("method", ["paper", "paper-best", "light-path", "dnr"])
def test_a_gpu_draws_what_a_cpu_draws(method: str, glasses: Dataset) -> None:
    config = configured(glasses, method)
    inputs = open_inputs(config.net, glasses, config.geometry)
    drawn = []
    for device in (CPU, torch.device("cuda")):
        renderer = build_renderer(config, inputs, device=device).eval()
        drawn.append(
            predict_pixels(renderer, config.net.load(inputs, "interpolating", [0], with_images=False).to(device))
        )
    assert np.abs(drawn[0].astype(int) - drawn[1]).max() <= 1


@pytest.mark.parametrize("method", METHODS.built_in)
def test_training_and_drawing_keep_to_one_device(method: str, glasses: Dataset, tmp_path: Path) -> None:
    config = dataclasses.replace(configured(glasses, method), batch=64, held_out_views=0, steps=1)
    inputs = open_inputs(config.net, glasses, config.geometry)
    for constants in (constant_on, places_on):  # Those of another test are on another device.
        constants.cache_clear()
    with pretended_cuda():
        train(config, glasses, tmp_path / "run", label="x", device=CUDA)
        renderer = build_renderer(config, inputs, device=CUDA).eval()
        pixels = config.net.load(inputs, "interpolating", [0], with_images=False).to(CUDA)
        assert predict_pixels(renderer, pixels)[0].shape[-1] == 3


def test_arrays_reach_a_gpu_as_they_are() -> None:
    rng = np.random.default_rng(0)
    arrays = {
        "uv": rng.normal(size=(7, 3, 2)).astype(np.float32),
        "object_id": rng.integers(256, size=(5, 3), dtype=np.uint8)[::2],  # Not contiguous, and of 9 bytes.
        "none": np.zeros((0, 3), np.float32),
        "ray": rng.integers(1 << 40, size=11),
        "bits": rng.integers(-9, 9, (3, 2), dtype=np.int16),
    }
    with pretended_cuda():
        moved = to_device(arrays, CUDA)
        assert all(values.device == CUDA for values in moved.values())
        there = {name: values.cpu() for name, values in moved.items()}
    for found in (there, to_device(arrays, CPU)):
        assert list(found) == list(arrays)
        for name, values in arrays.items():
            assert found[name].numpy().dtype == values.dtype
            np.testing.assert_array_equal(found[name].numpy(), values)


def test_the_pretended_gpu_refuses_tensors_of_both_devices() -> None:
    with pretended_cuda():
        layer = torch.nn.Linear(3, 2).to(CUDA)
        x = torch.tensor([[1.0, 2.0, 3.0]], device=CUDA)
        layer(x).square().sum().backward()
        assert layer.weight.device == CUDA and layer.weight.grad is not None and layer.weight.grad.device == CUDA
        assert x[x > 1].tolist() == [2, 3]
        with pytest.raises(RuntimeError, match="tensors on cuda:0 and on the CPU"):
            x + torch.ones(3)
        with pytest.raises(TypeError, match="can't convert cuda:0"):
            x.numpy()


def test_a_gpu_looks_up_the_sky_as_a_cpu_does() -> None:
    generator = torch.Generator().manual_seed(0)
    sky = LearnedSky(8, 0, 0.7)
    for texels in sky.maps:
        texels.data = torch.randn(texels.shape, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator), dim=1)
    weights = torch.randn(500, 3, generator=generator)

    expected = sky(directions)
    (expected * weights).sum().backward()
    expected_gradients = [texels.grad for texels in sky.maps]
    constant_on.cache_clear()
    with pretended_cuda():
        there = LearnedSky(8, 0, 0.7).to("cuda")
        there.load_state_dict(sky.state_dict())
        found = there(directions.to("cuda"))
        (found * weights.to("cuda")).sum().backward()
        found, found_gradients = found.cpu(), [texels.grad.cpu() for texels in there.maps]
    constant_on.cache_clear()
    torch.testing.assert_close(found, expected.detach())
    torch.testing.assert_close(found_gradients, expected_gradients, rtol=1e-5, atol=1e-5)
