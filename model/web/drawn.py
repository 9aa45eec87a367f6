"""What a page's shader is made of, and what it reads, for one method."""

from dataclasses import dataclass

from model.nets.texture import NeuralTextures, TexturePyramid
from model.web.weights import Rows


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """A trained renderer, as the page draws it."""

    shaders: tuple[str, ...]
    """Files beside this one, in the order in which they form one text."""
    defines: dict[str, int | float]
    """The numbers that stand above the shader."""
    textures: NeuralTextures | TexturePyramid
    """`shells` of them for each object."""
    features: int
    """Channels of a texel, a multiple of 4."""
    weights: list[Rows]
    """All that the shader reads of networks, in its order."""
    samples: int
    """Rays of a pixel that `model render` takes."""
    shells: int = 1
    """Nested copies of each surface that straight rays meet."""
    relief: list[list[int]] | None = None
    """Place of the first of each texture's learned depths among the weights, four to a row, and its width."""
    knows_materials: bool = True
    """Light is followed as the materials say."""
