"""Edited scenes for trained renderers: weights and textures as they are, other layers."""

import dataclasses

from torch import nn

from datagen.data.dataset import Dataset
from model.nets.extrinsics import ExtrinsicInputs, bake_position_table
from model.nets.texture import NeuralTextures, TextureLayout, object_layout


def show_edited_scene(renderer: nn.Module, base: Dataset, edited: Dataset, geometry: str) -> None:
    """Makes a trained renderer ready for the layers of the edited scene; no weight and no texel changes.

    A copy looks up its original's texels, and the view vectors of Eq. 3 start where objects stand now.
    """
    assert edited.edit is not None
    names = [item.name for item in base.objects]
    originals = [names.index(edited.edit.copies[item.name]) for item in edited.objects[len(names) :]]
    for part in renderer.modules():
        if isinstance(part, NeuralTextures):
            part.layout = with_copies(part.layout, originals, len(names))
        elif isinstance(part, ExtrinsicInputs):
            size = part.layout.sizes[0]
            part.positions = bake_position_table(edited, geometry, size)
            part.layout = object_layout((size,) * len(edited.objects))


def with_copies(layout: TextureLayout, originals: list[int], num_objects: int) -> TextureLayout:
    """The layout with further objects, each of which shares all texels of the one at `originals[k]` (from 0).

    Args:
        num_objects: of the layout as it is; each has as many textures, one after the other, as any other.
    """

    def more(values: tuple[int, ...]) -> tuple[int, ...]:
        each = len(values) // num_objects
        return (*values, *(value for index in originals for value in values[index * each : (index + 1) * each]))

    return dataclasses.replace(layout, bases=more(layout.bases), sizes=more(layout.sizes), strides=more(layout.strides))
