"""Tests the held-out views of training: which they are, and that a quarter of their pixels is drawn and scored."""

import math

import numpy as np
import pytest
import torch
from support.traced_dataset import write_traced_dataset
from support.training import configured

from datagen.data.dataset import Dataset
from model.methods.protocol import open_inputs
from model.run.predict import predict_pixels
from model.run.train import ScoredViews, build_renderer, choose_held_out, mean_psnr

VIEWS = [1, 3]
SIZE = 33


@pytest.fixture(scope="module")
def glasses(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("held-out") / "data", resolution=SIZE)


def test_held_out_views_are_few_and_spread() -> None:
    assert choose_held_out(100, 4) == [12, 37, 62, 87]
    assert choose_held_out(8, 4) == [4]
    assert choose_held_out(4, 4) == []


@pytest.mark.parametrize("method", ["paper", "paper-best", "light-path", "dnr-authors"])
def test_every_second_pixel_of_every_second_row_is_drawn_as_in_the_whole_view(
    method: str, glasses: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = configured(glasses, method)
    inputs = open_inputs(config.net, glasses, config.geometry)
    renderer = build_renderer(config, inputs, device=torch.device("cpu"))
    held_out = ScoredViews(pixels=config.net.load(inputs, "train", [1, 0, 3], with_images=True), places=[0, 2])
    pictures = np.stack([glasses.view("train", view).image for view in VIEWS])
    assert np.array_equal(held_out.truth, pictures[:, ::2, ::2])

    asked: set[int] = set()
    take = type(held_out.pixels).take

    def noted(pixels, index, rng):
        asked.update(index.flatten().tolist())
        return take(pixels, index, rng)

    with monkeypatch.context() as patch:
        patch.setattr(type(held_out.pixels), "take", noted)
        drawn = held_out.draw(renderer)
    rows = [row for row in range(3 * SIZE * SIZE) if row // SIZE**2 != 1]
    quarter = {row for row in rows if row % SIZE % 2 == 0 and row // SIZE % SIZE % 2 == 0}
    assert asked == (set(rows) if held_out.pixels.whole_views else quarter)
    whole = predict_pixels(renderer, held_out.pixels).reshape(3, SIZE, SIZE, 3)[[0, 2]]
    assert whole.std() > 1
    # Rays through rough surfaces meet other facets.
    assert np.abs(drawn.astype(int) - whole[:, ::2, ::2]).max() <= (4 if method == "light-path" else 1)


def test_the_score_is_the_mean_of_the_views_scores() -> None:
    truth = np.full((2, 4, 4, 3), 100, np.uint8)
    predicted = truth + np.array([1, 10], np.uint8)[:, None, None, None]
    assert math.isclose(mean_psnr(predicted, truth), 20 * math.log10(255) - 10)
