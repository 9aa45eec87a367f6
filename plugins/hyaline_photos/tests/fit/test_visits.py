"""Tests which pixels a fit trusts: those whose light comes from what pictures show beside the glass."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.traced_dataset import write_traced_dataset

from datagen.data.geometries import read_meshes
from datagen.data.paths import TRUTH
from datagen.scene.folder import open_scene
from hyaline_photos.fit.room import COARSE, ENOUGH, SKY_LEVEL, STEEPNESS, Visits, count_visits, load_pixels
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import Ends, LightPathBatch, Sky
from model.nets.learned_sky import LearnedSky
from model.nets.texture import object_layout

MANY = 1e6
"""Visits."""

FLOOR, CUBE = 1, 5
"""Ids of objects in the traced dataset."""


def test_a_pixel_counts_as_far_as_its_light_comes_from_what_was_seen() -> None:
    layout, environment = object_layout([8]), LearnedSky(8, 0)
    texels = torch.zeros(8, 8)
    texels[:, :4] = MANY
    up, down = torch.tensor([0.0, 0.6, 0.8]), torch.tensor([0.0, 0.6, -0.8])
    directions = torch.zeros(environment.maps[SKY_LEVEL][0].numel())
    directions[environment.texels_at(SKY_LEVEL, up[None])] = MANY
    visits = Visits(layout=layout, texels=texels.flatten(), environment=environment, directions=directions)
    # Two rays a pixel: all light of pixel 0 is known, three quarters of pixel 1's, and none of pixel 2's.
    left, right = [0.2, 0.5], [0.8, 0.5]
    ends = Ends(
        ray=torch.tensor([0, 1, 2, 3, 4]),
        surface=torch.ones(5, dtype=torch.uint8),
        uv=torch.tensor([left, left, left, right, right]),
        throughput=torch.tensor([0.9, 0.5, 0.5, 0.25, 0.3])[:, None].expand(5, 3),
        cosine=torch.ones(5),
    )
    sky = Sky(
        ray=torch.tensor([0, 3, 5]),
        direction=torch.stack([up, up, down]),
        throughput=torch.tensor([0.1, 0.25, 0.7])[:, None].expand(3, 3),
    )
    trust = visits.trust(LightPathBatch(num_pixels=3, samples=2, ends=ends, sky=sky, stack=None))
    assert trust.tolist() == pytest.approx([1.0, 0.75**STEEPNESS, 0.0], abs=1e-4)


def test_a_place_that_few_pixels_show_is_half_known() -> None:
    environment = LearnedSky(8, 0)
    size = environment.maps[SKY_LEVEL][0].numel()
    visits = Visits(
        layout=object_layout([2]),
        texels=torch.full((4,), ENOUGH),
        environment=environment,
        directions=torch.zeros(size),
    )
    ends = Ends(
        ray=torch.tensor([0]),
        surface=torch.ones(1, dtype=torch.uint8),
        uv=torch.tensor([[0.3, 0.6]]),
        throughput=torch.full((1, 3), 0.2),
        cosine=torch.ones(1),
    )
    sky = Sky(ray=torch.zeros(0, dtype=torch.long), direction=torch.zeros(0, 3), throughput=torch.zeros(0, 3))
    trust = visits.trust(LightPathBatch(num_pixels=1, samples=1, ends=ends, sky=sky, stack=None))
    assert trust.item() == pytest.approx(0.5**STEEPNESS)


def test_pixels_that_show_a_floor_are_trusted_only_after_some_of_them_were_counted(tmp_path: Path) -> None:
    dataset = write_traced_dataset(tmp_path / "glasses", resolution=24)
    scene = open_scene(dataset)
    pixels = load_pixels(
        dataset, scene, read_meshes(dataset, TRUTH), tuple(item.material for item in scene.objects), COARSE
    )
    renderer = LightPathRenderer(dataclasses.replace(pixels.config, texture_sizes=(8,) * len(scene.objects)))
    first = np.stack([view.object_ids()[0] for view in dataset.views("train")]).ravel()
    floor, others = np.flatnonzero(first == FLOOR), np.flatnonzero((first == 0) | (first == CUBE))

    def mean_trust(counted: np.ndarray, asked: np.ndarray) -> float:
        trust = count_visits(renderer, pixels, counted).trust(pixels.take(torch.from_numpy(asked), None))
        assert 0 <= trust.min() and trust.max() <= 1
        return float(trust.mean())

    assert mean_trust(others, floor) < 0.05
    assert mean_trust(others, others) > 0.7
    assert mean_trust(np.concatenate([others, floor[::2]]), floor[1::2]) > 0.7
