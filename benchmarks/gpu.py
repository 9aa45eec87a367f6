"""Benchmark of a GPU: the networks beside the naive baseline, truth, light paths, and training on them."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from benchmarks.choices import BenchChoices
from benchmarks.harness import BenchReport, Candidate, Check, Gate, measure
from benchmarks.naive import NaiveRenderer, describe, made_up_batch, make_renderer, relative_error
from datagen.builder.synthetic import synthetic_scene, write_synthetic_dataset
from datagen.data.paths import TRUTH
from datagen.machine.mitsuba_variant import choose_variant
from datagen.render.truth import Renderer
from datagen.trace.light_path import LightPathTracer, Limits
from model.batches.rays import RayBatch
from model.methods.light_path.config import LightPathConfig
from model.methods.protocol import open_inputs
from model.run.predict import predict_pixels

FRAME, STEP = 1920 * 1080, 1 << 18
"""Pixels of a frame, and of a training step."""

GPU_GATE = 5.0
"""Least ratio of a step. 20 was hoped for before a GPU was at hand; an H100 reached 7.5 (docs/notes/speed.md)."""

GPU_TOLERANCE = 1e-4


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
    """Times frames, steps, truth and light paths; skipped with a message without CUDA. Call `use_mitsuba` first."""
    if not torch.cuda.is_available():
        why = "torch finds no CUDA device here"
        return measure("gpu", [], facts={"skipped": why}, rounds=choices.rounds)
    # Else the rival's convolutions, and they alone, would round their factors to TF32 on every GPU since Ampere.
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    device = torch.device("cuda")
    rng = np.random.default_rng(seed)
    renderer = make_renderer(choices, rng=rng).to(device)
    naive = NaiveRenderer(renderer).to(device)
    rays, truth = made_up_batch(choices, rng=rng)

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
        error, most = relative_error(draw(renderer), draw(naive)), GPU_TOLERANCE
        return error <= most, f"colours off by {error:.1e} of the largest; expected at most {most:g}"

    folder = tempfile.TemporaryDirectory(prefix="hyaline-bench-")
    traced, amounts = traced_candidates(Path(folder.name), device, size=SIZE)
    report = measure(
        "gpu",
        [
            Candidate(name="naive frame", run=synchronised(lambda: draw(naive)), note="plain torch"),
            Candidate(name="frame", run=synchronised(lambda: draw(renderer))),
            Candidate(
                name="naive step", run=synchronised(lambda: step_of(naive, batch, colors, theirs)), note="plain torch"
            ),
            Candidate(name="step", run=synchronised(lambda: step_of(renderer, batch, colors, ours))),
            *traced,
        ],
        checks=[Check(name="same colours", run=compare)],
        gates=[Gate(name="whole step", baseline="naive step", candidate="step", at_least=GPU_GATE)],
        settings={"frame": frame, "step": step, **describe(choices, renderer)},
        facts={"gpu": torch.cuda.get_device_name(), "TF32": "off for both", "Mitsuba": choose_variant().variant},
        rounds=choices.rounds,
    )
    folder.cleanup()
    for timing in report.timings:
        if timing.name in amounts:
            count, unit = amounts[timing.name]
            report.facts[timing.name] = f"{count / timing.wall.median:,.3g} {unit}/s"
    return report


SIZE, SPP, UPDATE = 256, 16, 512
"""Width and height of traced pictures, samples per pixel of the truth, and pixels of an update of `light-path`."""


def traced_candidates(
    folder: Path, device: torch.device, *, size: int
) -> tuple[list[Candidate], dict[str, tuple[int, str]]]:
    """What follows light, on a scene of a pane over a floor; and how much of what each of them makes.

    Mitsuba traces with the variant that `use_mitsuba` chose, torch computes on `device`.
    """
    dataset, scene = write_synthetic_dataset(folder / "data", resolution=size), synthetic_scene()
    cameras = dataset.cameras("train")
    truth = Renderer(scene, max_depth=24)
    tracer = LightPathTracer(tuple(item.mesh for item in scene.objects), tuple(item.material for item in scene.objects))
    origin, directions = cameras[0].rays()
    directions = directions.reshape(-1, 3)
    origins = np.broadcast_to(origin, directions.shape)
    inputs = open_inputs(LightPathConfig(), dataset, TRUTH)
    config = LightPathConfig().complete(inputs)
    renderer = config.build(inputs).to(device)
    training = config.load(inputs, "train", [0, 1, 2, 3], with_images=True).to(device)
    view = config.load(inputs, "interpolating", [0], with_images=False).to(device)
    optimizer = torch.optim.Adam(renderer.parameters(), lr=1e-3, fused=True)
    rng = np.random.default_rng(0)

    def update() -> None:
        optimizer.zero_grad(set_to_none=True)
        renderer.train().loss(training, UPDATE, rng).backward()
        optimizer.step()
        if device.type == "cuda":
            torch.cuda.synchronize()

    limits = Limits(max_branches=config.branches, max_vertices=8, max_depth=16)
    candidates = [
        Candidate(name="truth", run=lambda: truth.radiance(cameras, 0, spp=SPP, seed=0), note=f"{size}², {SPP} spp"),
        Candidate(name="light paths", run=lambda: tracer.trace(origins, directions, limits), note="with packing"),
        Candidate(name="light-path update", run=update, note=f"{UPDATE} pixels, tracing included"),
        Candidate(name="light-path frame", run=lambda: predict_pixels(renderer.eval(), view), note="tracing included"),
    ]
    return candidates, {
        "truth": (size * size * SPP, "paths"),
        "light paths": (size * size, "rays"),
        "light-path update": (1, "updates"),
        "light-path frame": (1, "frames"),
    }
