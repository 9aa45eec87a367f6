"""How `paper` and `mlp-first` are made: what the dataset decides, the renderer, and the pixels."""

import dataclasses
from collections.abc import Sequence

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from model.batches.rays import PixelSource, RayBatch
from model.batches.traced_layers import load_traced_layers, trace_cameras
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer, build_paper, complete_paper
from model.methods.protocol import Inputs
from model.methods.stored_pixels import load_stored, peel_as_stored


def complete(config: PaperConfig, inputs: Inputs) -> PaperConfig:
    width, texture_size = complete_paper(config, inputs)
    return dataclasses.replace(config, width=width, texture_size=texture_size)


def build(config: PaperConfig, inputs: Inputs) -> PaperRenderer:
    return build_paper(config, inputs)


def load(
    config: PaperConfig, inputs: Inputs, split: Split, views: Sequence[int], *, with_images: bool, mapped: bool
) -> PixelSource[RayBatch]:
    if not config.traces_layers:
        return load_stored(inputs, split, views, with_images=with_images, mapped=mapped)
    return load_traced_layers(
        inputs.dataset,
        inputs.geometry,
        inputs.num_layers,
        split,
        views,
        with_images,
        train_samples=config.train_samples,
        render_samples=config.render_samples,
    )


def load_cameras(config: PaperConfig, inputs: Inputs, cameras: Cameras) -> PixelSource[RayBatch]:
    if not config.traces_layers:
        return peel_as_stored(inputs, cameras)
    return trace_cameras(
        inputs.dataset,
        inputs.geometry,
        inputs.num_layers,
        cameras,
        train_samples=config.train_samples,
        render_samples=config.render_samples,
    )
