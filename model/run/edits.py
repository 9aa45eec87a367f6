"""Owns the drawing of edited scenes: trained weights and textures as they are, other layers.

RUN/edits/NAME/predictions/SPLIT/0000.png   8-bit sRGB
RUN/edits/NAME/predictions.json             sealed, written last: the edit's seal, SHA-256 of each picture
"""

import dataclasses
from pathlib import Path
from typing import cast

import torch
from torch import nn

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset
from datagen.disk.records import Json
from datagen.disk.storage import commit_sealed, load_sealed
from datagen.terminal.command import say
from model.nets.extrinsics import ExtrinsicInputs, bake_position_table
from model.nets.texture import NeuralTextures, TextureLayout, object_layout
from model.run.predict import load_renderer, render_views
from model.run.run_folder import PREDICTIONS, RUN_VERSION, TrainConfig, is_finished
from model.settings.runtime import keep_freed_memory


def edit_folder(run: Path, edited: Dataset) -> Path:
    """Where a run's pictures of an edited scene lie."""
    return run / "edits" / edited.name


def is_edit_rendered(run: Path, edited: Dataset) -> bool:
    """True when all pictures of this edited scene are there and verify."""
    folder = edit_folder(run, edited)
    return is_finished(folder) and load_sealed(folder / PREDICTIONS).get("dataset_seal") == edited.seal


def render_edit(run: Path, config: TrainConfig, base: Dataset, edited: Dataset, *, device: torch.device) -> None:
    """Renders both test splits of an edited scene from the run's weights; the list of pictures comes last."""
    keep_freed_memory()
    renderer = load_renderer(run, config, base)
    show_edited_scene(renderer, base, edited, config.geometry)
    folder = edit_folder(run, edited)
    (folder / PREDICTIONS).unlink(missing_ok=True)
    files = render_views(renderer.to(device), config, dict.fromkeys(TEST_SPLITS, edited), folder)
    content: dict[str, Json] = {"version": RUN_VERSION, "dataset_seal": edited.seal, "files": cast(Json, files)}
    commit_sealed(folder / PREDICTIONS, content)
    say(f"{folder}: rendered {len(files)} views")


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
