"""Owns the command `model`: parse, make a configuration, call one function."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from datagen.command import choose, next_command, run, say
from datagen.dataset import Dataset, find_dataset, open_dataset
from datagen.errors import HyalineError
from datagen.geometry import TRUTH, check_geometry
from model.runtime import wait_without_spinning

if TYPE_CHECKING:
    import torch

    from model.run_folder import TrainConfig


def train(
    *,
    method: str,
    dataset: str | None = None,
    geometry: str = TRUTH,
    out: Path | None = None,
    name: str | None = None,
    extrinsics: Literal["none", "view", "sh"] = "view",
    width: str = "34k",
    blocks: int = 3,
    norm: Literal["batch", "none"] = "batch",
    textures: Literal["object", "scene"] = "object",
    texture_size: int | None = None,
    zero_layer: bool = False,
    rays: int | None = None,
    render_rays: int | None = None,
    branches: int = 12,
    compositing: Literal["physics", "stack"] = "physics",
    stack: int | None = None,
    straight_layers: int | None = None,
    environment: int = 32,
    position_octaves: int = 0,
    texture_levels: int = 5,
    steps: int = 2500,
    batch: int | None = None,
    lr: float | None = None,
    texture_lr: float | None = None,
    lr_decay: Literal["none", "linear", "cosine"] | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Train a renderer on a dataset, then render both test splits with it.

    Args:
        method: What to train: paper (straight layers, stacked), or light-path (refracted paths, composited).
        dataset: Dataset folder, or its name under data/. Default: the only one there.
        geometry: Whose layers to look up: truth, or a kind of proxy such as box.
        out: Folder of the run. Default: runs/SCENE/METHOD, with a suffix for each choice that is not the default.
        name: Label of the run in tables. Default: from the folder's name.
        extrinsics: paper: what each layer is told of the camera: nothing, the view vector, or three bands of SH of it.
        width: paper: hidden units of the first layer: 34k (as many as make 34,000 parameters), 256, or any number.
        blocks: paper: residual blocks; each halves the channels.
        norm: paper: batch norm after each linear layer (the paper's text) or none (the authors' code).
        textures: paper: a neural texture for each object, or one for the whole scene.
        texture_size: Width and height of a texture in texels; light-path shares as many texels among the objects by how
            much is seen of each. Default: half the image's width for paper, all of it for light-path.
        zero_layer: paper: insert a layer of zeros at a random place while training (section 4.4).
        rays: Rays per pixel while training, a square number. Default: 1 for paper, 4 for light-path.
        render_rays: Rays per pixel while rendering, a square number. Default: 1 for paper, 16 for light-path.
        branches: light-path: branches followed for each ray: refracted, first mirror, then those of most light.
        compositing: light-path: sum what shines at the ends of branches, weighted by physics; or let the stack network
            alone make the colour.
        stack: light-path: hidden units of the network that sees the stacked vertices and adds what physics leaves out;
            0 leaves it out. Default: 32, on proxies 96.
        straight_layers: light-path: straight layers that this network sees beside the paths. Default: 0, on proxies 8.
        environment: light-path: height in texels of the finest map of the learned sky; 1 makes it two colours.
        position_octaves: light-path: octaves of the position that the decoder is told.
        texture_levels: light-path: textures summed, each half as wide as the one before.
        steps: Optimiser steps; more for larger datasets.
        batch: Random pixels a step. Default: 8192 for paper, 2048 (of several rays) for light-path.
        lr: Learning rate of Adam. Default: 0.001 for paper, 0.002 for light-path.
        texture_lr: Learning rate of the textures. Default: the same for paper, 0.04 for light-path.
        lr_decay: none, linear (constant, then down to 0 over the second half) or cosine. Default: linear for paper,
            cosine for light-path.
        seed: Seed of everything random.
        device: Where to compute; auto takes a GPU where there is one.
        resume: Go on with an unfinished run.
        overwrite: Delete the run that is there and start anew.
    """
    from model.methods import METHODS, read_layers_of

    choose("method", method, METHODS)
    opened = open_dataset(find_dataset(dataset))
    check_geometry(opened, geometry)

    from model.light_path_net import default_light_path
    from model.paper import PaperConfig, count_inputs, default_texture_size
    from model.pixel_mlp import width_for_34k
    from model.run_folder import TrainConfig
    from model.traced_batches import share_texels

    num_layers, _ = read_layers_of(METHODS[method], opened, geometry)
    resolution, num_objects = opened.config.resolution, len(opened.objects)
    paper_only = {
        "extrinsics": extrinsics != "view",
        "width": width != "34k",
        "blocks": blocks != 3,
        "norm": norm != "batch",
        "textures": textures != "object",
        "zero-layer": zero_layer,
    }
    light_path_only = {
        "branches": branches != 12,
        "compositing": compositing != "physics",
        "stack": stack is not None,
        "straight-layers": straight_layers is not None,
        "environment": environment != 32,
        "position-octaves": position_octaves != 0,
        "texture-levels": texture_levels != 5,
    }
    _refuse(method, light_path_only if method == "paper" else paper_only)
    if method == "paper":
        inputs = count_inputs(num_layers, texture_features=16, extrinsics=extrinsics, zero_layer=zero_layer)
        net = PaperConfig(
            width=width_for_34k(inputs, blocks) if width == "34k" else _parse_width(width),
            blocks=blocks,
            norm=norm,
            extrinsics=extrinsics,
            textures=textures,
            texture_size=texture_size or default_texture_size(resolution, num_objects, textures),
            zero_layer=zero_layer,
            train_samples=1 if rays is None else rays,
            render_samples=1 if render_rays is None else render_rays,
        )
    else:
        sizes = share_texels(opened, geometry, texture_size or resolution)
        known = default_light_path(sizes, is_proxy=geometry != TRUTH)
        net = dataclasses.replace(
            known,
            texture_levels=texture_levels,
            position_octaves=position_octaves,
            composite=compositing == "physics",
            stack_hidden=known.stack_hidden if stack is None else stack,
            straight_layers=known.straight_layers if straight_layers is None else straight_layers,
            environment_size=environment,
            branches=branches,
            train_samples=known.train_samples if rays is None else rays,
            render_samples=known.render_samples if render_rays is None else render_rays,
        )
    defaults = METHODS[method].optimisation
    config = TrainConfig(
        method=method,
        geometry=geometry,
        net=net,
        seed=seed,
        steps=steps,
        batch=defaults.batch if batch is None else batch,
        lr=defaults.lr if lr is None else lr,
        texture_lr=defaults.texture_lr if texture_lr is None else texture_lr,
        lr_decay=lr_decay or defaults.lr_decay,
    )
    choices = {
        geometry: geometry != TRUTH,
        {"none": "no-extrinsics", "sh": "sh", "view": ""}[extrinsics]: extrinsics != "view",
        f"w{width}": width != "34k",
        f"{blocks}-blocks": blocks != 3,
        "no-norm": norm == "none",
        "scene-texture": textures == "scene",
        f"t{texture_size}": texture_size is not None,
        "zero-layer": zero_layer,
        f"{rays}-rays": rays is not None,
        f"{render_rays}-render-rays": render_rays is not None,
        f"{branches}-branches": branches != 12,
        compositing: compositing != "physics",
        f"stack{stack}": stack is not None,
        f"{straight_layers}-straight": straight_layers is not None,
        f"sky{environment}": environment != 32,
        f"{position_octaves}-octaves": position_octaves != 0,
        f"{texture_levels}-levels": texture_levels != 5,
        f"{steps}-steps": steps != 2500,
        f"seed{seed}": seed != 0,
    }
    folder = "-".join([method, *(suffix for suffix, is_chosen in choices.items() if is_chosen)])
    out = out or Path("runs") / opened.name / folder
    _train(config, opened, out, label=name or out.name, device=_device(device), resume=resume, anew=overwrite)


def _train(
    config: "TrainConfig", dataset: Dataset, out: Path, *, label: str, device: "torch.device", resume: bool, anew: bool
) -> None:
    from datagen.storage import one_writer, remove_temporaries
    from model.predict import render_predictions
    from model.run_folder import RUN, WEIGHTS, clear_run, is_finished
    from model.train import train as train_run

    if resume and anew:
        raise HyalineError("--resume and --overwrite: exclude each other; give one of them")
    with one_writer(out):
        remove_temporaries(out)
        if not (out / RUN).is_file() and any(out.iterdir()):
            raise HyalineError(f"{out}: holds files but no run; choose another --out")
        if anew:
            clear_run(out)
        if (out / RUN).is_file():
            _check_same_run(out, config, dataset)
            if is_finished(out):
                say(f"{out}: finished before, nothing to do; --overwrite trains it anew")
                _end(out)
                return
            if not resume:
                raise HyalineError(
                    f"{out}: holds an unfinished run; go on with --resume, or start anew with --overwrite"
                )
        if not (out / WEIGHTS).is_file():
            train_run(config, dataset, out, label=label, device=device)
        render_predictions(out, config, dataset, device=device)
    _end(out)


def render(
    *,
    run: Path,
    dataset: str | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    overwrite: bool = False,
) -> None:
    """Render both test splits again from a run's weights.

    Args:
        run: Folder of a trained run.
        dataset: Dataset folder, or its name under data/. Default: where the run found it.
        device: Where to compute; auto takes a GPU where there is one.
        overwrite: Render again even where the predictions are intact.
    """
    from datagen.storage import one_writer, remove_temporaries
    from model.predict import render_predictions
    from model.run_folder import is_finished, read_run

    record = read_run(run)
    opened = open_dataset(find_dataset(dataset) if dataset else Path(record.dataset))
    _check_same_run(run, record.config, opened)
    if is_finished(run) and not overwrite:
        say(f"{run}: its predictions are intact, nothing to do; --overwrite renders them again")
    else:
        with one_writer(run):
            remove_temporaries(run)
            render_predictions(run, record.config, opened, device=_device(device))
    _end(run)


def main() -> None:
    wait_without_spinning()
    description = "Train neural renderers on datasets of transparent objects, and render with them."
    run("model", description, {"train": train, "render": render}, sys.argv[1:])


def _check_same_run(out: Path, config: "TrainConfig", dataset: Dataset) -> None:
    from model.methods import METHODS, read_layers_of
    from model.run_folder import check_same_run

    _, layers_seal = read_layers_of(METHODS[config.method], dataset, config.geometry)
    check_same_run(out, config, dataset_seal=dataset.seal, layers_seal=layers_seal)


def _refuse(method: str, flags: dict[str, bool]) -> None:
    """Refuses flags that a method does not have, rather than ignore them."""
    for name, is_given in flags.items():
        if is_given:
            raise HyalineError(f"--{name}: method {method} has no such choice; leave it out")


def _parse_width(width: str) -> int:
    if not width.isdecimal():
        raise HyalineError(f"width: is {width!r}; expected 34k, 256 or another number of hidden units")
    return int(width)


def _device(name: str) -> "torch.device":
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise HyalineError("device: torch finds no CUDA device; use --device cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _end(out: Path) -> None:
    print(out)
    next_command("eval report")
