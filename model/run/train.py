"""Training: straight-line code from a dataset to a run folder with weights."""

import math
import signal
import time
from collections.abc import Iterable
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from datagen.data.dataset import Dataset
from datagen.data.geometries import NO_GEOMETRY
from datagen.disk.errors import HyalineError, NumericsError
from datagen.disk.records import Json, to_json
from datagen.terminal.command import say, track
from datagen.terminal.signals import Stopped, hold_signals
from model.batches.distributed import ALONE, Team
from model.batches.pixel_cache import choose_memory
from model.batches.rays import PixelSource
from model.losses.inpaint import Inpainter
from model.losses.patch_losses import Losses
from model.methods.renderer import Renderer
from model.methods.table import open_inputs
from model.run.checkpoint import check_numbers, delete_checkpoints, load_checkpoint, save_checkpoint, save_state
from model.run.predict import predict_pixels
from model.run.run_folder import (
    CHECKPOINT,
    RUN_VERSION,
    WEIGHTS,
    RunRecord,
    TrainConfig,
    begin_run,
    describe_knowledge,
    is_config,
    write_metrics,
)
from model.settings.optimisation import LrDecay
from model.settings.run_flags import Memory
from model.settings.runtime import keep_freed_memory
from model.settings.state import State

CHECKPOINT_EVERY_S = 60.0
"""At least so often a checkpoint is left, whatever the number of steps; no byte of the result depends on it."""


def train(
    config: TrainConfig,
    dataset: Dataset,
    out: Path,
    *,
    label: str,
    device: torch.device,
    team: Team = ALONE,
    memory: Memory = "ram",
    anew: bool = False,
) -> None:
    """Trains until `out` holds weights.pt; goes on from the newest intact checkpoint where there is one.

    SIGINT and SIGTERM end it after the step at hand, with a checkpoint.

    A run that was stopped and resumed gives the same bytes as one that was not: each step draws its pixels from a
    generator of its own, seeded by (seed, step). That holds for equal numbers of CPU threads.

    Args:
        team: the processes that call this together; the first of them alone writes to `out`.
        memory: where training pixels are held; no number depends on it.
        anew: deletes the run that stands there.

    Raises:
        HyalineError: data is missing or damaged, the loss cannot be shared by a team, or in-painting cannot tell which
            texels training visits.
        NumericsError: the loss, a gradient or a weight is not finite.
        Stopped: a signal has arrived; the message says after which step.
    """
    keep_freed_memory()
    check_team(config, team)
    method = config.net
    inputs = open_inputs(method, dataset, config.geometry)
    if config.loss.inpaint and method.traces_layers:
        raise HyalineError(
            "inpaint: counts which texels the stored layers' rays visit; expected paper with one ray "
            "per pixel, or another method that reads straight layers"
        )

    # The renderer.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        renderer = method.build(inputs)
    team.share_norms(renderer)
    renderer.to(device)
    groups = renderer.groups(config)
    num_parameters = {
        kind: sum(count(group.parameters) for group in groups if group.counts_as == kind)
        for kind in ("network", "textures")
    }
    # Dense Adam, as in the paper: a texel moves on by its momentum after the step that touched it.
    optimizer = torch.optim.Adam(
        [{"params": group.parameters, "lr": group.lr, "weight_decay": group.weight_decay} for group in groups],
        betas=(config.beta1, 0.999),
        fused=True,
    )

    record = RunRecord(
        version=RUN_VERSION,
        method=config.method,
        geometry=config.geometry if method.uses_geometry else NO_GEOMETRY,
        knowledge=describe_knowledge(dataset, config.geometry, method.knowledge, config.loss.describe())
        if method.uses_geometry
        else method.knowledge,
        dataset=dataset.root.as_posix(),
        dataset_seal=dataset.seal,
        layers_seal=inputs.layers_seal,
        seed=config.seed,
        num_parameters=num_parameters["network"],
        num_texture_parameters=num_parameters["textures"],
        num_layers=inputs.num_layers or None,
        label=label,
        config=config,
        torch=torch.__version__,
    )
    with team.in_turn():
        if team.is_first:
            begin_run(out, record, anew=anew)

    # The data.
    views = range(dataset.config.train.views)
    held_out = choose_held_out(len(views), config.held_out_views)
    shown = [view for view in views if view not in held_out]
    is_mapped = choose_memory(
        memory,
        num_pixels=len(shown) * dataset.config.resolution**2,
        num_layers=0 if method.traces_layers else inputs.num_layers,
        processes=team.size_here,
        device=device,
    )
    if is_mapped:
        with team.in_turn():
            training = method.load(inputs, "train", shown, with_images=True, mapped=True).to(device)
    else:
        training = method.load(inputs, "train", shown, with_images=True).to(device)
    testing = None
    if held_out and team.is_first:
        testing = method.load(inputs, "train", held_out, with_images=True).to(device)

    # The losses, the terms beside the method's own included.
    losses = Losses(
        config.loss,
        steps=config.steps,
        seed=config.seed,
        device=device,
        make_inpainter=lambda: Inpainter(
            renderer, training, dataset, config.geometry, num_layers=inputs.num_layers, seed=config.seed, device=device
        ),
    )

    # Where to go on.
    first_step, loss_sum, loss_count = 0, 0.0, 0
    metrics: list[dict[str, Json]] = []
    with team.in_turn():
        checkpoint = load_checkpoint(out)
    if checkpoint is not None:
        if "metrics" not in checkpoint or not is_config(checkpoint["config"], config):
            raise HyalineError(f"{out / CHECKPOINT}: made by another configuration; start anew with --overwrite")
        renderer.load_state_dict(cast(dict[str, Tensor], checkpoint["renderer"]))
        optimizer.load_state_dict(cast(dict[str, Tensor], checkpoint["optimizer"]))
        losses.load_state(checkpoint.get("losses"))
        first_step = cast(int, checkpoint["step"])
        loss_sum, loss_count = cast(float, checkpoint["loss_sum"]), cast(int, checkpoint["loss_count"])
        metrics = cast(list[dict[str, Json]], checkpoint["metrics"])
        say(f"{out}: goes on from step {first_step:,} of {config.steps:,}")
    if team.is_first:
        # There may be more of them than the checkpoint knows.
        write_metrics(out, metrics)
    say(
        f"{label} on {dataset.root}: {len(shown)} training views and {len(held_out)} held out, "
        f"{inputs.num_layers or ('traced' if method.uses_geometry else 'no')} layers, "
        f"{num_parameters['network']:,} parameters in the network and {num_parameters['textures']:,} in textures"
    )

    # The loop.
    shown_loss, shown_psnr = math.nan, math.nan
    steps: Iterable[int] = range(first_step, config.steps)
    batch = config.batch // config.updates

    def status() -> str:
        return f"loss {shown_loss:.4f}" + ("" if math.isnan(shown_psnr) else f", held out {shown_psnr:.2f} dB")

    def save_progress(done: int) -> None:
        state: dict[str, State] = {
            "config": cast(State, to_json(config)),
            "step": done,
            "renderer": cast(State, dict(renderer.state_dict())),
            "optimizer": cast(State, optimizer.state_dict()),
            "loss_sum": loss_sum,
            "loss_count": loss_count,
            "losses": losses.state(),
            "metrics": cast(State, metrics),
        }
        save_checkpoint(out, state)

    renderer.train()
    with hold_signals() as held:
        saved_at = time.monotonic()
        for step in track(steps, label="train", total=config.steps, done=first_step, status=status):
            is_stopped = False
            for update in range(config.updates):
                rng = team.generator([config.seed, step, update] if update else [config.seed, step], batch)
                own = len(team.share(batch))
                loss = team.weigh(losses.loss(renderer.loss, renderer, training, own, rng, step=step), batch)
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                team.sum_gradients(renderer)
                loss_value, is_asked = team.sum_loss(loss, is_stopped=held.number is not None)
                is_stopped = is_stopped or is_asked
                check_finite(loss_value, renderer, step=step, out=out)
                progress = (step + update / config.updates) / config.steps
                for learning, group in zip(optimizer.param_groups, groups, strict=True):
                    learning["lr"] = losses.limit_rate(group.lr * decay(config.lr_decay, progress), step)
                optimizer.step()
                loss_sum, loss_count = loss_sum + loss_value, loss_count + 1

            done, shown_loss = step + 1, loss_sum / loss_count
            if team.is_first and (done % config.evaluate_every == 0 or done == config.steps):
                score = held_out_psnr(renderer, testing) if testing is not None else None
                shown_psnr = math.nan if score is None else score
                metrics.append({"step": done, "loss": shown_loss, "held_out_psnr": score})
                write_metrics(out, metrics)
                loss_sum, loss_count = 0.0, 0
            if done == config.steps:
                continue
            is_due = done % config.checkpoint_every == 0 or time.monotonic() - saved_at >= CHECKPOINT_EVERY_S
            if team.is_first and (is_due or is_stopped):
                save_progress(done)
                saved_at = time.monotonic()
            if is_stopped:
                team.agree()  # `torchrun` ends all as soon as one has ended, so the first has to have saved.
                way_on = "the same command without --overwrite" if anew else "the same command"
                raise Stopped(
                    held.number or signal.SIGTERM,
                    f"{out}: stopped after step {done:,} of {config.steps:,}; {way_on} goes on from there",
                )

        if team.is_first:
            weights: dict[str, State] = {
                "config": cast(State, to_json(config)),
                "step": config.steps,
                "renderer": cast(State, dict(renderer.state_dict())),
            }
            check_numbers(weights, where=str(out / WEIGHTS))
            save_state(out / WEIGHTS, weights)
            delete_checkpoints(out)


def check_team(config: TrainConfig, team: Team) -> None:
    """Raises a HyalineError where a step cannot be shared so that it stays what one process would do."""
    if team.size == 1:
        return
    if not config.net.is_shareable or not config.loss.is_of_pixels:
        raise HyalineError(
            f"{config.method}: its steps look at whole patches, pictures or dropout, which several processes cannot "
            "share; train it without torchrun (paper, mlp-first and light-path can be, with losses of pixels alone)"
        )
    if config.batch // config.updates < team.size:
        raise HyalineError(
            f"batch: is {config.batch}; expected at least a pixel for each of {team.size} processes in "
            f"each of {config.updates} updates"
        )


def choose_held_out(num_views: int, at_most: int) -> list[int]:
    """The training views that only measure: evenly spread, and no more than a fifth of all."""
    number = min(at_most, num_views // 5)
    return [(2 * index + 1) * num_views // (2 * number) for index in range(number)]


def decay(kind: LrDecay, progress: float) -> float:
    """The factor on the learning rate when a share `progress`, in [0, 1), of the steps is done."""
    match kind:
        case "none":
            return 1.0
        case "linear":
            return min(1.0, 2 * (1 - progress))
        case "cosine":
            return 0.5 * (1 + math.cos(math.pi * progress))


def check_finite(loss: float, renderer: nn.Module, *, step: int, out: Path) -> None:
    """Stops a run before its optimiser takes a loss or gradient that is no number: Adam would keep it for ever.

    A sum is not finite as soon as one of its terms is not; it costs 1 ms where `isfinite` takes 17 ms.
    """
    sums = {name: value.grad.sum() for name, value in renderer.named_parameters() if value.grad is not None}
    bad = [name for name, total in zip(sums, torch.stack(list(sums.values())).tolist()) if not math.isfinite(total)]
    if not math.isfinite(loss) or bad:
        what = f"the loss is {loss}" if not math.isfinite(loss) else f"the gradient of {bad[0]} is not finite"
        raise NumericsError(
            f"{out}: {what} at step {step}, so training stopped; the last good checkpoint is kept, "
            f"start anew with --overwrite and a lower --lr"
        )


def held_out_psnr(renderer: Renderer, pixels: PixelSource) -> float:
    """Mean over views of the PSNR in dB, peak 1, of the clipped 8-bit prediction."""
    prediction = predict_pixels(renderer, pixels)
    truth = pixels.rgb.cpu().numpy()
    error = (prediction.astype(np.float64) - truth) / 255
    mse = np.square(error).reshape(-1, pixels.pixels_per_view * 3).mean(axis=1)
    return float(np.mean(-10 * np.log10(np.maximum(mse, 1e-12))))


def count(parameters: list[nn.Parameter]) -> int:
    return sum(parameter.numel() for parameter in parameters)
