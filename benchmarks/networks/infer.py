"""Benchmark of rendering a frame from its layers on a CPU: as `model predict` does it, beside the naive way."""

from collections.abc import Sequence

import numpy as np
import torch

from benchmarks.harness import BenchReport, Candidate, Ceiling, Check, Gate, measure
from benchmarks.networks.choices import BenchChoices
from benchmarks.networks.naive import NaiveRenderer
from benchmarks.networks.setting import FRAME_TOLERANCE, describe, made_up_frame, make_renderer, relative_error
from model.run.predict import predict_colors, predict_pixels
from model.settings.runtime import keep_freed_memory

GATE = 10.0


@torch.inference_mode()
def bench_infer(choices: BenchChoices, *, ceilings: Sequence[Ceiling] = (), seed: int = 0) -> BenchReport:
    """Times frames."""
    keep_freed_memory()
    rng = np.random.default_rng(seed)
    renderer = make_renderer(choices, rng=rng).eval()
    naive = NaiveRenderer(renderer).eval()
    pixels = made_up_frame(choices, rng=rng)
    rays = pixels.take(torch.arange(len(pixels.rgb)), None)

    def compare() -> tuple[bool, str]:
        error, most = relative_error(predict_colors(renderer, pixels), naive(rays)), FRAME_TOLERANCE[choices.precision]
        return error <= most, f"colours off by {error:.1e} of the largest; expected at most {most:g}"

    return measure(
        "infer",
        [
            Candidate(name="naive frame", run=lambda: naive(rays), note="grid_sample, 1x1 convolutions"),
            Candidate(
                name="frame", run=lambda: predict_pixels(renderer, pixels), note="as `model predict`, to 8-bit colours"
            ),
        ],
        checks=[Check(name="same colours", run=compare)],
        gates=[Gate(name="whole frame", baseline="naive frame", candidate="frame", at_least=GATE)],
        ceilings=ceilings,
        settings={"resolution": choices.resolution, **describe(choices, renderer)},
        facts={"places with a surface": f"{float((rays.object_id != 0).float().mean()):.0%}"},
        rounds=choices.rounds,
    )
