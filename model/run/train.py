"""Training, in run order: from a dataset to a run folder with weights."""

import contextlib
import math
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from datagen.data.dataset import Dataset
from datagen.disk.errors import DamagedError, HyalineError, NumericsError
from datagen.disk.records import Json, to_json
from datagen.terminal.command import Stopped, hold_signals, say, track
from model.batches.ahead import Ahead, TracedPixels
from model.batches.rays import PixelSource
from model.losses.patch_losses import Inpainter, Losses
from model.methods.protocol import Inputs
from model.methods.renderer import ParameterGroup, Renderer
from model.methods.table import open_inputs
from model.nets.texture import NeuralTextures
from model.run.checkpoint import load_state, save_state
from model.run.held_out import HeldOut, choose_held_out, mean_psnr
from model.run.logs import LogChoices, Logs
from model.run.optimizer import Optimizer, make_optimizer
from model.run.preparation import (
    build_renderer,
    check_losses,
    count_parameters,
    describe_run,
    prepare_processor,
)
from model.run.run_folder import CHECKPOINT, WEIGHTS, TrainConfig, begin_run, check_state_of, data_seals, write_metrics
from model.settings import decay
from model.state import State

CHECKPOINT_EVERY_S = 60.0
"""Longest time between two checkpoints, whatever the number of steps; the result does not depend on it."""


def train(
    config: TrainConfig,
    dataset: Dataset,
    out: Path,
    *,
    label: str,
    device: torch.device,
    flags: Mapping[str, str] = MappingProxyType({}),
    overwrite: bool = False,
    logs: LogChoices = LogChoices(),  # noqa: B008
) -> None:
    """Trains until `out` contains weights.pt; resumes from its checkpoint if there is one.

    SIGINT and SIGTERM end it after the current step, with a checkpoint.

    A run that was stopped and resumed gives the same bytes as one that was not: each step draws its pixels from a
    generator of its own, seeded by (seed, step). That holds for equal numbers of CPU threads.

    Args:
        flags: those that asked for it, to be recorded.
        overwrite: first delete the existing run in `out`.
        logs: logs to write for people to read.

    Raises:
        NumericsError: the loss or a gradient is not finite.
        Stopped: a signal has arrived; the message names the step.
    """
    prepare_processor(config, device)
    inputs = open_inputs(config.net, dataset, config.geometry)
    check_losses(config, dataset.config.resolution)

    renderer = build_renderer(config, inputs, device=device)
    groups = renderer.groups(config)
    sizes = count_parameters(groups)
    begin_run(out, describe_run(config, inputs, label=label, flags=flags, num_parameters=sizes), overwrite=overwrite)

    views = range(dataset.config.train.views)
    held_out = choose_held_out(len(views), config.held_out_views)
    shown = [view for view in views if view not in held_out]
    training = config.net.load(inputs, "train", shown, with_images=True).to(device)
    testing = None
    if held_out:
        testing = HeldOut(pixels=config.net.load(inputs, "train", held_out, with_images=True).to(device))
    losses = make_losses(config, renderer, training, inputs, device=device)

    lazy_in = None if config.loss.inpaint else renderer  # In-painting masks the gradients of whole tables.
    size = config.batch // config.updates
    optimizer = make_optimizer(groups, beta1=config.beta1, kind=config.optimizer, renderer=lazy_in, pixels=size)
    run = Run(
        config=config,
        inputs=inputs,
        out=out,
        renderer=renderer,
        groups=groups,
        optimizer=optimizer,
        losses=losses,
        training=training,
        held_out=testing,
        logs=logs,
    )
    progress = resume(run)
    layers = inputs.num_layers or ("traced" if config.net.uses_geometry else "no")
    say(
        f"{label} on {dataset.root}: {len(shown)} training views and {len(held_out)} held out, "
        f"{layers} layer{'s' * (layers != 1)}, "
        f"{sizes['network']:,} parameters in the network and {sizes['textures']:,} in textures"
    )
    take_steps(run, progress, overwrite=overwrite)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """The objects that every step of a run uses."""

    config: TrainConfig
    inputs: Inputs
    out: Path
    renderer: Renderer
    groups: list[ParameterGroup]
    optimizer: Optimizer
    losses: Losses
    training: PixelSource
    held_out: HeldOut | None
    """None if no views are held out."""
    logs: LogChoices


@dataclass(kw_only=True)
class Progress:
    """The state of a run between steps."""

    step: int = 0
    """Finished steps."""
    loss_sum: float = 0.0
    loss_count: int = 0
    """Sum and number of losses since the last line of metrics."""
    metrics: list[dict[str, Json]] = field(default_factory=list)
    loss: float = math.nan
    psnr: float = math.nan
    """For the terminal: the mean loss since the last line of metrics, and that line's score in dB."""

    def status(self) -> str:
        return f"loss {self.loss:.4f}" + ("" if math.isnan(self.psnr) else f", held out {self.psnr:.2f} dB")


def make_losses(
    config: TrainConfig, renderer: Renderer, training: PixelSource, inputs: Inputs, *, device: torch.device
) -> Losses:
    """The loss terms besides the method's own."""
    return Losses(
        config.loss,
        steps=config.steps,
        seed=config.seed,
        device=device,
        make_inpainter=lambda: Inpainter(
            renderer,
            training,
            inputs.dataset,
            config.geometry,
            num_layers=inputs.num_layers,
            seed=config.seed,
            device=device,
        ),
    )


def resume(run: Run) -> Progress:
    """Loads the checkpoint, if there is one, into the run, and returns its progress."""
    progress, path = Progress(), run.out / CHECKPOINT
    if path.is_file():
        try:
            checkpoint = load_state(path)
        except DamagedError as error:
            raise HyalineError(f"{error}; start over with --overwrite") from error
        if "metrics" not in checkpoint:
            raise HyalineError(f"{path}: is not a checkpoint; start over with --overwrite")
        check_state_of(checkpoint, run.config, run.inputs, path=path)
        run.renderer.load_state_dict(cast(dict[str, Tensor], checkpoint["renderer"]))
        run.optimizer.load_state_dict(cast(dict[str, Tensor], checkpoint["optimizer"]))
        run.losses.load_state(checkpoint.get("losses"))
        progress.step = cast(int, checkpoint["step"])
        progress.loss_sum = cast(float, checkpoint["loss_sum"])
        progress.loss_count = cast(int, checkpoint["loss_count"])
        progress.metrics = cast(list[dict[str, Json]], checkpoint["metrics"])
        say(f"{run.out}: resuming after step {progress.step:,} of {run.config.steps:,}")
    write_metrics(run.out, progress.metrics)  # The file may have lines that are newer than the checkpoint.
    return progress


def take_steps(run: Run, progress: Progress, *, overwrite: bool) -> None:
    """Takes the remaining steps and saves the weights.

    Raises:
        NumericsError: a loss or a gradient is not finite.
        Stopped: a signal has arrived; a checkpoint is saved.
    """
    config = run.config
    first = progress.step
    steps: Iterable[int] = range(first, config.steps)
    run.renderer.train()
    with (
        contextlib.closing(Logs(run.out, run.logs, first_step=first)) as logs,
        hold_signals() as held,
        batches_ahead(run) as ahead,
    ):
        saved_at = time.monotonic()
        for step in track(steps, label="train", total=config.steps, done=first, status=progress.status):
            take_step(run, progress, step, ahead)
            number = held.number
            logs.add_loss(progress.step, progress.loss)
            if progress.step % config.evaluate_every == 0 or progress.step == config.steps:
                add_metrics(run, progress, logs)
            if progress.step == config.steps:
                continue
            is_due = progress.step % config.checkpoint_every == 0 or time.monotonic() - saved_at >= CHECKPOINT_EVERY_S
            if is_due or number is not None:
                save_progress(run, progress)
                saved_at = time.monotonic()
            if number is not None:
                again = "the same command without --overwrite" if overwrite else "the same command"
                raise Stopped(
                    number,
                    f"{run.out}: stopped after step {progress.step:,} of {config.steps:,}; {again} resumes it",
                )
    run.optimizer.catch_up()
    batch, updates = config.batch // config.updates, config.steps * config.updates
    run.renderer.finish(run.training, batch=batch, updates=updates, rng=generator(config, config.steps))
    save_weights(run)


def generator(config: TrainConfig, step: int, update: int = 0) -> np.random.Generator:
    """The random generator of an update."""
    return np.random.default_rng([config.seed, step, update])


@contextlib.contextmanager
def batches_ahead(run: Run) -> Iterator[Ahead | None]:
    """Has the rays of coming steps traced by a second thread; None where rays are not traced, or the losses draw more
    than random pixels."""
    if not isinstance(run.training, TracedPixels) or not run.losses.draws_pixels_alone:
        yield None
        return
    config = run.config

    def draw(step: int) -> list[np.random.Generator]:
        return [generator(config, step, update) for update in range(config.updates)]

    ahead = Ahead(run.training, draw, size=config.batch // config.updates)
    with contextlib.closing(ahead):
        yield ahead


def take_step(run: Run, progress: Progress, step: int, ahead: Ahead | None) -> None:
    """One step, with `config.updates` updates."""
    config, renderer, training = run.config, run.renderer, run.training
    batch = config.batch // config.updates
    if ahead is not None:
        assert isinstance(training, TracedPixels)
        ahead.begin(step, is_last=step + 1 == config.steps)
        training = training.taken_from(ahead)
    for update in range(config.updates):
        rng = generator(config, step, update)
        loss = run.losses.loss(renderer.loss, renderer, training, batch, rng, step=step)
        run.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        loss_value = read_finite(loss.detach(), renderer, step=step, out=run.out)
        done = (step + update / config.updates) / config.steps
        for learning, group in zip(run.optimizer.param_groups, run.groups, strict=True):
            learning["lr"] = run.losses.limit_rate(group.lr * decay(config.lr_decay, done), step)
        run.optimizer.step()
        progress.loss_sum += loss_value
        progress.loss_count += 1
    progress.step = step + 1
    progress.loss = progress.loss_sum / progress.loss_count


def add_metrics(run: Run, progress: Progress, logs: Logs) -> None:
    """Scores the held-out views, writes a line of metrics, and resets the mean loss."""
    score = None
    if run.held_out is not None:
        truth, predicted = run.held_out.truth, run.held_out.draw(run.renderer)
        score = mean_psnr(predicted, truth)
        logs.add_evaluation(progress.step, score, truth, predicted)
    progress.psnr = math.nan if score is None else score
    progress.metrics.append({"step": progress.step, "loss": progress.loss, "held_out_psnr": score})
    write_metrics(run.out, progress.metrics)
    progress.loss_sum, progress.loss_count = 0.0, 0


def save_progress(run: Run, progress: Progress) -> None:
    """Saves a checkpoint for `resume`."""
    state: dict[str, State] = {
        "config": cast(State, to_json(run.config)),
        **data_seals(run.inputs),
        "step": progress.step,
        "renderer": cast(State, dict(run.renderer.state_dict())),
        "optimizer": cast(State, run.optimizer.state_dict()),
        "loss_sum": progress.loss_sum,
        "loss_count": progress.loss_count,
        "losses": run.losses.state(),
        "metrics": cast(State, progress.metrics),
    }
    save_state(run.out / CHECKPOINT, state)


def save_weights(run: Run) -> None:
    """Saves the result and deletes the checkpoint."""
    weights: dict[str, State] = {
        "config": cast(State, to_json(run.config)),
        **data_seals(run.inputs),
        "step": run.config.steps,
        "renderer": cast(State, dict(run.renderer.state_dict())),
    }
    save_state(run.out / WEIGHTS, weights)
    (run.out / CHECKPOINT).unlink(missing_ok=True)


def read_finite(loss: Tensor, renderer: nn.Module, *, step: int, out: Path) -> float:
    """The loss; stops a run if it or a gradient is not finite, before the optimiser sees them: Adam would keep them for
    ever.

    A sum is not finite if one of its terms is not; it takes 1 ms, `isfinite` 17 ms. The same holds for a norm, which
    takes 4 ms, but a GPU computes those of all gradients in one launch. It is waited for once.
    """
    learned = [value for value in renderer.parameters() if value.grad is not None]
    gradients = [cast(Tensor, value.grad) for value in learned]
    norms = torch._foreach_norm  # pyright: ignore[reportPrivateImportUsage]
    sums = norms(gradients, 1) if loss.is_cuda else [gradient.sum() for gradient in gradients]
    value, *totals = torch.stack([loss, *sums]).tolist()
    bad = [each for each, total in zip(learned, totals, strict=True) if not math.isfinite(total)]
    bad += [
        part.table
        for part in renderer.modules()
        if isinstance(part, NeuralTextures) and part.lazy is not None and not part.lazy.is_finite()
    ]
    if not math.isfinite(value) or bad:
        names = [name for name, each in renderer.named_parameters() if any(each is other for other in bad)]
        what = f"the loss is {value}" if not math.isfinite(value) else f"the gradient of {names[0]} is not finite"
        raise NumericsError(
            f"{out}: {what} at step {step}, so training stopped; the checkpoint is kept, "
            f"start over with --overwrite and a lower --lr"
        )
    return value
