"""Training, in run order: from a dataset to a run folder with weights."""

import contextlib
import itertools
import math
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import cast

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor, nn

from datagen.data.config import Resolution
from datagen.data.dataset import Dataset
from datagen.data.variants import evenly
from datagen.disk.errors import DamagedError, HyalineError, NumericsError
from datagen.disk.records import Json, to_json
from datagen.terminal.command import Stopped, hold_signals, say, track
from model.batches.rays import PixelSource, TracedPixels, made_ahead
from model.methods.patch_losses import Losses
from model.methods.protocol import Inputs, open_inputs
from model.methods.renderer import ParameterGroup, Renderer
from model.nets.texture import NeuralTextures
from model.run.logs import Pictures, write_metrics, write_snapshot
from model.run.optimizer import Optimizer, make_optimizer
from model.run.predict import predict_pixels
from model.run.run_folder import (
    CHECKPOINT,
    WEIGHTS,
    TrainConfig,
    begin_run,
    check_state_of,
    data_seals,
    describe_run,
)
from model.runtime import keep_freed_memory, sum_in_order_on_gpus, use_few_threads
from model.settings import LEAST_PATCH, PixelOptimisation, decay
from model.state import State, load_state, save_state

CHECKPOINT_EVERY_S = 60.0
"""Longest time between two checkpoints, whatever the number of steps; the result does not depend on it."""
STRIDE = 2
"""Every second pixel of every second row is scored: a quarter of the time, hundredths of a decibel."""


def train(
    config: TrainConfig,
    dataset: Dataset,
    out: Path,
    *,
    label: str,
    device: torch.device,
    flags: Mapping[str, str] = MappingProxyType({}),
    overwrite: bool = False,
) -> None:
    """Trains until `out` contains weights.pt; resumes from its checkpoint if there is one.

    SIGINT and SIGTERM end it after the current step, with a checkpoint.

    Resumed runs give the same bytes, on as many CPU threads: each step has a generator seeded by (seed, step).

    Args:
        flags: those that asked for it, to be recorded.
        overwrite: first delete the existing run in `out`.

    Raises:
        NumericsError: the loss or a gradient is not finite.
        Stopped: a signal has arrived; the message names the step.
    """
    keep_freed_memory()
    if device.type == "cuda":
        sum_in_order_on_gpus()
    size = config.batch // config.updates
    if isinstance(config.net.optimisation(), PixelOptimisation):
        use_few_threads(size)
    inputs = open_inputs(config.net, dataset, config.geometry)
    check_losses(config, dataset.config.resolution)

    renderer = build_renderer(config, inputs, device=device)
    groups = renderer.groups(config)
    sizes = {"network": 0, "textures": 0, "helper": 0}
    for group in groups:
        sizes[group.counts_as] += sum(value.numel() for value in group.parameters)
    begin_run(out, describe_run(config, inputs, label=label, flags=flags, num_parameters=sizes), overwrite=overwrite)

    views = range(dataset.config.train.views)
    held_out = choose_held_out(len(views), config.held_out_views)
    shown = [view for view in views if view not in held_out]
    training = config.net.load(inputs, "train", shown, with_images=True).to(device)
    scored = {}
    if held_out:
        testing = config.net.load(inputs, "train", held_out, with_images=True).to(device)
        scored["train_psnr"] = ScoredViews(pixels=training, places=evenly(len(held_out), len(shown)))
        scored["held_out_psnr"] = ScoredViews(pixels=testing, places=range(len(held_out)))
    run = Run(
        config=config,
        inputs=inputs,
        out=out,
        renderer=renderer,
        groups=groups,
        optimizer=make_optimizer(groups, beta1=config.beta1, kind=config.optimizer, renderer=renderer, pixels=size),
        losses=Losses(config.loss, steps=config.steps, seed=config.seed, device=device),
        training=training,
        scored=scored,
    )
    resume(run)
    layers = inputs.num_layers or ("traced" if config.net.uses_geometry else "no")
    say(
        f"{label} on {dataset.root}: {len(shown)} training views and {len(held_out)} held out, "
        f"{layers} layer{'s' * (layers != 1)}, "
        f"{sizes['network']:,} parameters in the network and {sizes['textures']:,} in textures"
    )
    take_steps(run, overwrite=overwrite)


def choose_held_out(num_views: int, at_most: int) -> list[int]:
    """The training views that are held out to measure progress: evenly spread, and at most a fifth of all."""
    return evenly(min(at_most, num_views // 5), num_views)


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoredViews:
    """Views that measure progress, by a quarter of their pixels."""

    pixels: PixelSource
    places: Sequence[int]
    """Which views of `pixels` they are."""

    @property
    def whole(self) -> Int[np.ndarray, "view h w"]:
        """Row numbers of the views' pixels."""
        return np.arange(len(self.pixels.rgb)).reshape(-1, *self.pixels.resolution.shape)[[*self.places]]

    @property
    def rows(self) -> Int[np.ndarray, "view h w"]:
        """Row numbers of the scored pixels."""
        return self.whole[:, ::STRIDE, ::STRIDE]

    @property
    def truth(self) -> Pictures:
        """The true colours of the scored pixels."""
        return self.pixels.rgb.cpu().numpy()[self.rows]

    def draw(self, renderer: Renderer) -> Pictures:
        """The predicted colours of the scored pixels."""
        asked = self.whole if self.pixels.whole_views else self.rows
        drawn = predict_pixels(renderer, self.pixels, torch.from_numpy(asked.flatten())).reshape(*asked.shape, 3)
        return drawn[:, ::STRIDE, ::STRIDE] if self.pixels.whole_views else drawn


def mean_psnr(predicted: Pictures, truth: Pictures) -> float:
    """The mean over views of the PSNR in dB of 8-bit pictures."""
    error = (predicted.astype(np.float64) - truth) / 255
    mse = np.square(error).reshape(len(truth), -1).mean(axis=1)
    return float(np.mean(-10 * np.log10(np.maximum(mse, 1e-12))))


@dataclass(kw_only=True, eq=False)
class Run:
    """What every step of a run uses, and its state between steps."""

    config: TrainConfig
    inputs: Inputs
    out: Path
    renderer: Renderer
    groups: list[ParameterGroup]
    optimizer: Optimizer
    losses: Losses
    training: PixelSource
    scored: Mapping[str, ScoredViews]
    """By the name in metrics: views that are held out, and as many that are not; none if none are held out."""
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


def check_losses(config: TrainConfig, resolution: Resolution) -> None:
    """Raises a HyalineError if the method cannot be trained with the losses that were asked for."""
    crop = getattr(config.net, "crop", None)  # Of U-Nets; 0: whole pictures.
    side = min(config.loss.patch if crop is None else crop or resolution.shorter, resolution.shorter)
    if config.loss.adversarial and side < LEAST_PATCH:
        raise HyalineError(
            f"adversarial: patches are {side} pixels wide; the discriminator needs at least {LEAST_PATCH}, so use "
            "larger crops or pictures"
        )
    if config.loss.inpaint or config.loss.vgg != "vgg16":
        raise HyalineError("loss: is one of an earlier version, with in-painting or VGG19; train without them")


def build_renderer(config: TrainConfig, inputs: Inputs, *, device: torch.device) -> Renderer:
    """The network and textures before any step; their values depend only on the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        renderer = config.net.build(inputs)
    return renderer.to(device)


def resume(run: Run) -> None:
    """Loads the checkpoint, if there is one, into the run."""
    path = run.out / CHECKPOINT
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
        run.step = cast(int, checkpoint["step"])
        run.loss_sum = cast(float, checkpoint["loss_sum"])
        run.loss_count = cast(int, checkpoint["loss_count"])
        run.metrics = cast(list[dict[str, Json]], checkpoint["metrics"])
        say(f"{run.out}: resuming after step {run.step:,} of {run.config.steps:,}")
    write_metrics(run.out, run.metrics)  # The file may have lines that are newer than the checkpoint.


def take_steps(run: Run, *, overwrite: bool) -> None:
    """Takes the remaining steps and saves the weights.

    Raises:
        NumericsError: a loss or a gradient is not finite.
        Stopped: a signal has arrived; a checkpoint is saved.
    """
    config = run.config
    steps = range(run.step, config.steps)
    run.renderer.train()
    with hold_signals() as held, contextlib.closing(pixels_of_steps(run, steps)) as sources:
        saved_at = time.monotonic()
        shown = track(steps, label="train", total=config.steps, done=run.step, status=run.status)
        for step, training in zip(shown, sources, strict=False):
            take_step(run, step, training)
            number = held.number
            if run.step % config.evaluate_every == 0 or run.step == config.steps:
                add_metrics(run)
            if run.step == config.steps:
                continue
            is_due = run.step % config.checkpoint_every == 0 or time.monotonic() - saved_at >= CHECKPOINT_EVERY_S
            if is_due or number is not None:
                save_progress(run)
                saved_at = time.monotonic()
            if number is not None:
                again = "the same command without --overwrite" if overwrite else "the same command"
                raise Stopped(
                    number, f"{run.out}: stopped after step {run.step:,} of {config.steps:,}; {again} resumes it"
                )
    run.optimizer.catch_up()
    batch, updates = config.batch // config.updates, config.steps * config.updates
    run.renderer.finish(run.training, batch=batch, updates=updates, rng=generator(config, config.steps))
    save_state(run.out / WEIGHTS, _state_of(run))
    (run.out / CHECKPOINT).unlink(missing_ok=True)


def generator(config: TrainConfig, step: int, update: int = 0) -> np.random.Generator:
    """The random generator of an update."""
    return np.random.default_rng([config.seed, step, update])


def pixels_of_steps(run: Run, steps: range) -> Generator[PixelSource, None, None]:
    """What each step draws from; where rays are traced, and a step draws random pixels alone, they are made ahead."""
    config, training = run.config, run.training

    def draw(step: int) -> list[np.random.Generator]:
        return [generator(config, step, update) for update in range(config.updates)]

    if isinstance(training, TracedPixels) and run.losses.draws_pixels_alone:
        yield from made_ahead(training, draw, steps, size=config.batch // config.updates)
    else:
        yield from itertools.repeat(training)


def take_step(run: Run, step: int, training: PixelSource) -> None:
    """One step, with `config.updates` updates."""
    config, renderer = run.config, run.renderer
    batch = config.batch // config.updates
    terms = run.losses.patch_terms(step, training.resolution.shorter)
    for update in range(config.updates):
        rng = generator(config, step, update)
        loss = renderer.loss(training, batch, rng, softness=config.loss.softness, patch_terms=terms)
        run.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        loss_value = read_finite(loss.detach(), renderer, step=step, out=run.out)
        done = (step + update / config.updates) / config.steps
        for learning, group in zip(run.optimizer.param_groups, run.groups, strict=True):
            learning["lr"] = run.losses.limit_rate(group.lr * decay(config.lr_decay, done), step)
        run.optimizer.step()
        run.loss_sum += loss_value
        run.loss_count += 1
    run.step = step + 1
    run.loss = run.loss_sum / run.loss_count


def add_metrics(run: Run) -> None:
    """Scores views, draws the held-out ones, writes a line of metrics, and resets the mean loss."""
    scores: dict[str, Json] = {"held_out_psnr": None}
    for name, views in run.scored.items():
        truth, predicted = views.truth, views.draw(run.renderer)
        scores[name] = run.psnr = mean_psnr(predicted, truth)  # The held-out ones come last.
        if name == "held_out_psnr":
            write_snapshot(run.out, run.step, truth, predicted)
    run.metrics.append({"step": run.step, "loss": run.loss, **scores})
    write_metrics(run.out, run.metrics)
    run.loss_sum, run.loss_count = 0.0, 0


def save_progress(run: Run) -> None:
    """Saves a checkpoint for `resume`."""
    state = {
        "optimizer": cast(State, run.optimizer.state_dict()),
        "loss_sum": run.loss_sum,
        "loss_count": run.loss_count,
        "losses": run.losses.state(),
        "metrics": cast(State, run.metrics),
    }
    save_state(run.out / CHECKPOINT, _state_of(run) | state)


def _state_of(run: Run) -> dict[str, State]:
    """What weights hold, and checkpoints as well."""
    return {
        "config": cast(State, to_json(run.config)),
        **data_seals(run.inputs),
        "step": run.step,
        "renderer": cast(State, dict(run.renderer.state_dict())),
    }


def read_finite(loss: Tensor, renderer: nn.Module, *, step: int, out: Path) -> float:
    """The loss; stops a run if it or a gradient is not finite, before the optimiser sees them: Adam would keep them.

    A sum is not finite if one of its terms is not; it takes 1 ms, `isfinite` 17 ms. So is a norm: on a GPU, one launch.
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
