"""Prediction: from a run's weights to 8-bit pictures of the test splits, for the dataset and its variants."""

import contextlib
import dataclasses
import itertools
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8
from torch import Tensor, nn

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import list_geometries
from datagen.data.images import png_bytes
from datagen.data.paths import view_name
from datagen.disk.errors import DamagedError, HyalineError, NumericsError
from datagen.disk.ownership import remove_files
from datagen.disk.storage import commit, sha256
from datagen.terminal.command import say, track
from model.batches.rays import PixelSource
from model.methods.protocol import open_inputs
from model.methods.renderer import Renderer
from model.nets.pixel_mlp import ExtrinsicInputs, bake_position_table
from model.nets.texture import NeuralTextures, TextureLayout, object_layout
from model.run.run_folder import (
    WEIGHTS,
    TrainConfig,
    check_state_of,
    drawn_along,
    is_drawn,
    predictions_folder,
    read_predictions,
    write_predictions,
)
from model.runtime import keep_freed_memory
from model.state import load_state


def predict_pixels(
    renderer: Renderer, pixels: PixelSource, index: Int[Tensor, " pixel"] | None = None
) -> UInt8[np.ndarray, "pixel 3"]:
    """8-bit sRGB colours of pixels, clipped and rounded; batch norm uses its running statistics.

    Args:
        index: row numbers, those of whole views if `pixels.whole_views`; None: all.

    Raises:
        NumericsError: a colour is not finite, which 8 bits would show as black.
    """
    with torch.inference_mode():
        colors = predict_colors(renderer, pixels, index)
        if not bool(colors.isfinite().all()):
            raise NumericsError(
                "a predicted colour is not finite, so its picture is not written; train again with --overwrite and a "
                "lower --lr, or check the data with `datagen verify`"
            )
        return (colors.clamp_(0, 1) * 255).round_().byte().cpu().numpy()


@torch.inference_mode()
def predict_colors(
    renderer: Renderer, pixels: PixelSource, index: Int[Tensor, " pixel"] | None = None
) -> Float32[Tensor, "pixel 3"]:
    """As `predict_pixels`, but neither clipped nor rounded; on the pixels' device."""
    was_training = renderer.training
    renderer.eval()
    try:
        return renderer.render(pixels, index)
    finally:
        renderer.train(was_training)


def load_renderer(out: Path, config: TrainConfig, dataset: Dataset) -> Renderer:
    """The trained renderer of a run, on the CPU."""
    if not (out / WEIGHTS).is_file():
        raise HyalineError(
            f"{out / WEIGHTS}: missing, because training is not finished; the same `model train` command resumes it"
        )
    try:
        state = load_state(out / WEIGHTS)
    except DamagedError as error:
        raise HyalineError(f"{error}; train again with --overwrite") from error
    inputs = open_inputs(config.net, dataset, config.geometry)
    check_state_of(state, config, inputs, path=out / WEIGHTS)
    renderer = config.net.build(inputs)
    check_parameters(renderer.state_dict(), state.get("renderer"), where=str(out / WEIGHTS))
    renderer.load_state_dict(cast(dict[str, Tensor], state["renderer"]))
    return renderer


def check_parameters(expected: Mapping[str, Tensor], found: object, *, where: str) -> None:
    """Raises a HyalineError unless these are a renderer's parameters, all finite; torch would cast other types."""
    values = found if isinstance(found, dict) else {}
    for name in sorted(expected.keys() | values.keys(), key=str):
        value, (is_there, needed) = values.get(name), map(_form, (values.get(name), expected.get(name)))
        if is_there != needed:
            raise HyalineError(f"{where}: {name} is {is_there}; expected {needed}, train again with --overwrite")
        if not bool(torch.isfinite(cast(Tensor, value)).all()):
            raise HyalineError(f"{where}: {name} contains numbers that are not finite; train again with --overwrite")


def _form(value: object) -> str:
    return f"{tuple(value.shape)} of {value.dtype}" if isinstance(value, Tensor) else f"no tensor ({value!r:.40})"


def render_predictions(run: Path, config: TrainConfig, dataset: Dataset, *, device: torch.device) -> int:
    """Renders all test splits from a run's weights, those by angle first unless they are there already.

    Returns:
        The number of pictures.
    """
    homes = [*(home for home in drawn_along(dataset) if not is_drawn(run, home)), dataset]
    keep_freed_memory()
    renderer = load_renderer(run, config, dataset).to(device)
    return sum(_draw(renderer, run, config, home) for home in homes)


def render_variant(run: Path, config: TrainConfig, dataset: Dataset, variant: Dataset, *, device: torch.device) -> None:
    """Renders all splits of a variant from the run's weights."""
    check_can_draw(config, dataset, variant)
    keep_freed_memory()
    renderer = load_renderer(run, config, dataset)
    if variant.edit is not None:
        show_edited_scene(renderer, dataset, variant, config.geometry)
    _draw(renderer.to(device), run, config, variant)


def _draw(renderer: Renderer, run: Path, config: TrainConfig, home: Dataset) -> int:
    """Commits the pictures of all splits of a dataset or variant except `train`, then their list; their number."""
    folder = predictions_folder(run, home)
    device = next(itertools.chain(renderer.parameters(), renderer.buffers())).device
    inputs = open_inputs(config.net, home, config.geometry)
    splits: list[Split] = [split for split in home.splits if split != "train"]
    todo: list[tuple[Split, int]] = [(split, view) for split in splits for view in range(home.num_views[split])]
    files: dict[str, str] = {}
    for split, view in track(todo, label="render", total=len(todo)):
        path = folder / "predictions" / split / f"{view_name(view)}.png"
        pixels = config.net.load(inputs, split, [view], with_images=False).to(device)
        try:
            data = png_bytes(predict_pixels(renderer, pixels).reshape(*home.config.resolution.shape, 3))
        except NumericsError as error:
            raise NumericsError(f"{path}: {error}") from error
        commit(path, data)
        files[path.relative_to(folder).as_posix()] = sha256(data)
    with contextlib.suppress(HyalineError):  # The variant may have had more views.
        remove_files(folder, read_predictions(folder).keys() - files.keys())
    write_predictions(run, home, files)
    say(f"{folder}: rendered {len(files)} views")
    return len(files)


def check_can_draw(config: TrainConfig, dataset: Dataset, variant: Dataset) -> None:
    """Raises a HyalineError if the variant is an edit that the run cannot draw."""
    if variant.edit is None:
        return
    check_draws_edits(config)
    if config.geometry not in list_geometries(variant):
        words = [word for edit in variant.edit.edits for word in ("--edit", edit)]
        again = shlex.join(["datagen", "add", str(dataset.root), *words])
        raise HyalineError(
            f"{variant.root}: has no {config.geometry} proxies; `{again}` adds those that {dataset.root} has now"
        )


def check_draws_edits(config: TrainConfig) -> None:
    """Raises a HyalineError if the run's method uses no geometry, and so cannot draw any edit."""
    if not config.net.uses_geometry:
        raise HyalineError(f"--variant: method {config.method} uses no geometry, so it cannot draw an edit")


def film_pictures(
    run: Path, config: TrainConfig, dataset: Dataset, cameras: Cameras, *, device: torch.device
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Draws a run's pictures through these cameras, 8-bit sRGB, one by one."""
    inputs = open_inputs(config.net, dataset, config.geometry)
    check_draws_cameras(run, config)
    keep_freed_memory()
    renderer = load_renderer(run, config, dataset).to(device)
    for view in track(range(len(cameras)), label="render", total=len(cameras)):
        one = dataclasses.replace(cameras, world_from_camera=cameras.world_from_camera[view : view + 1])
        pixels = config.net.load_cameras(inputs, one).to(device)
        yield predict_pixels(renderer, pixels).reshape(cameras.height, cameras.width, 3)


def check_draws_cameras(run: Path, config: TrainConfig) -> None:
    """Raises a HyalineError if the run's method can only draw the views of its dataset."""
    if not config.net.draws_cameras:
        raise HyalineError(
            f"{run}: {config.method} can only draw the views of its dataset, because its MethodConfig has no "
            "load_cameras (docs/extending.md)"
        )


def show_edited_scene(renderer: nn.Module, base: Dataset, edited: Dataset, geometry: str) -> None:
    """Makes a trained renderer ready for the layers of the edited scene; no weight and no texel changes.

    A copy looks up its original's texels, and the view vectors of Eq. 3 start at the objects' new positions.
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
    """The layout with further objects; number k shares all texels of the object at `originals[k]` (from 0).

    Args:
        num_objects: objects of the given layout; all have equally many textures, stored one after the other.
    """

    def more(values: tuple[int, ...]) -> tuple[int, ...]:
        each = len(values) // num_objects
        return (*values, *(value for index in originals for value in values[index * each : (index + 1) * each]))

    return dataclasses.replace(layout, bases=more(layout.bases), sizes=more(layout.sizes), strides=more(layout.strides))
