"""Tests pixels drawn by error: where they lie, how often, and that a run which was stopped draws the same ones."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float32
from support import commands
from support.training import assert_resumes, configured, load
from torch import Tensor

from datagen.data.config import Resolution
from datagen.data.dataset import Dataset
from datagen.data.images import srgb_from_linear
from model.batches import draws as draws_module
from model.batches.distributed import ALONE
from model.batches.draws import (
    BLOCK,
    BY_ERROR,
    MOST,
    UNIT,
    BlockDraws,
    Blocks,
    DrawSchedule,
    Errors,
    make_schedule,
    noise_of_blocks,
)
from model.batches.rays import Pixels, draw_rows, draws_of
from model.methods.paper.config import PaperConfig

pytestmark = pytest.mark.usefixtures("one_thread")

ODD = Blocks(num_views=3, resolution=Resolution(width=21, height=13))
"""Views of 2 x 3 blocks; those at the far edges are smaller."""


def errors_of(
    blocks: Blocks, visits: Sequence[int] | np.ndarray, squares: Sequence[float] | np.ndarray, noise: float = 0.0
) -> Errors:
    """The sums of a run: visits, and sums of squared errors."""
    sums = torch.stack(
        [torch.as_tensor(np.asarray(visits)), torch.as_tensor(np.rint(np.asarray(squares) / UNIT).astype(np.int64))]
    )
    return Errors(blocks=blocks, noise=np.full(len(blocks), noise), sums=sums)


def test_blocks_tile_views_whose_sides_are_no_multiples_of_theirs() -> None:
    index = torch.arange(3 * 21 * 13)
    block = ODD.of(index).numpy()
    assert np.array_equal(np.bincount(block), ODD.areas)
    assert np.array_equal(np.unique(block), np.arange(len(ODD)))
    row, column = index.numpy() // 21 % 13, index.numpy() % 21
    expected = [(int(index) // (21 * 13), r // BLOCK, c // BLOCK) for index, r, c in zip(index, row, column)]
    assert len({*zip(block, expected)}) == len(ODD)


def test_pixels_at_places_of_blocks_lie_in_them_and_reach_all_of_them() -> None:
    rng = np.random.default_rng(0)
    block = rng.integers(len(ODD), size=40_000)
    pixels = ODD.pixels(block, rng.random((40_000, 2)))
    assert np.array_equal(ODD.of(torch.from_numpy(pixels)).numpy(), block)
    counts = np.bincount(pixels, minlength=3 * 21 * 13)
    # Each pixel of a block is as likely as any other: 40,000 / 18 draws over at most 64 pixels.
    expected = 40_000 / len(ODD) / ODD.areas[ODD.of(torch.arange(len(counts))).numpy()]
    assert (np.abs(counts - expected) < 6 * np.sqrt(expected)).all()


def test_a_blocks_share_is_its_area_times_the_root_of_its_error_above_the_noise() -> None:
    blocks = Blocks(num_views=1, resolution=Resolution(width=4 * BLOCK, height=BLOCK))
    visits = np.full(4, 10_000_000)  # So many that what is expected before them does not matter.
    share = errors_of(blocks, visits, visits * np.array([0.05, 0.02, 0.01, 0.01]), noise=0.01).shares()
    np.testing.assert_allclose(share, [2 / 3, 1 / 3, 0, 0], atol=1e-3)
    narrow = Blocks(num_views=1, resolution=Resolution(width=3 * BLOCK + 2, height=BLOCK))
    share = errors_of(narrow, visits, visits * np.full(4, 0.02)).shares()
    np.testing.assert_allclose(share, np.array([8, 8, 8, 2]) / 26, atol=1e-6)


def test_no_block_gets_more_than_a_limit_and_a_perfect_renderer_draws_uniformly() -> None:
    blocks = Blocks(num_views=10, resolution=Resolution(width=BLOCK, height=10 * BLOCK))
    visits, squares = np.full(100, 10_000_000), np.full(100, 0.1)
    squares[7] = 1e5
    share = errors_of(blocks, visits, squares).shares()
    size = np.sqrt(squares / visits)
    np.testing.assert_allclose(share[7] / share[0], MOST * size.mean() / size[0], rtol=1e-2)
    for squares in (np.zeros(100), np.full(100, -5.0)):  # Noise that was taken off may exceed what was seen.
        errors = errors_of(blocks, visits, squares)
        draws = BlockDraws(errors=errors, edges=np.cumsum(errors.shares()))
        assert np.array_equal(
            draws.rows(64, np.random.default_rng(3)), np.random.default_rng(3).integers(len(blocks) * 64, size=64)
        )


def test_half_of_a_batch_is_uniform_and_half_follows_the_shares() -> None:
    blocks = Blocks(num_views=2, resolution=Resolution(width=2 * BLOCK, height=BLOCK))
    share = np.array([0.0, 0.7, 0.3, 0.0])
    draws = BlockDraws(errors=errors_of(blocks, np.zeros(4, int), np.zeros(4)), edges=np.cumsum(share))
    rows = draws.rows(200_000, np.random.default_rng(0))
    found = np.bincount(blocks.of(torch.from_numpy(rows)).numpy(), minlength=4) / len(rows)
    np.testing.assert_allclose(found, BY_ERROR * share + (1 - BY_ERROR) / 4, atol=0.005)


def test_errors_are_squares_without_their_known_variance_whatever_their_order() -> None:
    rng = np.random.default_rng(0)
    index = torch.from_numpy(rng.integers(3 * 21 * 13, size=500))
    missed = torch.from_numpy(rng.normal(scale=0.1, size=(500, 3)).astype(np.float32))
    variance = torch.full((500, 3), 0.004)
    missed[:50] = 0  # Brighter than white: right, whatever the noise.
    found = []
    for order in (np.arange(500), rng.permutation(500)):
        errors = errors_of(ODD, np.zeros(18, int), np.zeros(18))
        draws = BlockDraws(errors=errors, edges=np.zeros(18))
        for part in np.array_split(order, 3):
            draws.add(index[part], missed[part], variance[part])
        errors.take_in(ALONE)
        found.append(errors.sums)
    assert torch.equal(found[0], found[1])
    block = ODD.of(index).numpy()
    squares = np.where(missed == 0, 0, missed.double() ** 2 - 0.004).mean(axis=1)
    np.testing.assert_allclose(found[0][1].numpy() * UNIT, np.bincount(block, weights=squares), atol=1e-6)
    assert np.array_equal(found[0][0].numpy(), np.bincount(block))


def edges_at(schedule: DrawSchedule, step: int) -> np.ndarray:
    draws = draws_of(schedule.at(step))
    assert isinstance(draws, BlockDraws)
    return draws.edges


def test_a_step_draws_by_errors_that_ended_a_step_before_it_and_a_checkpoint_keeps_them(dataset: Dataset) -> None:
    blocks = Blocks(num_views=1, resolution=Resolution(width=2 * BLOCK, height=BLOCK))
    pixels = load(PaperConfig(), dataset, [0])
    errors = errors_of(blocks, np.zeros(2, int), np.zeros(2))
    schedule = DrawSchedule(pixels=pixels, errors=errors)
    every = draws_module.REFRESH
    for done in range(1, 2 * every + 1):
        first, second = (0.5, 0.1) if done <= every else (0.1, 0.5)
        errors.recent.append((torch.tensor([0, BLOCK]), torch.tensor([[first] * 3, [second] * 3]), None))
        schedule.end(done, ALONE)
    assert np.array_equal(edges_at(schedule, every), [0, 0])
    first, second = edges_at(schedule, every + 1), edges_at(schedule, 2 * every + 1)
    assert np.array_equal(edges_at(schedule, 2 * every), first)
    assert first[0] / first[1] > 0.7 > 0.5 > second[0] / second[1]

    again = DrawSchedule(pixels=pixels, errors=errors_of(blocks, np.zeros(2, int), np.zeros(2)))
    again.load_state(schedule.state())
    for step in (2 * every, 2 * every + 1):
        assert np.array_equal(edges_at(again, step), edges_at(schedule, step))
    assert again.errors is not None
    assert torch.equal(again.errors.sums, errors.sums)


def test_old_errors_fade() -> None:
    errors = errors_of(ODD, np.full(18, 1200), np.full(18, 60.0))
    errors.fade()
    assert errors.sums[0].tolist() == [12] * 18
    np.testing.assert_allclose(errors.sums[1].numpy() * UNIT, 0.6, rtol=1e-6)
    errors.fade()
    assert errors.sums[0].tolist() == [12] * 18


def test_the_noise_of_pictures_is_that_of_their_halves_in_srgb(dataset: Dataset) -> None:
    views = [1, 3]
    blocks = Blocks(num_views=2, resolution=dataset.config.resolution)
    found = noise_of_blocks(blocks, dataset, views)
    view = dataset.view("train", 3)
    halves = [srgb_from_linear(view.radiance + sign * view.noise) for sign in (1, -1)]
    square = np.square((halves[0] - halves[1]) / 2).mean(axis=-1)
    place = len(blocks) // 2
    np.testing.assert_allclose(found[place], square[:BLOCK, :BLOCK].mean(), rtol=1e-6)
    assert found.max() > 0


@pytest.mark.parametrize("method", ["paper", "light-path"])
def test_a_run_by_error_that_was_stopped_ends_in_the_same_bytes(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    monkeypatch.setattr(draws_module, "REFRESH", 2)
    config = dataclasses.replace(
        configured(dataset, method, "--draws", "error", "--steps", "9", "--batch", "64", "--texture-size", "16"),
        checkpoint_every=5,
    )
    assert_resumes(monkeypatch, config, dataset, tmp_path, stop=7)


class Constant(torch.nn.Module):
    """Learns one colour for all pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.color = torch.nn.Parameter(torch.zeros(3))

    def forward(self, rays: object, *, rng: object) -> Float32[Tensor, "pixel 3"]:
        del rng
        return self.color.expand(rays.uv.shape[0], 3)  # pyright: ignore[reportAttributeAccessIssue]


def test_where_a_renderer_errs_its_pixels_are_drawn_more_often(dataset: Dataset) -> None:
    from model.losses.pixel_losses import pixel_loss

    pixels: Pixels = load(PaperConfig(), dataset, [0, 1])
    rgb = torch.zeros_like(pixels.rgb)
    wrong = pixels.pixels_per_view // 4
    rgb[:wrong] = 250
    schedule = make_schedule(dataclasses.replace(pixels, rgb=rgb), "error", dataset, [0, 1])
    assert schedule.errors is not None
    schedule.errors.noise[:] = 0
    for done in range(1, draws_module.REFRESH + 1):
        pixel_loss(Constant(), schedule.at(done - 1), 512, np.random.default_rng(done))
        schedule.end(done, ALONE)
    rows = draw_rows(schedule.at(draws_module.REFRESH + 1), 4000, np.random.default_rng(0))
    # An eighth of the uniform ones are wrong; most of the others lie in the wrong quarter of the first view.
    assert 0.85 * BY_ERROR < (rows < wrong).mean() < BY_ERROR + (1 - BY_ERROR) / 8 + 0.02


def test_methods_that_draw_whole_views_and_words_unknown_are_refused(dataset: Dataset, tmp_path: Path) -> None:
    answer = commands.call(f"model train dnr {dataset.root} --out {tmp_path / 'it'} --draws error --steps 2")
    assert answer.status == 1
    assert (
        answer.error == "error: draws: is error, but this network learns from crops or whole pictures; expected uniform"
    )
    assert not (tmp_path / "it" / "weights.pt").exists()
