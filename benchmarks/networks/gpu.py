"""Benchmark of the renderer on a GPU: a 1080p frame and a large step, beside plain torch and what that GPU allows."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from benchmarks.harness import BenchReport, Candidate, Ceiling, Check, Gate, best_seconds, measure
from benchmarks.networks.choices import BenchChoices
from benchmarks.networks.naive import NaiveRenderer
from benchmarks.networks.setting import describe, made_up_batch, make_renderer, relative_error
from model.batches.rays import RayBatch
from model.methods.paper.renderer import PaperRenderer

FRAME, STEP = 1920 * 1080, 1 << 18
"""Pixels of a frame, and of a training step."""

GATE_STEP = 20.0

TOLERANCE = {"fp32": 1e-4, "bf16": 2e-2}


def gpu_ceilings(precision: str) -> tuple[Ceiling, Ceiling]:
    """What the GPU that is present does at best: products in the network's precision, and copying."""
    size, kind = 4096, torch.bfloat16 if precision == "bf16" else torch.float32
    a, b = torch.randn(2, size, size, device="cuda", dtype=kind)
    out = torch.empty_like(a)
    flops = 2 * size**3 / best_seconds(synchronised(lambda: torch.mm(a, b, out=out)))
    source = torch.ones(1 << 28, device="cuda")  # 1 GiB, beyond every cache.
    target = torch.empty_like(source)
    copied = 2 * source.nbytes / best_seconds(synchronised(lambda: target.copy_(source)))
    return (
        Ceiling(name=f"{precision} matrix product", value=1e-12 * flops, unit="TFLOP/s"),
        Ceiling(name="copy, bytes read and written", value=1e-9 * copied, unit="GB/s"),
    )


def floors(
    renderer: PaperRenderer, num_pixels: int, filled: float, ceilings: tuple[Ceiling, Ceiling]
) -> dict[str, float]:
    """Least seconds of a frame and of a step: products at the GPU's best, each byte moved once.

    A frame reads its layers (6 bytes a place) and 4 texels of 2 bytes a channel for each surface. A step multiplies
    three times as much, and its Adam moves 34 bytes a parameter of the textures.
    """
    flops_a_second, bytes_a_second = 1e12 * ceilings[0].value, 1e9 * ceilings[1].value
    table = renderer.textures.get_parameter("table")
    flops = 2 * sum(parameter.numel() for name, parameter in renderer.net.named_parameters() if parameter.ndim == 2)
    products = num_pixels * flops / flops_a_second
    num_layers = renderer.net.first.linear.in_features // table.shape[1]
    places = num_pixels * num_layers
    texels = places * filled * 4 * 2 * table.shape[1] / bytes_a_second
    layers = places * 6 / bytes_a_second
    return {
        "frame": max(products, texels + layers),
        "step": max(3 * products, 3 * texels + 34 * table.numel() / bytes_a_second),
    }


def synchronised(run: Callable[[], object]) -> Callable[[], None]:
    def wait() -> None:
        run()
        torch.cuda.synchronize()

    return wait


def to_device(rays: RayBatch, device: torch.device) -> RayBatch:
    return RayBatch(uv=rays.uv.to(device), object_id=rays.object_id.to(device), p_camera=rays.p_camera.to(device))


def step_of(module: torch.nn.Module, rays: RayBatch, truth: Tensor, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad(set_to_none=True)
    functional.l1_loss(module(rays), truth).backward()
    optimizer.step()


def bench_gpu(choices: BenchChoices, *, seed: int = 0, frame: int = FRAME, step: int = STEP) -> BenchReport:
    """Times a frame and a step; without CUDA says so, and times nothing."""
    if not torch.cuda.is_available():
        why = "torch finds no CUDA device here"
        return measure(
            "gpu", [], settings={"precision": choices.precision}, facts={"skipped": why}, rounds=choices.rounds
        )
    # Else the rival's convolutions, and they alone, would round their factors to TF32 on every GPU since Ampere.
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    device = torch.device("cuda")
    rng = np.random.default_rng(seed)
    renderer = make_renderer(choices, rng=rng).to(device)
    naive = NaiveRenderer(renderer).to(device)
    rays, truth = made_up_batch(choices, rng=rng)
    filled = float((rays.object_id != 0).float().mean())

    def of_size(count: int) -> RayBatch:
        index = torch.arange(count) % len(truth)
        return to_device(
            RayBatch(uv=rays.uv[index], object_id=rays.object_id[index], p_camera=rays.p_camera[index]), device
        )

    whole, batch = of_size(frame), of_size(step)
    colors = truth[torch.arange(step) % len(truth)].to(device)
    ours = torch.optim.Adam(renderer.parameters(), lr=1e-3, fused=True)
    theirs = torch.optim.Adam(naive.parameters(), lr=1e-3, foreach=False, fused=False)

    @torch.inference_mode()
    def draw(module: torch.nn.Module) -> Tensor:
        was_training = module.training
        result = module.eval()(whole)
        module.train(was_training)
        return result

    def compare() -> tuple[bool, str]:
        error, most = relative_error(draw(renderer), draw(naive)), TOLERANCE[choices.precision]
        return error <= most, f"colours off by {error:.1e} of the largest; expected at most {most:g}"

    ceilings = gpu_ceilings(choices.precision)
    least = floors(renderer, frame, filled, ceilings)["frame"], floors(renderer, step, filled, ceilings)["step"]
    report = measure(
        "gpu",
        [
            Candidate(name="naive frame", run=synchronised(lambda: draw(naive)), note="plain torch"),
            Candidate(name="frame", run=synchronised(lambda: draw(renderer))),
            Candidate(
                name="naive step", run=synchronised(lambda: step_of(naive, batch, colors, theirs)), note="plain torch"
            ),
            Candidate(name="step", run=synchronised(lambda: step_of(renderer, batch, colors, ours))),
        ],
        checks=[Check(name="same colours", run=compare)],
        gates=[Gate(name="whole step", baseline="naive step", candidate="step", at_least=GATE_STEP)],
        ceilings=ceilings,
        settings={"frame": frame, "step": step, **describe(choices, renderer)},
        facts={"gpu": torch.cuda.get_device_name()},
        rounds=choices.rounds,
    )
    if report.timings:
        for timing, seconds in ((report.timings[1], least[0]), (report.timings[3], least[1])):
            share = seconds / timing.wall.median
            report.facts[f"floor of a {timing.name}"] = f"{1e3 * seconds:.3f} ms on this GPU, {share:.1%} of it reached"
    return report
