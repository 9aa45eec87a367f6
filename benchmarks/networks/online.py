"""Benchmark of a frame from meshes and a camera alone: layers rasterised and shaded, beside the naive way."""

import dataclasses

import numpy as np
import torch

from benchmarks.harness import BenchReport, Candidate, Ceiling, Check, Gate, Verdict, measure
from benchmarks.networks.choices import BenchChoices
from benchmarks.networks.naive import NaiveRenderer
from benchmarks.networks.setting import FRAME_TOLERANCE, describe, make_renderer, relative_error
from datagen.data.cameras import Cameras
from datagen.data.layers import Layers
from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.trace.raster import Rasterizer
from model.batches.rays import Pixels
from model.methods.paper.renderer import PaperRenderer
from model.run.predict import predict_colors, predict_pixels
from model.settings.runtime import keep_freed_memory

GATE, GATE_RATE = 25.0, 12.0
"""Times as fast as the naive frame, and frames a second."""

SAME_OBJECTS = 0.98
"""Share of the pixels for which both must list the same objects: `spawn_ray` loses surfaces that lie close together."""


def pixels_of(layers: Layers) -> Pixels:
    """A view's layers as a renderer takes them; its picture is black."""
    num_layers, height, width = layers.object_id.shape
    return Pixels(
        uv=torch.from_numpy(layers.uv.view(np.int16)).view(num_layers, -1, 2).transpose(0, 1),
        object_id=torch.from_numpy(layers.object_id).view(num_layers, -1).T,
        rgb=torch.zeros(height * width, 3, dtype=torch.uint8),
        p_camera=torch.zeros(1, 3),
        pixels_per_view=height * width,
    )


class OnlineBench:
    """Both ways to draw one camera's view."""

    def __init__(self, meshes: tuple[Mesh, ...], cameras: Cameras, renderer: PaperRenderer, num_layers: int) -> None:
        use_mitsuba()
        from benchmarks.generator.rivals import EagerPeeler

        self.cameras, self.num_layers = cameras, num_layers
        self.renderer, self.naive = renderer, NaiveRenderer(renderer).eval()
        self.rasterizer, self.eager = Rasterizer(meshes), EagerPeeler(meshes)

    def layers(self) -> Layers:
        return self.rasterizer.rasterize(self.cameras, 0, self.num_layers)[0]

    def naive_layers(self) -> Layers:
        return self.eager.peel(self.cameras, 0, self.num_layers)

    def frame(self) -> np.ndarray:
        return predict_pixels(self.renderer, pixels_of(self.layers()))

    def naive_colors(self, layers: Layers) -> torch.Tensor:
        pixels = pixels_of(layers)
        with torch.inference_mode():
            return self.naive(pixels.take(torch.arange(len(pixels.rgb)), None))

    def naive_frame(self) -> np.ndarray:
        return (self.naive_colors(self.naive_layers()).clamp(0, 1) * 255).round().byte().numpy()

    def compare_colors(self, most: float) -> tuple[bool, str]:
        layers = self.layers()
        error = relative_error(predict_colors(self.renderer, pixels_of(layers)), self.naive_colors(layers))
        return error <= most, f"from equal layers, colours off by {error:.1e} of the largest; expected at most {most:g}"

    def compare_layers(self) -> tuple[bool, str]:
        same = (self.layers().object_id == self.naive_layers().object_id).all(axis=0).mean()
        return bool(same >= SAME_OBJECTS), f"{same:.2%} of the pixels; expected at least {SAME_OBJECTS:.0%}"


def bench_online(
    choices: BenchChoices, *, ceilings: tuple[Ceiling, ...] = (), seed: int = 0, triangles: int = 315_000
) -> BenchReport:
    """Times frames.

    Raises:
        HyalineError: Mitsuba has no vectorised variant here.
    """
    from benchmarks.generator.shells import make_shells, random_cameras

    keep_freed_memory()
    renderer = make_renderer(choices, rng=np.random.default_rng(seed)).eval()
    meshes = make_shells(triangles, choices.objects)
    bench = OnlineBench(meshes, random_cameras(1, choices.resolution), renderer, choices.layers)
    report = measure(
        "online",
        [
            Candidate(name="naive frame", run=bench.naive_frame, note="spawn_ray loop, grid_sample, 1x1 convolutions"),
            Candidate(name="frame", run=bench.frame, note="rasterised, then as `model render`, to 8-bit colours"),
            Candidate(name="naive layers", run=bench.naive_layers),
            Candidate(name="layers", run=bench.layers),
        ],
        checks=[
            Check(name="same colours", run=lambda: bench.compare_colors(FRAME_TOLERANCE[choices.precision])),
            Check(name="same objects", run=bench.compare_layers),
        ],
        gates=[Gate(name="whole frame", baseline="naive frame", candidate="frame", at_least=GATE)],
        ceilings=ceilings,
        settings={"resolution": choices.resolution, **describe(choices, renderer)},
        facts={"triangles": sum(len(mesh.faces) for mesh in meshes)},
        rounds=choices.rounds,
    )
    if not report.timings:
        return report
    rate = 1 / report.timings[1].wall.median
    detail = f"{rate:.1f} frames a second; expected at least {GATE_RATE:g}"
    verdict = Verdict(name="rate", passed=rate >= GATE_RATE, detail=detail, ratio=rate, at_least=GATE_RATE)
    return dataclasses.replace(report, gates=(*report.gates, verdict))
