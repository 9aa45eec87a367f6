"""Owns the list of methods: what `model train --method NAME` can train. A new method is a file and an entry here."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from torch import Tensor, nn

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.layer_store import LayersHead
from datagen.data.paths import LayerKind
from model.batches.pixel_cache import map_pixels
from model.batches.rays import PixelSource, load_pixels
from model.batches.traced_layers import load_traced_layers
from model.batches.view_batches import load_views
from model.losses.pixel_losses import pixel_loss
from model.methods.authors_code import AuthorsConfig, authors_loss, build_authors, configure_authors
from model.methods.deepvoxels import PRESETS, DeepVoxelsConfig, build_deepvoxels, configure_deepvoxels, preset_of
from model.methods.deepvoxels_loss import deepvoxels_loss
from model.methods.dnr import DnrConfig, build_dnr, configure_dnr, image_loss
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.configure import configure_light_path
from model.methods.light_path.net import build_light_path
from model.methods.light_path.pixels import load_light_path_pixels
from model.methods.paper import PaperConfig, build_paper, choose_layers, configure_paper
from model.settings.choices import DeepVoxelsChoices, PaperChoices
from model.settings.paper_presets import DEFAULT_STEPS, PAPER_PRESETS

LrDecay = Literal["none", "linear", "cosine"]

MethodConfig = PaperConfig | LightPathConfig | DnrConfig | AuthorsConfig | DeepVoxelsConfig
"""The configuration of any method."""


@dataclass(frozen=True, kw_only=True)
class Optimisation:
    """How a method is trained unless the command says otherwise."""

    batch: int
    lr: float
    texture_lr: float | None
    lr_decay: LrDecay
    sky_lr: float | None = None
    steps: int = DEFAULT_STEPS
    softness: float = 0.0
    """Of the loss (`LossConfig`), as the next one."""
    debias: float = 0.0
    updates: int = 1
    beta1: float = 0.9
    weight_decay: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Method:
    """How a method is built and fed. Its module maps what the source takes (and `rng`, while training) to sRGB."""

    layers: LayerKind | None
    """The stored layers that it looks up; None when it traces its own."""
    knowledge: str
    """What it is given besides geometry, images and cameras; empty for nothing."""
    optimisation: Optimisation
    configure: Callable[[Any, Dataset, str, int], Any]
    """The configuration from (choices, dataset, geometry, number of layers)."""
    build: Callable[[Any, Dataset, str, int], nn.Module]
    """A fresh module for (configuration, dataset, geometry, number of layers), random from torch's own generator."""
    load: Callable[..., PixelSource]
    """The pixels of views for (configuration, dataset, geometry, split, views, with images); where `reads_layers`,
    `mapped=True` keeps them in files."""
    loss: Callable[..., Tensor] = pixel_loss
    """What a step makes small: for (module, training pixels, batch, generator of the step), and for the patch terms
    `patch_terms` of its configuration, where the method has such choices."""
    max_layers: int | None = None
    """The nearest stored layers that it looks at; None: all of them."""
    optimise: Callable[[Any, Optimisation], Optimisation] = lambda choices, usual: usual  # noqa: ARG005
    """What `optimisation` becomes by the user's choices."""
    uses_geometry: bool = True
    """False: surfaces are not known to it, and `knowledge` says all that is."""


def _load_straight(config: PaperConfig, dataset: Dataset, geometry: str, split: Split, views: Sequence[int],
                   with_images: bool, *, max_layers: int | None = None, mapped: bool = False
                   ) -> PixelSource:  # fmt: skip
    stored, _ = read_layers_of(METHODS["paper"], dataset, geometry)
    num_layers = choose_layers(config.num_layers, min(stored, max_layers or stored))
    if not traces_layers(config):
        load = map_pixels if mapped else load_pixels
        return load(dataset, geometry, split, views, with_images=with_images, max_layers=num_layers)
    return load_traced_layers(
        dataset, geometry, num_layers, split, views, with_images,
        train_samples=config.train_samples, render_samples=config.render_samples,
    )  # fmt: skip


def _load_stored(
    config: object,  # noqa: ARG001
    dataset: Dataset,
    geometry: str,
    split: Split,
    views: Sequence[int],
    with_images: bool,
    *,
    max_layers: int | None = None,
    whole_views: bool = False,
    mapped: bool = False,
) -> PixelSource:
    load = map_pixels if mapped else load_pixels
    return load(
        dataset, geometry, split, views, with_images=with_images, max_layers=max_layers, whole_views=whole_views
    )


def traces_layers(config: object) -> bool:
    """True when layers are traced for each batch: for `paper` online, or with several rays a pixel."""
    return isinstance(config, PaperConfig) and (config.online or max(config.train_samples, config.render_samples) > 1)


def _optimise_paper(choices: PaperChoices, usual: Optimisation) -> Optimisation:
    preset = PAPER_PRESETS[choices.preset]
    return dataclasses.replace(
        usual,
        steps=preset.steps,
        batch=preset.batch,
        lr=preset.lr,
        texture_lr=preset.texture_lr,
        lr_decay=preset.lr_decay,
        softness=preset.softness,
    )


def _optimise_voxels(choices: DeepVoxelsChoices, usual: Optimisation) -> Optimisation:
    preset = PRESETS[preset_of(choices)]
    return dataclasses.replace(usual, lr=preset.lr, lr_decay=preset.lr_decay)


# The paper's rate; decay as in the authors' scripts (see TrainConfig).
_PIXELS = Optimisation(batch=8192, lr=0.001, texture_lr=None, lr_decay="linear")
# The same, and about as many pixels a step as one picture of the demo has.
_IMAGES = dataclasses.replace(_PIXELS, batch=16_384)

METHODS: dict[str, Method] = {
    "paper": Method(
        layers="straight",
        knowledge="",
        optimisation=_PIXELS,
        optimise=_optimise_paper,
        configure=configure_paper,
        build=build_paper,
        load=_load_straight,
    ),
    "mlp-first": Method(
        layers="straight",
        knowledge="",
        optimisation=_PIXELS,
        optimise=_optimise_paper,
        configure=configure_paper,
        build=build_paper,
        load=partial(_load_straight, max_layers=1),
        max_layers=1,
    ),
    "dnr": Method(
        layers="straight",
        knowledge="",
        optimisation=_IMAGES,
        configure=configure_dnr,
        build=build_dnr,
        load=partial(_load_stored, max_layers=1, whole_views=True),
        loss=image_loss,
        max_layers=1,
    ),
    "dnr-layers": Method(
        layers="straight",
        knowledge="",
        optimisation=_IMAGES,
        configure=configure_dnr,
        build=build_dnr,
        load=partial(_load_stored, whole_views=True),
        loss=image_loss,
    ),
    "authors-code": Method(
        layers="straight",
        knowledge="",
        optimisation=dataclasses.replace(_PIXELS, beta1=0.5, weight_decay=1e-4),
        configure=configure_authors,
        build=build_authors,
        load=_load_stored,
        loss=authors_loss,
    ),
    "light-path": Method(
        layers=None,
        knowledge="materials (all but diffuse colours)",
        # A quarter of the pixels with four rays each: as many rays a step as `paper`.
        optimisation=Optimisation(batch=2048, lr=0.002, texture_lr=0.04, lr_decay="cosine", updates=4, softness=0.05),
        optimise=lambda choices, usual: dataclasses.replace(usual, sky_lr=choices.sky_lr, debias=choices.debias),
        configure=configure_light_path,
        build=build_light_path,
        load=load_light_path_pixels,
    ),
    "deepvoxels": Method(
        layers=None,
        knowledge="cameras only, and the scene's extent",
        # A batch is the pictures drawn in a step. The rate is the paper's; another preset brings its own.
        optimisation=Optimisation(batch=2, lr=PRESETS["paper"].lr, texture_lr=None, lr_decay="none"),
        optimise=_optimise_voxels,
        configure=configure_deepvoxels,
        build=build_deepvoxels,
        load=load_views,
        loss=deepvoxels_loss,
        uses_geometry=False,
    ),
}


def read_layers_of(method: Method, dataset: Dataset, geometry: str) -> tuple[int, str]:
    """The number of stored layers that a method looks up, and their seal; 0 and the dataset's where it traces its own.

    Raises:
        HyalineError: the geometry was not peeled.
    """
    if method.layers is None:
        return 0, dataset.seal
    store = dataset.layer_store(geometry, method.layers)
    assert isinstance(store.head, LayersHead), "no method looks up light paths"
    return min(store.head.num_layers, method.max_layers or store.head.num_layers), store.seal
