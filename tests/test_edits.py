"""Tests that a trained renderer draws an edited scene: what is removed from the geometry vanishes from the picture."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from synthetic import quad, synthetic_scene
from test_meshes import mesh_of

from datagen.build import build_dataset
from datagen.dataset import DatasetConfig, SplitConfig, read_image
from datagen.geometry import TRUTH
from datagen.layers import read_layers
from datagen.meshes import Mesh
from datagen.scene import Dielectric, Diffuse, Scene, SceneObject, SoftEnvironment, SolidTexture
from datagen.variant import use_mitsuba

if use_mitsuba(quiet=True).startswith("scalar"):
    pytest.skip("light paths need a vectorised variant of Mitsuba", allow_module_level=True)

from datagen.light_path import LightPathTracer
from model.light_path_net import LightPathConfig
from model.methods import METHODS
from model.predict import load_renderer, predict_pixels
from model.run_folder import TrainConfig
from model.train import train

GLASS = Dielectric(ior=1.5, absorption=(0.2, 0.6, 1.5))
CHECKER = Diffuse(color=SolidTexture(pattern="checker", colors=((0.7, 0.6, 0.2), (0.1, 0.2, 0.5)), scale=0.5))
NET = LightPathConfig(texture_sizes=(8, 64), texture_levels=2, branches=6, render_samples=9)


def scene(*, with_ball: bool) -> Scene:
    """A ball of tinted glass over a chequered floor; without the ball, it lies far beyond what a camera sees."""
    center = (0.0, 0.0, 0.45) if with_ball else (0.0, 0.0, -500.0)
    ball = mesh_of(trimesh.creation.icosphere(4, 0.4).apply_translation(center))
    return dataclasses.replace(
        synthetic_scene(),
        objects=(
            SceneObject(name="ball", mesh=ball, material=GLASS),
            SceneObject(name="floor", mesh=quad(0.0), material=CHECKER),
        ),
        environment=SoftEnvironment(zenith=(0.9, 0.9, 0.9), horizon=(0.8, 0.7, 0.6), ground=(0.3, 0.3, 0.3)),
    )


def config(*, train_views: int) -> DatasetConfig:
    few = SplitConfig(views=2, spp=128)
    return DatasetConfig(
        scene="edit", preset="tiny", resolution=48, train=SplitConfig(views=train_views, spp=50), interpolating=few,
        extrapolating=few,
    )  # fmt: skip


def test_a_removed_ball_of_glass_leaves_the_floor_that_was_behind_it(tmp_path: Path) -> None:
    options = {"kinds": ("straight",), "num_layers": 4, "rays": 1, "workers": 1, "overwrite": False}
    before = build_dataset(scene(with_ball=True), tmp_path / "before", config(train_views=16), **options)
    after = build_dataset(scene(with_ball=False), tmp_path / "after", config(train_views=1), **options)
    run = TrainConfig(
        method="light-path", geometry=TRUTH, net=NET, steps=200, batch=512, lr=0.002, texture_lr=0.02,
        lr_decay="cosine", evaluate_every=200,
    )  # fmt: skip
    train(run, before, tmp_path / "run", label="a", device=torch.device("cpu"))
    renderer = load_renderer(tmp_path / "run", run, before)
    pixels = METHODS["light-path"].load(NET, before, TRUTH, "interpolating", [0], False)
    kept = predict_pixels(renderer, pixels)
    # Only the layers change: the same weights, textures and cameras.
    meshes: tuple[Mesh, ...] = tuple(item.mesh for item in scene(with_ball=False).objects)
    tracers = {"tracer": (GLASS, CHECKER), "straight_tracer": (None, None)}
    edited_pixels = dataclasses.replace(
        pixels, **{name: LightPathTracer(meshes, materials) for name, materials in tracers.items()}
    )
    edited = predict_pixels(renderer, edited_pixels)

    in_ball = (read_layers(before, TRUTH, "interpolating", 0).object_id[0] == 1).ravel()
    assert 0.05 < in_ball.mean() < 0.5
    truth_before, truth_after = (read_image(dataset, "interpolating", 0).reshape(-1, 3) for dataset in (before, after))

    def psnr(prediction: np.ndarray, truth: np.ndarray) -> float:
        error = (prediction[in_ball].astype(np.float64) - truth[in_ball]) / 255
        return float(-10 * np.log10(np.square(error).mean()))

    assert psnr(kept, truth_before) > 24
    assert psnr(edited, truth_after) > 24
    # The edit is seen: neither picture would pass for the other.
    assert psnr(kept, truth_after) < 18
    assert psnr(edited, truth_before) < 18
