"""Owns the command `model`: parse, make a configuration, call one function."""

import dataclasses
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from datagen.data.advice import report_command
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.finding import find_dataset
from datagen.data.geometries import check_geometry
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.terminal.command import choose, fail, mute, next_command, run, say, tell, unwrap_help
from model.settings.choices import (
    CHOICES,
    CommonChoices,
    DeepVoxelsChoices,
    LossChoices,
    MethodChoices,
    folder_name,
    named_method,
    refuse_foreign_flags,
)
from model.settings.runtime import wait_briefly

if TYPE_CHECKING:
    import torch

    from model.batches.pixel_cache import Memory
    from model.run.run_folder import TrainConfig

DEFAULT_HELP = "paper"
"""Whose choices `model train --help` shows as long as no method is named."""


def trainer_of(method: str) -> Callable[..., None]:
    """The command `train` with the flags of one method."""

    def train(common: CommonChoices, choices: MethodChoices) -> None:
        """Train a renderer on a dataset, then render both test splits with it.

        `torchrun --nproc-per-node N -m model train ...` trains on N GPUs (or CPU processes), and ends where one process
        would but for rounding: paper, mlp-first and light-path, with losses of pixels alone.
        """
        if int(os.environ.get("RANK", "0")) > 0:
            mute()
        config, opened = configure(common, choices)
        out = common.out or Path("runs") / opened.name / folder_name(common, choices)
        label = common.name or out.name
        _train(config, opened, out, label=label, device=_device(common.device), anew=common.overwrite,
               memory=common.memory)  # fmt: skip

    # tyro makes a flag of each field of these records.
    for record in (CommonChoices, LossChoices, CHOICES[method]):
        unwrap_help(record)
    train.__annotations__["choices"] = CHOICES[method]
    return train


def configure(common: CommonChoices, choices: MethodChoices) -> "tuple[TrainConfig, Dataset]":
    """The configuration that choices make on their dataset, which is opened.

    Raises:
        HyalineError: a choice that cannot be, no such method, dataset or geometry.
    """
    choose("method", common.method, CHOICES)
    opened = open_dataset(find_dataset(common.dataset))
    if opened.parent is not None:
        raise HyalineError(f"{opened.root}: is a variant, without training views; train on {opened.parent.root}")

    if "torch" not in sys.modules:
        say(f"{opened.root}: loads torch")  # Seconds, in which nothing else is heard.
    from model.losses.pixel_losses import LossConfig, configure_losses
    from model.methods.table import METHODS, read_layers_of
    from model.run.run_folder import TrainConfig

    method = METHODS[common.method]
    if not method.uses_geometry and common.geometry != TRUTH:
        raise HyalineError(f"--geometry {common.geometry}: method {common.method} uses no geometry; leave it out")
    check_geometry(opened, common.geometry)
    num_layers, _ = read_layers_of(method, opened, common.geometry)
    defaults = method.optimise(choices, method.optimisation)
    losses = LossConfig() if isinstance(choices, DeepVoxelsChoices) else configure_losses(choices.loss)
    config = TrainConfig(
        method=common.method,
        geometry=common.geometry,
        net=method.configure(choices, opened, common.geometry, num_layers),
        seed=common.seed,
        steps=defaults.steps if common.steps is None else common.steps,
        batch=defaults.batch if common.batch is None else common.batch,
        updates=defaults.updates if common.updates is None else common.updates,
        lr=defaults.lr if common.lr is None else common.lr,
        texture_lr=defaults.texture_lr if common.texture_lr is None else common.texture_lr,
        sky_lr=defaults.sky_lr,
        lr_decay=common.lr_decay or defaults.lr_decay,
        beta1=defaults.beta1,
        weight_decay=defaults.weight_decay,
        loss=dataclasses.replace(losses, softness=defaults.softness, debias=defaults.debias),
    )
    return config, opened


def _train(
    config: "TrainConfig",
    dataset: Dataset,
    out: Path,
    *,
    label: str,
    device: "torch.device",
    anew: bool,
    memory: "Memory",
) -> None:
    from datagen.disk.ownership import holding, is_ours, refuse_others
    from model.batches.distributed import join, own_device
    from model.run.checkpoint import delete_checkpoints, has_checkpoint
    from model.run.predict import is_all_drawn, render_predictions
    from model.run.run_folder import FOLDER, WEIGHTS, finish_clearing
    from model.run.train import check_team
    from model.run.train import train as train_run

    device = own_device(device)
    with join(device) as team:
        check_team(config, team)
        train = functools.partial(
            train_run, config, dataset, out, label=label, device=device, team=team, memory=memory, anew=anew
        )
        if not team.is_first:
            # The first process holds the folder, and tells whether there is anything to train.
            if team.agree():
                train()
            return
        with holding(out, FOLDER):
            refuse_others(out, FOLDER)
            finish_clearing(out)
            if is_ours(out, FOLDER) and not anew:
                _check_same_run(out, config, dataset)
                if is_all_drawn(out, dataset):
                    say(f"{out}: finished before, nothing to do; --overwrite trains it anew")
                    team.agree(False)
                    _end(out, run=out)
                    return
                if not (out / WEIGHTS).is_file() and not has_checkpoint(out):
                    say(f"{out}: was stopped before its first checkpoint; starts at step 0")
            if team.agree(anew or not (out / WEIGHTS).is_file()):
                train()
            else:
                delete_checkpoints(out)
                say(f"{out}: is trained; goes on with its predictions")
            render_predictions(out, config, dataset, device=device)
    _end(out, run=out)


def render(
    *,
    run: Path,
    dataset: str | None = None,
    variant: str | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    overwrite: bool = False,
) -> None:
    """Render all test splits again from a run's weights.

    Args:
        run: Folder of a trained run.
        dataset: Dataset folder, or its name under data/. Default: where the run found it.
        variant: Render a variant of the dataset instead, into the run's variants/NAME: x2 for what `datagen build
            --super-resolution 2` has made, or what `--edit` was given, such as remove:glass_ball.
        device: Where to compute; auto takes a GPU where there is one.
        overwrite: Render again even where the predictions are intact.
    """
    from datagen.data.variants import open_variant, variant_root
    from datagen.disk.ownership import holding
    from datagen.scene.edits import edits_name, parse_edit
    from model.run.predict import (
        check_can_draw,
        check_draws_edits,
        is_all_drawn,
        is_drawn,
        render_predictions,
        render_variant,
    )
    from model.run.run_folder import FOLDER, read_run

    record = read_run(run)
    opened = open_dataset(find_dataset(dataset) if dataset else Path(record.dataset))
    _check_same_run(run, record.config, opened)
    config, out = record.config, run
    if variant is None:
        is_done, draw = is_all_drawn(run, opened), functools.partial(render_predictions, run, config, opened)
    else:
        name = variant
        if ":" in variant:  # As one types an edit; what cannot be drawn need not be built.
            name = edits_name(tuple(map(parse_edit, variant.split("+"))))
            check_draws_edits(config)
        chosen, out = open_variant(opened, name), variant_root(run, name)
        check_can_draw(config, opened, chosen)
        is_done, draw = is_drawn(run, chosen), functools.partial(render_variant, run, config, opened, chosen)
    if is_done and not overwrite:
        say(f"{out}: its predictions are intact, nothing to do; --overwrite renders them again")
    else:
        with holding(run, FOLDER):
            draw(device=_device(device))
    _end(out, run=run)


def sweep(
    experiment: str, /, *, dataset: tuple[str, ...] = (), seed: tuple[int, ...] = (), jobs: int = 1,
    dry_run: bool = False,
) -> None:  # fmt: skip
    """Train all runs of an experiment file, one process a GPU (one on a CPU); what is finished is skipped.

    Args:
        experiment: A TOML file (format: model/run/experiment.py), or one of table1, table2, square, zero-layer, claims,
            headline, proxies, ablation, variants and budget.
        dataset: Datasets to train on, instead of the file's.
        seed: Seeds to train with, instead of the file's.
        jobs: Processes side by side on the CPU, which share its cores out evenly, or on each GPU. On a CPU more runs
            are finished in an hour by as many as memory allows (4 GB each); a run's numbers differ by rounding.
        dry_run: Print the command of each run, and do nothing.
    """
    from model.run.experiment import read_experiment
    from model.run.sweep import command_line, find_devices, raise_failures, run_experiment

    asked = read_experiment(experiment, datasets=dataset, seeds=seed)
    if dry_run:
        for arguments in asked.runs:
            tell(command_line(arguments))
        return
    raise_failures(asked, run_experiment(asked, devices=find_devices(jobs)))
    next_command("eval report")


def main() -> None:
    wait_briefly()
    description = "Train neural renderers on datasets of transparent objects, and render with them."
    arguments = sys.argv[1:]
    try:
        method = choose("method", named_method(arguments) or DEFAULT_HELP, CHOICES)
        if arguments[:1] == ["train"]:
            refuse_foreign_flags(method, arguments)
    except HyalineError as error:
        fail(str(error))
    run("model", description, {"train": trainer_of(method), "render": render, "sweep": sweep}, arguments)


def _check_same_run(out: Path, config: "TrainConfig", dataset: Dataset) -> None:
    from model.methods.table import METHODS, read_layers_of
    from model.run.run_folder import check_same_run

    _, layers_seal = read_layers_of(METHODS[config.method], dataset, config.geometry)
    check_same_run(out, config, dataset_seal=dataset.seal, layers_seal=layers_seal)


def _device(name: str) -> "torch.device":
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise HyalineError("device: torch finds no CUDA device; use --device cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _end(out: Path, *, run: Path) -> None:
    tell(str(out))
    next_command(report_command(run))
