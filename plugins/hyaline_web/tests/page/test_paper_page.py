"""Tests that the page of `paper` draws what Python draws, whatever it is told, and edits as Python edits."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from support.meshes import box
from support.web_scenes import SHAPE, VIEW, every_surface, opened_page, psnr, write_scene

from datagen.data.dataset import Dataset
from datagen.data.meshes import Mesh
from datagen.data.paths import TRUTH
from datagen.scene.atlas import faces_apart
from datagen.scene.description import Scene, SceneObject
from datagen.scene.materials import Dielectric, Diffuse
from datagen.trace.peel import Peeler
from model.batches.layers import TracedLayerPixels
from model.batches.rays import black
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.methods.protocol import Inputs
from model.nets.pixel_mlp import positions_for
from model.nets.texture import NeuralTextures
from model.run.predict import predict_pixels

if TYPE_CHECKING:
    from playwright.sync_api import Browser

LAYERS = 5


def boxes() -> Scene:
    """A box in a box, and one beside them."""

    def placed(size: tuple[float, float, float], *place: float) -> Mesh:
        mesh = faces_apart(box(size))
        return dataclasses.replace(mesh, vertices=mesh.vertices + np.float32(place))

    grey = Diffuse(color=(0.5, 0.5, 0.5))
    objects = (
        SceneObject(name="outer", mesh=placed((1, 1, 1), 0, 0, 0.6), material=Dielectric(ior=1.5)),
        SceneObject(name="inner", mesh=placed((0.4, 0.5, 0.3), 0.1, 0, 0.5), material=grey),
        SceneObject(name="side", mesh=placed((0.5, 0.3, 0.8), -0.9, -0.4, 0.5), material=grey),
    )
    return dataclasses.replace(every_surface(), objects=objects)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_scene(tmp_path_factory.mktemp("paper") / "data" / "web", boxes())


def noisy_paper(dataset: Dataset, **change: Any) -> tuple[PaperRenderer, PaperConfig]:
    torch.manual_seed(5)
    parts = {
        "width": 24,
        "blocks": 2,
        "texture_size": 20,
        "texture_features": 6,
        "position_size": 256,
        "layers": "online",
    }
    config = PaperConfig(**{**parts, **change})
    positions = positions_for(config.extrinsics, dataset, TRUTH, config.position_size)
    net = PaperRenderer(config, num_layers=LAYERS, num_objects=3, positions=positions)
    with torch.no_grad():
        for part in net.modules():
            if isinstance(part, NeuralTextures):
                part.table.normal_(0, 0.7 if part.layout.sizes[0] >= 20 else 0.15)
            elif isinstance(part, torch.nn.Linear):
                part.weight.normal_(0, 1.5 / part.in_features**0.5)
                part.bias.normal_(0, 0.2)
            elif isinstance(part, torch.nn.BatchNorm1d):
                assert part.running_mean is not None
                assert part.running_var is not None
                part.running_mean.normal_(0, 0.1)
                part.running_var.uniform_(0.5, 2)
        net.net.last.weight *= 0.4
        net.net.last.bias.fill_(0.5)  # In the middle of what can be shown.
    return net.eval(), config


def drawn_by_python(renderer: PaperRenderer, config: PaperConfig, dataset: Dataset, samples: int = 1) -> np.ndarray:
    told = dataclasses.replace(config, render_samples=samples)
    inputs = Inputs(dataset=dataset, geometry=TRUTH, num_layers=LAYERS, layers_seal="")
    pixels = told.load(inputs, "interpolating", [0], with_images=False)
    return predict_pixels(renderer, pixels).reshape(*SHAPE, 3)


@pytest.mark.parametrize(
    ("change", "quality", "samples", "least"),
    [
        pytest.param({}, "exact", 1, 45, marks=pytest.mark.full),
        ({"norm": "none", "texture_levels": 3, "finer_counts": 0.5}, "small", 4, 42),
        ({"extrinsics": "sh", "zero_layer": True, "texture_size": 40}, "exact", 1, 45),
        pytest.param({"extrinsics": "none", "width": 20, "blocks": 1}, "small", 1, 42, marks=pytest.mark.full),
    ],
    ids=["published", "best", "harmonics, a zero layer", "told nothing"],
)
def test_a_page_of_paper_draws_what_python_draws(
    browser: "Browser",
    dataset: Dataset,
    tmp_path: Path,
    change: dict[str, Any],
    quality: Any,
    samples: int,
    least: float,
) -> None:
    renderer, config = noisy_paper(dataset, **change)
    truth = drawn_by_python(renderer, config, dataset, samples)
    assert truth.std(axis=(0, 1)).max() > 10
    with opened_page(browser, tmp_path, renderer, dataset, quality, config) as page:
        assert psnr(page.picture(VIEW, SHAPE, samples), truth) >= least
        assert page.page.get_by_label("Material of").count() == 0
        assert page.complaints == []


def test_an_object_taken_out_of_a_page_of_paper_is_no_layer_any_more(
    browser: "Browser", dataset: Dataset, tmp_path: Path
) -> None:
    renderer, config = noisy_paper(dataset)
    edited = tuple(
        dataclasses.replace(item.mesh, faces=item.mesh.faces[:0]) if item.name == "outer" else item.mesh
        for item in boxes().objects
    )
    cameras = dataset.cameras("interpolating")
    pixels = TracedLayerPixels(cameras=cameras, rgb=black(cameras), peeler=Peeler(edited), num_layers=LAYERS)
    with opened_page(browser, tmp_path, renderer, dataset, config=config) as page:
        drawn = page.picture(VIEW, SHAPE, 1, {"outer": {"shown": False}})
    assert psnr(drawn, predict_pixels(renderer, pixels).reshape(*SHAPE, 3)) >= 45
    assert psnr(drawn, drawn_by_python(renderer, config, dataset)) < 35
