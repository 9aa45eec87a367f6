"""Tests of training and drawing on a GPU, where there is one; everything else is tested on CPUs."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.pretend_cuda import pretended_cuda
from support.traced_dataset import write_traced_dataset
from support.training import configured

from datagen.data.dataset import Dataset
from model.methods.protocol import open_inputs
from model.nets.learned_sky import LearnedSky
from model.nets.texture import constant_on
from model.run.predict import predict_pixels
from model.run.run_folder import WEIGHTS
from model.run.train import build_renderer, train

CPU = torch.device("cpu")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")


@pytest.fixture(scope="module")
def glasses(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("gpu") / "data", resolution=64)


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
