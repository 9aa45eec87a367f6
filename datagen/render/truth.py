"""The path-traced ground truth of one view: two independent halves, their mean, and the remaining noise."""

import dataclasses
import hashlib
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from datagen.data.cameras import Cameras
from datagen.data.config import ROUNDING_MSE
from datagen.data.images import encode_exr, png_bytes, srgb_from_linear, to_8bit
from datagen.data.meshes import is_there
from datagen.disk.errors import HyalineError
from datagen.render.mitsuba_scene import has_small_light, load_scene_mitsuba, load_sensor
from datagen.scene.description import Scene
from datagen.scene.media import find_media

MAX_PATHS_PER_PASS = 1 << 23
"""Samples of one pass; more would cost memory and not be faster."""

MAX_SPP_PER_PASS = 1 << 12
"""Samples per pixel of one pass, which limits small pictures: the table of Sobol's points should fit into a cache."""

MAX_SPP = 1 << 17
"""Samples per pixel after which `--ceiling` gives up."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """A rendered view."""

    radiance: Float32[np.ndarray, "h w 3"]
    """Linear, the mean of both halves."""
    half_difference: Float32[np.ndarray, "h w 3"]
    """(first half - second half) / 2, linear: an estimate of the noise in `radiance`."""
    spp: int
    """Samples per pixel that were actually drawn, both halves together."""
    noise_mse: float
    """Estimated mean squared error of the clipped sRGB picture."""


class Renderer:
    """A loaded scene with its integrator; renders any number of views. Call `use_mitsuba` first."""

    def __init__(self, scene: Scene, *, max_depth: int) -> None:
        """Loads the scene."""
        from datagen.render.path_integrator import PathTracer

        scene = dataclasses.replace(scene, objects=tuple(item for item in scene.objects if is_there(item.mesh)))
        materials, meshes = zip(*((item.material, item.mesh) for item in scene.objects), strict=True)
        has_lamps, aims_at_sky = bool(scene.lights), has_small_light(scene.environment)
        self._tracer = PathTracer(
            load_scene_mitsuba(scene, aims_at_sky=aims_at_sky),
            find_media(materials, meshes),
            [material.surface() for material in materials],
            max_depth=max_depth,
            has_lamps=has_lamps,
            aims=has_lamps or aims_at_sky,
        )
        if has_lamps:
            from datagen.render.photons import map_caustics

            self._tracer.caustics = map_caustics(self._tracer)

    def radiance(self, cameras: Cameras, view: int, *, spp: int, seed: int) -> Float32[np.ndarray, "h w 3"]:
        """Linear radiance of one view."""
        size = {"width": cameras.width, "height": cameras.height}
        return self._tracer.render(load_sensor(cameras[view]), **size, spp=spp, seed=seed)


def render_view(
    renderer: Renderer, cameras: Cameras, view: int, *, spp: int, view_seed: int, ceiling_db: float | None
) -> Truth:
    """Renders both halves of a view, in passes that fit into memory.

    Args:
        spp: samples per pixel, both halves together; with a ceiling, the number to start with.
        ceiling_db: double the samples until the view's noise ceiling reaches this.
    """
    halves = [np.zeros((cameras.height, cameras.width, 3)) for _ in range(2)]
    drawn, passes, wanted = 0, 0, spp
    most = min(MAX_SPP_PER_PASS, max(1, MAX_PATHS_PER_PASS // (cameras.width * cameras.height)))
    while True:
        while drawn < wanted:
            count = min(most, max(1, (wanted - drawn) // 2))
            for half in range(2):
                seed = derive_seed(view_seed, half, passes)
                image = renderer.radiance(cameras, view, spp=count, seed=seed)
                halves[half] += image.astype(np.float64) * count
            drawn += 2 * count
            passes += 1
        truth = truth_of_halves(halves[0] * (2 / drawn), halves[1] * (2 / drawn), drawn)
        reached = -10 * math.log10(truth.noise_mse + ROUNDING_MSE)
        if ceiling_db is None or reached >= ceiling_db:
            return truth
        if drawn >= MAX_SPP:
            raise HyalineError(
                f"view {view}: its noise ceiling is {reached:.1f} dB after {drawn} samples per pixel, "
                f"expected {ceiling_db:g}; make the scene's lights larger and softer, or lower --ceiling"
            )
        wanted = 2 * drawn


def derive_seed(*parts: object) -> int:
    """A 32-bit seed that depends on exactly these parts."""
    return int.from_bytes(hashlib.sha256("|".join(map(str, parts)).encode()).digest()[:4], "little")


def truth_files(truth: Truth) -> dict[str, bytes]:
    """The 8-bit sRGB PNG, and the EXR: linear R, G, B and the half difference as noise.*, all half floats."""
    picture = png_bytes(to_8bit(srgb_from_linear(truth.radiance)))
    return {".png": picture, ".exr": encode_exr(truth.radiance, truth.half_difference)}


def truth_of_halves(first: Float[np.ndarray, "h w 3"], second: Float[np.ndarray, "h w 3"], spp: int) -> Truth:
    """The mean of two independent linear pictures of a view, and the noise that is left in it."""
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        bad = np.argwhere(~np.isfinite(first + second))[0]
        raise HyalineError(
            f"pixel (column {bad[1]}, row {bad[0]}): radiance is not finite; check the scene's materials"
        )
    # The variance of the mean of two halves is a quarter of the mean squared difference.
    noise_mse = float(np.mean((srgb_from_linear(first) - srgb_from_linear(second)) ** 2) / 4)
    return Truth(
        radiance=((first + second) / 2).astype(np.float32),
        half_difference=((first - second) / 2).astype(np.float32),
        spp=spp,
        noise_mse=noise_mse,
    )
