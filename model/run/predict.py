"""Owns prediction: from a run's weights to 8-bit pictures of the test splits."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor, nn

from datagen.data.config import Split
from datagen.data.dataset import Dataset
from datagen.data.paths import view_name
from datagen.data.png import png_bytes
from datagen.data.variants import homes_of_test_splits, open_annex, scale_name
from datagen.disk.errors import HyalineError, NumericsError
from datagen.disk.storage import commit, sha256
from datagen.terminal.command import say, track
from model.batches.rays import Pixels, PixelSource
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import LightPathPixels
from model.methods.light_path.refined_pixels import draw_refined
from model.methods.paper import PaperRenderer
from model.methods.table import METHODS, read_layers_of
from model.run.checkpoint import load_state
from model.run.run_folder import WEIGHTS, TrainConfig, is_config, write_prediction_hashes
from model.settings.runtime import keep_freed_memory


def predict_pixels(renderer: nn.Module, pixels: PixelSource) -> UInt8[np.ndarray, "pixel 3"]:
    """8-bit sRGB colours of all pixels, clipped and rounded; batch norm uses its running statistics.

    The renderer's mode (training or not) is the same afterwards.

    Raises:
        NumericsError: a colour is not finite, which 8 bits would show as black.
    """
    with torch.inference_mode():
        colors = predict_colors(renderer, pixels)
        if not bool(colors.isfinite().all()):
            raise NumericsError(
                "a predicted colour is not finite, so no picture of it is written; train anew with --overwrite and a "
                "lower --lr, or let `datagen verify` check its data"
            )
        return (colors.clamp_(0, 1) * 255).round_().byte().cpu().numpy()


@torch.inference_mode()
def predict_colors(renderer: nn.Module, pixels: PixelSource) -> Float32[Tensor, "pixel 3"]:
    """sRGB colours of all pixels as the renderer makes them, neither clipped nor rounded; on the pixels' device."""
    was_training = renderer.training
    renderer.eval()
    try:
        return _predict(renderer, pixels)
    finally:
        renderer.train(was_training)


def _predict(renderer: nn.Module, pixels: PixelSource) -> Float32[Tensor, "pixel 3"]:
    # Equal up to rounding, and in a third of the time.
    folded = {"folded": renderer.net.folded()} if isinstance(renderer, PaperRenderer) else {}
    if isinstance(renderer, PaperRenderer) and isinstance(pixels, Pixels):
        drawn = renderer.draw(pixels, folded["folded"])
        if drawn is not None:
            return drawn
        # Pixels without any layer are all of one colour.
        index, empty = pixels.split_empty()
    elif isinstance(renderer, LightPathRenderer) and isinstance(pixels, LightPathPixels):
        return draw_refined(renderer, pixels)
    else:
        index = torch.arange(len(pixels.rgb), device=pixels.rgb.device)
        empty = index[:0]
    parts = [renderer(pixels.take(part, None), **folded) for part in index.split(pixels.chunk)]
    colors = torch.empty(len(pixels.rgb), 3, device=pixels.device)
    colors[index] = torch.cat(parts)
    colors[empty] = colors[empty[:1]]
    return colors


def load_renderer(out: Path, config: TrainConfig, dataset: Dataset) -> nn.Module:
    """The trained renderer of a run, on the CPU.

    Raises:
        HyalineError: the weights are missing, damaged, or of another configuration.
    """
    if not (out / WEIGHTS).is_file():
        raise HyalineError(
            f"{out / WEIGHTS}: not there, the run is not trained to its end; the same `model train` goes on with it"
        )
    try:
        state = load_state(out / WEIGHTS)
    except HyalineError as error:
        raise HyalineError(f"{error}; train anew with --overwrite") from error
    if not is_config(state.get("config"), config):
        raise HyalineError(f"{out / WEIGHTS}: made by another configuration than run.json; train with --overwrite")
    method = METHODS[config.method]
    num_layers, _ = read_layers_of(method, dataset, config.geometry)
    renderer = method.build(config.net, dataset, config.geometry, num_layers)
    _check_parameters(renderer.state_dict(), state.get("renderer"), where=str(out / WEIGHTS))
    renderer.load_state_dict(cast(dict[str, Tensor], state["renderer"]))
    return renderer


def _check_parameters(expected: Mapping[str, Tensor], found: object, *, where: str) -> None:
    """Raises a HyalineError unless these are the numbers of a renderer, all finite: torch would cast what is not."""
    values = found if isinstance(found, dict) else {}
    for name in sorted(expected.keys() | values.keys(), key=str):
        value, wanted = values.get(name), expected.get(name)
        what = f"{tuple(value.shape)} of {value.dtype}" if isinstance(value, Tensor) else repr(value)[:40]
        if (
            wanted is None
            or not isinstance(value, Tensor)
            or (value.shape, value.dtype) != (wanted.shape, wanted.dtype)
        ):
            needed = "nothing" if wanted is None else f"{tuple(wanted.shape)} of {wanted.dtype}"
            raise HyalineError(f"{where}: {name} is {what}; expected {needed}, train anew with --overwrite")
        if not bool(torch.isfinite(value).all()):
            raise HyalineError(f"{where}: {name} holds numbers that are not finite; train anew with --overwrite")


def render_predictions(out: Path, config: TrainConfig, dataset: Dataset, *, device: torch.device) -> None:
    """Renders all test splits from a run's weights; the list of predictions comes last and finishes the run.

    Those are the two that every dataset has, and the splits by angle where they were built.
    """
    keep_freed_memory()
    renderer = load_renderer(out, config, dataset).to(device)
    files = render_views(renderer, config, homes_of_test_splits(dataset), out)
    write_prediction_hashes(out, files)
    say(f"{out}: rendered {len(files)} views")


def render_scaled(out: Path, config: TrainConfig, dataset: Dataset, scale: int, *, device: torch.device) -> None:
    """Renders the test splits of an annex, so many times as wide and high as the run was trained at, to RUN/x2 or so.

    Raises:
        HyalineError: the annex was not built.
    """
    keep_freed_memory()
    annex = open_annex(dataset, scale_name(scale))
    if annex is None:
        raise HyalineError(
            f"{dataset.root}: has no truth {scale} times as large; make it with "
            f"`datagen build --dataset {shlex.quote(str(dataset.root))} --super-resolution {scale}`"
        )
    renderer = load_renderer(out, config, dataset).to(device)
    place = out / scale_name(scale)
    files = render_views(renderer, config, dict.fromkeys(annex.splits, annex), place)
    write_prediction_hashes(place, files)
    say(f"{place}: rendered {len(files)} views")


def render_views(renderer: nn.Module, config: TrainConfig, homes: Mapping[Split, Dataset], out: Path
                 ) -> dict[str, str]:  # fmt: skip
    """Commits the pictures of test splits, each of its dataset or annex, as `out`/predictions/SPLIT/0000.png.

    Returns:
        SHA-256 of each picture by path relative to `out`.
    """
    method = METHODS[config.method]
    device = next(renderer.parameters()).device
    todo: list[tuple[Dataset, Split, int]] = [
        (home, split, view) for split, home in homes.items() for view in range(home.config.split(split).views)
    ]
    files: dict[str, str] = {}
    for home, split, view in track(todo, label="render", total=len(todo)):
        path = out / "predictions" / split / f"{view_name(view)}.png"
        size = home.config.resolution
        pixels = method.load(config.net, home, config.geometry, split, [view], False).to(device)
        try:
            data = png_bytes(predict_pixels(renderer, pixels).reshape(size, size, 3))
        except NumericsError as error:
            raise NumericsError(f"{path}: {error}") from error
        commit(path, data)
        files[path.relative_to(out).as_posix()] = sha256(data)
    return files
