"""A method's part of its web page: its piece of the shader, its textures, and its networks' weights.

docs/extending.md shows how a method brings one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources

import numpy as np
from jaxtyping import Float32
from torch import Tensor, nn

from model.nets.texture import NeuralTextures, TexturePyramid

Rows = Float32[np.ndarray, "_ 4"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MethodPage:
    """A trained renderer, as the page draws it."""

    shader: str
    """GLSL with a function `vec3 shade(vec3 o, vec3 d, vec2 row, uint ray)`: linear radiance of the ray from `o` along
    `d`. It comes after plugins/hyaline_web/page/rays.glsl and networks.glsl and may use all that these define."""
    defines: dict[str, int | float] = field(default_factory=dict)
    """Numbers by the names that the shader uses for them."""
    textures: NeuralTextures | TexturePyramid
    """The learned textures, `shells` of them for each object."""
    weights: Sequence[Rows] = ()
    """The rows that the shader reads by `fetch(weights, row)`, in this order."""
    samples: int = 1
    """Rays per pixel of `model predict`."""
    shells: int = 1
    """Nested copies of each surface that straight rays meet."""
    relief: list[list[int]] | None = None
    """For each texture, the position of its first learned depth among the weights, four to a row, and its width."""
    has_normals: bool = False
    """True if the shader uses shading normals; otherwise it gets face normals, and the page stores none."""
    follows_light: bool = False
    """True if light is traced by the materials: edits may change materials, and the shader answers the task PATH."""


def package_text(package: str, *names: str) -> str:
    """The text of files in a package, one after the other."""
    return "\n".join(resources.files(package).joinpath(name).read_text(encoding="utf-8") for name in names)


def layer_rows(weight: Tensor, bias: Tensor, columns: Sequence[int] | None = None) -> list[Rows]:
    """A linear layer: weights for four outputs at once, input by input, then biases; units come in fours.

    Args:
        columns: the input at each position, -1 for none; by default all inputs, padded to a multiple of four.
    """
    values, biases = (value.detach().cpu().numpy().astype(np.float32) for value in (weight, bias))
    if columns is None:
        values = np.pad(values, ((0, 0), (0, fours(values.shape[1]) - values.shape[1])))
    else:
        values = np.concatenate([values, np.zeros((len(values), 1), np.float32)], axis=1)[:, list(columns)]
    more = fours(len(values)) - len(values)
    values, biases = np.pad(values, ((0, more), (0, 0))), np.pad(biases, (0, more))
    return [values.reshape(-1, 4, values.shape[1]).transpose(0, 2, 1).reshape(-1, 4), biases.reshape(-1, 4)]


def mlp_rows(net: nn.Sequential, columns: Sequence[int]) -> list[Rows]:
    """All layers of a network; the columns are those of the first."""
    first, *others = [layer for layer in net if isinstance(layer, nn.Linear)]
    return [
        *layer_rows(first.weight, first.bias, columns),
        *(rows for layer in others for rows in layer_rows(layer.weight, layer.bias)),
    ]


def feature_columns(features: int, others: int, first: int = 0) -> list[int]:
    """The columns of features, padded to a multiple of four, and of the inputs after them."""
    filler = [-1] * (fours(features) - features)
    return [*range(first, first + features), *filler, *range(first + features, first + features + others)]


def fours(count: int) -> int:
    """The next multiple of 4: textures hold four numbers in each place."""
    return -(-count // 4) * 4
