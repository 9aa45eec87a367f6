"""Benchmark of a training step on a CPU: the product's beside the naive one, whole, its phases, its textures."""

import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.harness import BenchReport, Candidate, Ceiling, Check, Gate, measure
from benchmarks.networks.choices import BenchChoices
from benchmarks.networks.naive import NaiveRenderer
from benchmarks.networks.setting import describe, made_up_batch, make_renderer, relative_distance, relative_error
from model.batches.rays import RayBatch
from model.methods.paper.renderer import PaperRenderer
from model.settings.runtime import keep_freed_memory

GATE_STEP, GATE_TEXTURES = 5.0, 10.0

CHECKED = 4096
"""Pixels on which both are compared. Of more, torch's batch norm over rows sums up too much rounding."""

TOLERANCE = {"fp32": 1e-2, "bf16": 0.4}
"""Of gradients, as shares of their length. Where rounding moves a value across the kink of an activation or of the
loss, that pixel's gradient is another one, however small the step across was."""

PHASES = ("look-up", "network", "backward", "optimiser")


class Trainee:
    """A renderer, its optimiser, and the seconds that each phase of its steps took."""

    def __init__(
        self,
        rays: RayBatch,
        truth: Tensor,
        optimizer: torch.optim.Optimizer,
        look_up: Callable[[], Tensor],
        net: Callable[[Tensor], Tensor],
    ) -> None:
        self.rays, self.truth, self.optimizer = rays, truth, optimizer
        self.look_up, self.net = look_up, net
        self.seconds: list[list[float]] = []

    def step(self) -> None:
        """One training step on the mean absolute difference."""
        marks = [time.perf_counter()]
        self.optimizer.zero_grad(set_to_none=True)
        stack = self.look_up()
        marks.append(time.perf_counter())
        loss = functional.l1_loss(self.net(stack), self.truth)
        marks.append(time.perf_counter())
        loss.backward()
        marks.append(time.perf_counter())
        self.optimizer.step()
        marks.append(time.perf_counter())
        self.seconds.append(list(np.diff(marks)))

    def phases(self) -> str:
        """Median milliseconds of each phase."""
        medians = 1e3 * np.median(self.seconds[2:], axis=0)
        return ", ".join(f"{name} {value:.1f} ms" for name, value in zip(PHASES, medians, strict=True))


def naive_trainee(naive: NaiveRenderer, rays: RayBatch, truth: Tensor) -> Trainee:
    optimizer = torch.optim.Adam(naive.parameters(), lr=1e-3, foreach=False, fused=False)
    return Trainee(rays, truth, optimizer, lambda: naive.sample(rays), lambda stack: naive.net(stack)[0, :, 0].T)


def product_trainee(renderer: PaperRenderer, rays: RayBatch, truth: Tensor) -> Trainee:
    optimizer = torch.optim.Adam(renderer.parameters(), lr=1e-3, fused=True)
    return Trainee(
        rays,
        truth,
        optimizer,
        lambda: renderer.textures(rays.uv, rays.object_id),
        lambda stack: renderer.net(stack.flatten(1)),
    )


def texture_step(look_up: Callable[[], Tensor], upstream: Tensor, optimizer: torch.optim.Optimizer) -> None:
    """Look-up, gradient and optimiser of the textures alone."""
    optimizer.zero_grad(set_to_none=True)
    look_up().backward(upstream)
    optimizer.step()


def compare(
    renderer: PaperRenderer, naive: NaiveRenderer, rays: RayBatch, truth: Tensor, tolerance: float
) -> tuple[bool, str]:
    """Whether both make the same colours, and the same gradients of textures and network."""
    truth = truth[:CHECKED]
    rays = RayBatch(uv=rays.uv[:CHECKED], object_id=rays.object_id[:CHECKED], p_camera=rays.p_camera[:CHECKED])
    found, expected = renderer(rays), naive(rays)
    functional.l1_loss(found, truth).backward()
    functional.l1_loss(expected, truth).backward()
    table = renderer.textures.get_parameter("table")
    assert table.grad is not None
    errors = {
        "colours": relative_error(found, expected),
        "textures' gradient": relative_distance(table.grad, naive.texture_gradient()),
        "network's gradient": max(
            relative_distance(ours.grad.flatten(), theirs.grad.flatten())
            for (name, ours), theirs in zip(renderer.net.named_parameters(), naive.net.parameters(), strict=True)
            # Batch norm takes a bias before it away again: its true gradient is 0.
            if ours.grad is not None and theirs.grad is not None and not is_before_norm(renderer.net, name)
        ),
    }
    renderer.zero_grad(set_to_none=True)
    naive.zero_grad(set_to_none=True)
    detail = ", ".join(f"{name} off by {error:.1e}" for name, error in errors.items())
    return max(errors.values()) <= tolerance, f"{detail} (shares of their size); expected at most {tolerance:g}"


def is_before_norm(net: nn.Module, name: str) -> bool:
    """True for the bias of a linear layer that batch norm follows."""
    unit = name.removesuffix(".linear.bias")
    return unit != name and isinstance(net.get_submodule(unit + ".norm"), nn.BatchNorm1d)


def bench_step(choices: BenchChoices, *, ceilings: Sequence[Ceiling] = (), seed: int = 0) -> BenchReport:
    """Times training steps."""
    keep_freed_memory()
    rng = np.random.default_rng(seed)
    renderer = make_renderer(choices, rng=rng)
    naive = NaiveRenderer(renderer)
    rays, truth = made_up_batch(choices, rng=rng)
    upstream = torch.from_numpy(rng.standard_normal((choices.pixels, choices.layers * choices.features), np.float32))
    theirs, ours = naive_trainee(naive, rays, truth), product_trainee(renderer, rays, truth)
    their_textures = torch.optim.Adam(naive.images.parameters(), lr=1e-3, foreach=False, fused=False)
    our_textures = torch.optim.Adam(renderer.textures.parameters(), lr=1e-3, fused=True)
    flat = (choices.pixels, choices.layers, choices.features)
    images = upstream.T[None, :, None].contiguous()
    candidates = [
        Candidate(name="naive step", run=theirs.step, note="grid_sample, 1x1 convolutions, for-loop Adam"),
        Candidate(name="step", run=ours.step, note="as `model train paper` does it"),
        Candidate(
            name="naive textures",
            run=lambda: texture_step(lambda: naive.sample(rays), images, their_textures),
            note="look-up, gradient, Adam",
        ),
        Candidate(
            name="textures",
            run=lambda: texture_step(ours.look_up, upstream.view(flat), our_textures),
            note="look-up, gradient, Adam",
        ),
    ]
    tolerance = TOLERANCE[choices.precision]
    report = measure(
        "step",
        candidates,
        checks=[Check(name="same step", run=lambda: compare(renderer, naive, rays, truth, tolerance))],
        gates=[
            Gate(name="whole step", baseline="naive step", candidate="step", at_least=GATE_STEP),
            Gate(name="texture part", baseline="naive textures", candidate="textures", at_least=GATE_TEXTURES),
        ],
        ceilings=ceilings,
        settings={"pixels": choices.pixels, **describe(choices, renderer)},
        facts={"places with a surface": f"{float((rays.object_id != 0).float().mean()):.0%}"},
        rounds=choices.rounds,
    )
    if report.timings:
        report.facts.update({"phases, naive": theirs.phases(), "phases": ours.phases()})
    return report
