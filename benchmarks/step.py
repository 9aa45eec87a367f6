"""Benchmark of a training step on a CPU beside the naive baseline."""

import itertools
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.choices import BenchChoices
from benchmarks.harness import BenchReport, Candidate, Check, Gate, measure
from benchmarks.naive import (
    NaiveRenderer,
    describe,
    made_up_batch,
    make_renderer,
    relative_distance,
    relative_error,
)
from datagen.data.cameras import Cameras
from datagen.data.config import DatasetConfig, square
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene
from datagen.scene.finding import find_scene
from datagen.scene.rig import make_cameras
from model.batches.rays import RayBatch, made_ahead
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import LightPathPixels
from model.methods.paper.renderer import PaperRenderer
from model.run.optimizer import make_optimizer
from model.runtime import keep_freed_memory, start_numba_threads, use_few_threads

GATE_STEP, GATE_TEXTURES = 5.0, 10.0

CHECKED = 4096
"""Pixels compared. With more, torch's batch norm over rows accumulates too much rounding."""

TOLERANCE = 1e-2
"""Tolerance of gradients, relative to their length. If rounding moves a value across the kink of an activation or of
the loss, that pixel's gradient changes, however small the step."""

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


def light_path_step(seed: int = 0) -> Callable[[], None]:
    """A step of `light-path` on random colours of the glass table, as `model train` takes it but tracing in turn."""
    use_mitsuba()
    from datagen.trace.light_path import LightPathTracer
    from datagen.trace.surface_tables import tints_of

    scene = find_scene("glass_table")
    config = LightPathConfig().sized((128,) * len(scene.objects))
    optimisation = config.optimisation()
    cameras = bench_cameras(scene)
    rgb = torch.randint(0, 256, (len(cameras) * cameras.height * cameras.width, 3), dtype=torch.uint8)
    pixels = LightPathPixels(
        tracer=LightPathTracer(
            tuple(item.mesh for item in scene.objects),
            tuple(item.material for item in scene.objects),
            tints_of(scene, own_uv=True),
        ),
        straight_tracer=None,
        num_objects=len(scene.objects),
        config=config,
        cameras=cameras,
        rgb=rgb,
    )
    renderer = LightPathRenderer(config)
    size = optimisation.batch // optimisation.updates
    groups = renderer.groups(optimisation)
    optimizer = make_optimizer(
        groups, beta1=optimisation.beta1, kind=optimisation.optimizer, renderer=renderer, pixels=size
    )
    steps = itertools.count()

    def step() -> None:
        threads, number = torch.get_num_threads(), next(steps)
        use_few_threads(size)

        def draw(_: int) -> list[np.random.Generator]:
            return [np.random.default_rng([seed, number, update]) for update in range(optimisation.updates)]

        (traced,) = made_ahead(pixels, draw, range(1), size=size)
        for rng in draw(0):
            optimizer.zero_grad(set_to_none=True)
            renderer.loss(traced, size, rng, softness=optimisation.loss.softness).backward()
            optimizer.step()
        torch.set_num_threads(threads)
        start_numba_threads()

    return step


def bench_cameras(scene: Scene) -> Cameras:
    """Sixteen training cameras of 128 x 128 pixels."""
    return make_cameras(scene.cameras, DatasetConfig.even(scene.name, square(128), 16))["train"]


def bench_step(choices: BenchChoices, *, seed: int = 0) -> BenchReport:
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
        Candidate(name="light-path", run=light_path_step(seed), note="a step of 2,048 pixels, 128² textures"),
    ]
    report = measure(
        "step",
        candidates,
        checks=[Check(name="same step", run=lambda: compare(renderer, naive, rays, truth, TOLERANCE))],
        gates=[
            Gate(name="whole step", baseline="naive step", candidate="step", at_least=GATE_STEP),
            Gate(name="texture part", baseline="naive textures", candidate="textures", at_least=GATE_TEXTURES),
        ],
        settings={"pixels": choices.pixels, **describe(choices, renderer)},
        facts={"places with a surface": f"{float((rays.object_id != 0).float().mean()):.0%}"},
        rounds=choices.rounds,
    )
    if report.timings:
        report.facts.update({"phases, naive": theirs.phases(), "phases": ours.phases()})
    return report
