"""Tests that no method asks a GPU for more than its budget, in a training step and in a view, without having a GPU."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from support.pretend_cuda import CUDA, Counts, pretended_cuda
from support.traced_dataset import write_traced_dataset
from support.training import configured

from datagen.data.dataset import Dataset
from model.batches.rays import to_device
from model.methods.table import open_inputs
from model.nets.texture import constant_on, places_on
from model.run.predict import predict_pixels
from model.run.preparation import build_renderer
from model.run.train import train

pytestmark = pytest.mark.usefixtures("one_thread")


class Budget(NamedTuple):
    """The most that is asked of a GPU; each was measured, and may only become less."""

    launches: int
    waits: int
    kilobytes: float
    """Copied to and from the CPU."""


STEPS = {
    "paper": Budget(202, 1, 2.3),
    "paper-best": Budget(240, 2, 91),
    "mlp-first": Budget(202, 1, 2.3),
    "dnr": Budget(252, 1, 33),
    "dnr-authors": Budget(169, 1, 33),
    "light-path": Budget(1334, 4, 168.5),
}
"""A training step on 256 pixels; `light-path` makes four updates in it."""

VIEWS = {
    "paper": Budget(122, 2, 13),
    "paper-best": Budget(120, 3, 5600),
    "mlp-first": Budget(122, 2, 13),
    "dnr": Budget(142, 2, 13),
    "dnr-authors": Budget(120, 2, 13),
    "light-path": Budget(259, 4, 13738),
}
"""A view of 64 x 64 pixels."""


@pytest.fixture(scope="module")
def glasses(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("budgets") / "data", resolution=64)


def forget_constants() -> None:
    """They count for the pretended GPU that they were made on."""
    constant_on.cache_clear()
    places_on.cache_clear()


def assert_within(before: tuple[int, int, int], counts: Counts, budget: Budget) -> None:
    launches, waits, num_bytes = (after - first for after, first in zip(counts.totals(), before))
    found = Budget(launches, waits, num_bytes / 1000)
    assert all(have <= most for have, most in zip(found, budget)), f"{found}; expected at most {budget}\n{counts}"


@pytest.mark.parametrize(
    "method",
    [pytest.param(name, marks=pytest.mark.full if name == "dnr-authors" else ()) for name in STEPS],
)
def test_a_training_step_stays_within_its_budget(method: str, glasses: Dataset, tmp_path: Path) -> None:
    config = dataclasses.replace(configured(glasses, method), batch=256, held_out_views=0)

    def count(steps: int) -> Counts:
        forget_constants()
        with pretended_cuda() as counts:
            train(dataclasses.replace(config, steps=steps), glasses, tmp_path / str(steps), label="x", device=CUDA)
        return counts

    # What a run asks for once is in both.
    assert_within(count(1).totals(), count(2), STEPS[method])


@pytest.mark.parametrize("method", VIEWS)
def test_drawing_a_view_stays_within_its_budget(method: str, glasses: Dataset) -> None:
    config = configured(glasses, method)
    inputs = open_inputs(config.net, glasses, config.geometry)
    forget_constants()
    with pretended_cuda() as counts:
        renderer = build_renderer(config, inputs, device=CUDA).eval()
        pixels = config.net.load(inputs, "interpolating", [0], with_images=False).to(CUDA)
        predict_pixels(renderer, pixels)  # Constants are copied once.
        before = counts.totals()
        predict_pixels(renderer, pixels)
    assert_within(before, counts, VIEWS[method])


def test_arrays_reach_a_gpu_in_one_copy_for_which_nothing_waits() -> None:
    rng = np.random.default_rng(0)
    arrays = {
        "uv": rng.normal(size=(7, 3, 2)).astype(np.float32),
        "object_id": rng.integers(256, size=(5, 3), dtype=np.uint8)[::2],  # Not contiguous, and of 9 bytes.
        "none": np.zeros((0, 3), np.float32),
        "ray": rng.integers(1 << 40, size=11),
        "bits": rng.integers(-9, 9, (3, 2), dtype=np.int16),
    }
    with pretended_cuda() as counts:
        moved = to_device(arrays, CUDA)
        launches, waits, num_bytes = counts.totals()
        assert (launches, waits) == (0, 0) and 0 <= num_bytes - sum(item.nbytes for item in arrays.values()) < 5 * 16
        assert all(values.device == CUDA for values in moved.values())
        there = {name: values.cpu() for name, values in moved.items()}
    for found in (there, to_device(arrays, torch.device("cpu"))):
        assert list(found) == list(arrays)
        for name, values in arrays.items():
            assert found[name].numpy().dtype == values.dtype
            np.testing.assert_array_equal(found[name].numpy(), values)


def test_the_pretended_gpu_counts_as_a_gpu_would() -> None:
    with pretended_cuda() as counts:
        layer = torch.nn.Linear(3, 2).to(CUDA)  # Copies two parameters.
        x = torch.tensor([[1.0, 2.0, 3.0]], device=CUDA)
        assert counts.totals() == (0, 3, 4 * (6 + 2 + 3))
        loss = layer(x).square().sum()
        loss.backward()
        assert layer.weight.device == CUDA and layer.weight.grad is not None and layer.weight.grad.device == CUDA
        launches, waits, _ = counts.totals()
        assert launches >= 6 and waits == 3
        assert loss.item() > 0 and x[x > 1].tolist() == [2, 3]  # A number, a mask's places, a copy.
        assert counts.totals()[1] == 6
        with pytest.raises(RuntimeError, match="tensors on cuda:0 and on the CPU"):
            x + torch.ones(3)
        with pytest.raises(TypeError, match="can't convert cuda:0"):
            x.numpy()
