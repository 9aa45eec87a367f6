"""Owns the list of methods: what `model train --method NAME` can train. A new method is a file and an entry here."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import nn

from datagen.dataset import Dataset
from datagen.layers import LayerKind
from model.paper import PaperConfig, build_paper

MethodConfig = PaperConfig
"""The configuration of any method; a union once there are several."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """How a method is built. Its module maps a `RayBatch` (and `rng`, while training) to sRGB colours (ray, 3)."""

    layers: LayerKind
    build: Callable[[MethodConfig, Dataset, str, int], nn.Module]
    """A fresh module for (configuration, dataset, geometry, number of layers), random from torch's own generator."""


METHODS: dict[str, Method] = {
    "paper": Method(layers="straight", build=build_paper),
}
