"""Benchmark of truth: how long until a picture's noise is low enough, with our sampling and with Mitsuba's own.

Noise is estimated from independent renderings at two numbers of samples, and a power law through both tells how many
samples a ceiling takes: it is steeper than 1 / n where samples are stratified. Time per sample is measured by turns.
"""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportCallIssue=false

import dataclasses
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float

from benchmarks.harness import BenchReport, Candidate, Check, Gate, measure
from datagen.data.cameras import Cameras
from datagen.data.config import DatasetConfig, square
from datagen.data.images import srgb_from_linear
from datagen.render.mitsuba_scene import load_scene_mitsuba, load_sensor
from datagen.render.truth import Renderer, derive_seed
from datagen.scene.description import Scene
from datagen.scene.finding import find_scene
from datagen.scene.materials import Dielectric
from datagen.scene.rig import make_cameras
from datagen.terminal.command import say

DEFAULT_RR_DEPTH = 5
"""Mitsuba's: from this depth on paths end at random."""

TIMED_SPP = 16
"""Samples per pixel of one timed call."""

PAIRS = 4
"""Independent pairs of renderings that noise is estimated from, at each number of samples."""

MIN_AGREEMENT = 0.8, 1.25
"""Squared difference of both means over what their noise predicts; 1 where they estimate the same picture."""

OURS, DEFAULTS = "datagen build", "mitsuba's defaults"


def open_views(name: str, size: int) -> tuple[Scene, Cameras]:
    """A scene, and four of its training cameras."""
    scene = find_scene(name)
    return scene, make_cameras(scene.cameras, DatasetConfig.even(scene.name, square(size), 4))["train"]


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What is asked of the pictures."""

    ceiling_db: float
    at_least: float
    """Times as fast as Mitsuba's defaults."""
    low_spp: int = 16
    high_spp: int = 64
    """Where noise is estimated."""


GOAL = Goal(ceiling_db=45, at_least=5)


class Radiance(Protocol):
    """Renders linear radiance (h, w, 3); also returns the actual number of samples per pixel."""

    def __call__(self, *, spp: int, seed: int) -> tuple[np.ndarray, int]: ...


@dataclass(frozen=True, kw_only=True)
class NoiseLaw:
    """Mean squared error of the clipped sRGB picture: `scale` / spp ** `exponent`."""

    scale: float
    exponent: float

    def spp_for(self, ceiling_db: float) -> float:
        return (self.scale / 10 ** (-ceiling_db / 10)) ** (1 / self.exponent)


def bench_truth(
    scene: Scene,
    cameras: Cameras,
    goal: Goal,
    *,
    view: int = 0,
    max_depth: int = 24,
    mean_spp: int = 512,
    rounds: int = 7,
) -> BenchReport:
    """Measures the time to a noise ceiling. Call `use_mitsuba` first.

    Args:
        mean_spp: samples of the two means that must agree.
    """
    simple = with_clear_glass_apart(scene)
    num_left_out = len(scene.objects) - len(simple.objects)
    scene = simple
    ours = Renderer(scene, max_depth=max_depth)
    default = DefaultRenderer(scene, cameras, view, max_depth=max_depth)

    def render_ours(*, spp: int, seed: int) -> tuple[np.ndarray, int]:
        return ours.radiance(cameras, view, spp=spp, seed=seed), spp

    rivals: dict[str, Radiance] = {DEFAULTS: default.radiance, OURS: render_ours}
    facts: dict[str, object] = {"solids left out, which reach into others": num_left_out}
    checks = [Check(name="same picture", run=lambda: compare_means(rivals[DEFAULTS], rivals[OURS], mean_spp))]
    candidates = []
    for name, radiance in rivals.items():
        say(f"bench truth: estimating the noise of {name}")
        law = fit_noise(radiance, goal)
        wanted = law.spp_for(goal.ceiling_db)
        _, drawn = radiance(spp=TIMED_SPP, seed=0)
        facts[f"{name}: samples per pixel for {goal.ceiling_db:g} dB"] = round(wanted, 1)
        facts[f"{name}: exponent of the noise"] = round(-law.exponent, 2)
        candidates.append(
            Candidate(
                name=name,
                run=lambda radiance=radiance, drawn=drawn: radiance(spp=drawn, seed=1),
                calls=wanted / drawn,
                note=f"{drawn} spp a call, {wanted / drawn:.1f} calls to {goal.ceiling_db:g} dB",
            )
        )
    report = measure(
        "bench truth",
        candidates,
        checks=checks,
        gates=[Gate(name="time to the ceiling", baseline=DEFAULTS, candidate=OURS, at_least=goal.at_least)],
        settings={"scene": scene.name, "size": cameras.width, "depth": max_depth},
        facts=facts,
        rounds=rounds,
    )
    for timing in report.timings:
        report.facts[f"{timing.name}: seconds to {goal.ceiling_db:g} dB"] = round(timing.calls * timing.wall.median, 3)
    return report


class DefaultRenderer:
    """Mitsuba's path tracer as it comes: independent samples, Russian roulette from the fifth bounce on."""

    def __init__(self, scene: Scene, cameras: Cameras, view: int, *, max_depth: int) -> None:
        import mitsuba as mi

        self._scene = load_scene_mitsuba(scene)
        self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": DEFAULT_RR_DEPTH})
        self._sensor = load_sensor(cameras[view], sampler="independent")

    def radiance(self, *, spp: int, seed: int) -> tuple[np.ndarray, int]:
        import mitsuba as mi

        integrator = self._integrator
        image = mi.render(self._scene, sensor=self._sensor, integrator=integrator, spp=spp, seed=mi.UInt32(seed))
        return np.array(image, np.float32), spp


def with_clear_glass_apart(scene: Scene) -> Scene:
    """The scene with clear glass of one index, and without solids that have a priority of their own, such as drinks.

    Mitsuba's `path` knows neither absorption nor dispersion, nor which of two solids fills the space that they share.
    Both rivals must estimate one picture.
    """
    objects = []
    for item in scene.objects:
        material = item.material
        if isinstance(material, Dielectric):
            material = dataclasses.replace(material, absorption=(0.0, 0.0, 0.0), dispersion=0.0)
        if material.medium is None or material.medium.priority == 0:
            objects.append(dataclasses.replace(item, material=material))
    return dataclasses.replace(scene, objects=tuple(objects))


def noise_mse(radiance: Radiance, spp: int) -> tuple[float, int]:
    """Mean squared error of the clipped sRGB picture at this number of samples, and the actual number."""
    errors, drawn = [], spp
    for pair in range(PAIRS):
        (one, drawn), (other, _) = (radiance(spp=spp, seed=derive_seed("noise", spp, pair, half)) for half in (0, 1))
        # Of the difference of two, half is the error of each.
        errors.append(np.mean((srgb_from_linear(one) - srgb_from_linear(other)) ** 2) / 2)
    return float(np.mean(errors)), drawn


def fit_noise(radiance: Radiance, goal: Goal) -> NoiseLaw:
    """The power law through the noise at two numbers of samples."""
    (low, low_drawn), (high, high_drawn) = (noise_mse(radiance, spp) for spp in (goal.low_spp, goal.high_spp))
    exponent = math.log(low / high) / math.log(high_drawn / low_drawn)
    return NoiseLaw(scale=high * high_drawn**exponent, exponent=exponent)


def compare_means(one: Radiance, other: Radiance, spp: int) -> tuple[bool, str]:
    """Whether two pictures differ by no more than their noise, which is estimated again at this spp."""
    halves = [
        [_mean(radiance, spp, f"{place} {half}") for half in (0, 1)] for place, radiance in enumerate((one, other))
    ]
    means = [(a + b) / 2 for a, b in halves]
    found = float(np.mean((means[0] - means[1]) ** 2))
    expected = float(sum(np.mean(((a - b) / 2) ** 2) for a, b in halves))
    low, high = MIN_AGREEMENT
    detail = (
        f"the two means differ by {found / expected:.3f} of what their noise predicts (mean squares, linear); expected "
        f"{low:g} to {high:g}; ratio of their brightness {means[1].mean() / means[0].mean():.5f}"
    )
    return low <= found / expected <= high, detail


def _mean(radiance: Radiance, spp: int, name: str) -> Float[np.ndarray, "h w 3"]:
    """The mean of passes of a moderate size."""
    total, drawn = 0.0, 0
    while drawn < spp:
        image, real = radiance(spp=min(256, spp), seed=derive_seed("mean", name, drawn))
        total, drawn = total + image.astype(np.float64) * real, drawn + real
    return np.asarray(total / drawn)
