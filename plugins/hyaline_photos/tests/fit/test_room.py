"""Tests what fits draw with the textures of a room, and which pixels they trust."""

import dataclasses

import numpy as np
import pytest
import torch
from support.traced_dataset import write_traced_dataset

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.paths import TRUTH
from datagen.scene.folder import open_scene
from hyaline_photos.fit import room
from hyaline_photos.fit.boxes import Box
from hyaline_photos.fit.room import ENOUGH, FROSTED_RAYS, RAYS, SKY_LEVEL, STEEPNESS, Visits, count_visits
from hyaline_photos.fit.search import penalty
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import Ends, LightPathBatch, Sky
from model.nets.learned_sky import LearnedSky
from model.nets.texture import object_layout

MANY = 1e6
"""Visits."""

FLOOR, BALL, CUBE = 1, 2, 5
"""Ids of objects in the traced dataset."""

SHAPE = Box(center=np.array([0.0, 0.0, 0.1]), axes=np.eye(3), half_sizes=np.full(3, 0.05), rounding=0.01)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("room") / "glasses", resolution=24)


def test_frosted_glass_is_drawn_by_more_rays_which_it_needs(dataset: Dataset) -> None:
    meshes, materials = list(read_meshes(dataset, TRUTH)), [item.material for item in open_scene(dataset).objects]
    meshes[BALL - 1], materials[BALL - 1] = SHAPE.bodies([BALL])[BALL]
    pixels = room.load_pixels(dataset, open_scene(dataset), tuple(meshes), tuple(materials), room.COARSE)
    rows = np.arange(len(pixels.rgb))
    learned = room.learn(pixels, rows, rows[:0], np.zeros((0, 3), np.float32), 1, seed=0)
    drawn = room.load_room(room.room_state(learned), pixels, rows)
    frosted, some = SHAPE.having(roughness=0.2), rows[::3]
    drawn.put((BALL,), frosted)
    best, few, many = (drawn.draw(some, samples) for samples in (16 * FROSTED_RAYS, RAYS, FROSTED_RAYS))
    assert 0 < np.square(many - best).mean() < 0.5 * np.square(few - best).mean()
    # The loss is of that picture: a pixel's weight is the same in all channels, as it is not with fewer rays.
    truth, misses = pixels.rgb.numpy()[some] / np.float32(255), drawn.misses((BALL,), some, (SHAPE,))(frosted)
    losses = {samples: penalty(colors - truth) for samples, colors in ((RAYS, few), (FROSTED_RAYS, many))}
    is_wrong = (losses[FROSTED_RAYS] > 1e-3).all(axis=1)
    spread = {samples: np.ptp(misses[is_wrong] / loss[is_wrong], axis=1).max() for samples, loss in losses.items()}
    assert spread[FROSTED_RAYS] < 1e-3 < spread[RAYS]


def test_a_pixel_counts_as_far_as_its_light_comes_from_what_was_seen() -> None:
    layout, environment = object_layout([8]), LearnedSky(8, 0, 0.7)
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
    # A place that few pixels show is half known.
    few = dataclasses.replace(visits, texels=torch.full((64,), ENOUGH), directions=torch.full_like(directions, ENOUGH))
    half = few.trust(LightPathBatch(num_pixels=3, samples=2, ends=ends, sky=sky, stack=None))
    assert half.tolist() == pytest.approx([0.5**STEEPNESS] * 3)


def test_pixels_that_show_a_floor_are_trusted_only_after_some_of_them_were_counted(dataset: Dataset) -> None:
    scene = open_scene(dataset)
    materials = tuple(item.material for item in scene.objects)
    pixels = room.load_pixels(dataset, scene, read_meshes(dataset, TRUTH), materials, room.COARSE)
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


def test_decibels_of_each_picture_are_those_of_its_pixels_beside_glass(dataset: Dataset) -> None:
    materials = tuple(item.material for item in open_scene(dataset).objects)
    pixels = room.load_pixels(dataset, open_scene(dataset), read_meshes(dataset, TRUTH), materials, room.COARSE)
    renderer = LightPathRenderer(dataclasses.replace(pixels.config, texture_sizes=(8,) * len(materials)))
    drawn = room.load_room(room.room_state(renderer), pixels, np.arange(len(pixels.rgb)))
    is_beside = np.zeros((len(pixels.cameras), 24, 24), bool)
    is_beside[1:, 5:17] = True  # Fewer pixels than are drawn of a picture at most.
    found = drawn.decibels(is_beside)
    for view in range(1, len(found)):
        rows = 24 * 24 * view + np.flatnonzero(is_beside[view])
        error = np.square(drawn.draw(rows) - pixels.rgb.numpy()[rows] / np.float32(255)).mean()
        assert found[view] == pytest.approx(-10 * np.log10(error), abs=0.01)
    assert found[0] == np.inf and f"train/{found.argmin():04d} ({found.min():.1f})" in room.in_words(found)
