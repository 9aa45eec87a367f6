"""The path-traced ground truth of one view: two independent halves, their mean, and the remaining noise."""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportCallIssue=false

import dataclasses
import hashlib
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from datagen.data.cameras import Cameras
from datagen.data.config import Split
from datagen.data.images import encode_exr, png_bytes, srgb_from_linear, to_8bit
from datagen.data.meshes import is_there
from datagen.data.metadata import ROUNDING_MSE
from datagen.disk.errors import HyalineError
from datagen.render.mitsuba_scene import has_small_light, is_scalar, load_scene_mitsuba, load_sensor
from datagen.scene.contact import largest_coordinate, thin_share
from datagen.scene.description import Scene
from datagen.scene.materials import Dielectric
from datagen.scene.materials.optics import Surface
from datagen.scene.media import find_media
from datagen.scene.soundness import MAX_THIN

MAX_PATHS_PER_PASS = 1 << 23
"""Samples of one pass; more would cost memory and not be faster."""

MAX_SPP_PER_PASS = 1 << 12
"""Samples per pixel of one pass, which limits small pictures: the table of Sobol's points should fit into a cache."""

SCALAR_OFFSET = 1e-4
"""Slightly more than the distance off its surface, relative to 1 + its largest coordinate, at which Mitsuba's
`spawn_ray` starts a ray."""
NO_GLASS = Surface(event="ends")

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
        import mitsuba as mi

        scene = dataclasses.replace(scene, objects=tuple(item for item in scene.objects if is_there(item.mesh)))
        materials, meshes = zip(*((item.material, item.mesh) for item in scene.objects), strict=True)
        if is_scalar() and any(material.medium and material.medium.priority for material in materials):
            raise HyalineError(
                f"scene {scene.name}: has dielectrics with priorities, which Mitsuba as scalar_rgb cannot render; "
                "`datagen doctor` names the libLLVM to install"
            )
        media = find_media(materials, meshes)
        if is_scalar():
            _check_walls_scalar(scene)
            # Mitsuba's glass bends all colours alike. If ours disperses, each channel is rendered separately.
            channels = range(3) if media.parts_colors.any() else [None]
            self._scenes = [load_scene_mitsuba(_in_channel(scene, channel)) for channel in channels]
            kind = "volpath" if media.absorption.any() else "path"
            self._integrator = mi.load_dict({"type": kind, "max_depth": max_depth, "rr_depth": max_depth + 1})
        else:
            from datagen.render.path_integrator import PathTracer

            has_lamps, aims_at_sky = bool(scene.lights), has_small_light(scene.environment)
            self._scene = load_scene_mitsuba(scene, aims_at_sky=aims_at_sky)
            surfaces = [material.surface() if material.medium else NO_GLASS for material in materials]
            self._tracer = PathTracer(
                self._scene,
                media,
                np.array([surface.roughness for surface in surfaces], np.float32),
                np.array([surface.color for surface in surfaces], np.float32),
                max_depth=max_depth,
                has_lamps=has_lamps,
                aims=has_lamps or aims_at_sky,
            )
            if has_lamps:
                from datagen.render.photons import map_caustics

                self._tracer.tables.caustics = map_caustics(self._scene, self._tracer.tables)

    def radiance(self, cameras: Cameras, view: int, *, spp: int, seed: int) -> tuple[np.ndarray, int]:
        """Linear radiance (h, w, 3) float32 and the samples per pixel actually drawn (scalar Mitsuba rounds them)."""
        import mitsuba as mi

        sensor = load_sensor(cameras[view])
        if not is_scalar():
            width, height = cameras.width, cameras.height
            return self._tracer.render(sensor, width=width, height=height, spp=spp, seed=seed), spp
        sensor.sampler().set_sample_count(spp)
        spp = int(sensor.sampler().sample_count())
        images = []
        for scene in self._scenes:
            image = mi.render(scene, sensor=sensor, integrator=self._integrator, spp=spp, seed=mi.UInt32(seed))
            images.append(np.array(image, np.float32))
        if len(images) == 1:
            return images[0], spp
        return np.stack([image[..., channel] for channel, image in enumerate(images)], axis=-1), spp


def _check_walls_scalar(scene: Scene) -> None:
    """Rejects solids with walls so thin that Mitsuba's own path tracer skips them."""
    for item in scene.objects:
        if item.material.medium is None:
            continue
        limit = SCALAR_OFFSET * (1 + largest_coordinate(item.mesh.vertices))
        share, thickness = thin_share(item.mesh, limit)
        if share > MAX_THIN:
            raise HyalineError(
                f"scene {scene.name}: object {item.name}: its walls are {thickness:.2g} m thick, and Mitsuba as "
                f"scalar_rgb needs {limit:.2g} m or more; `datagen doctor` names the libLLVM to install"
            )


def _in_channel(scene: Scene, channel: int | None) -> Scene:
    """The scene with the index of one channel for all colours; unchanged for None."""
    if channel is None:
        return scene
    objects = (
        dataclasses.replace(item, material=item.material.in_channel(channel))
        if isinstance(item.material, Dielectric)
        else item
        for item in scene.objects
    )
    return dataclasses.replace(scene, objects=tuple(objects))


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
    while True:
        while drawn < wanted:
            count = min(_pass_spp(cameras), max(1, (wanted - drawn) // 2))
            real = 0
            for half in range(2):
                seed = derive_seed(view_seed, half, passes)
                image, real = renderer.radiance(cameras, view, spp=count, seed=seed)
                halves[half] += image.astype(np.float64) * real
            drawn += 2 * real
            passes += 1
        truth = _truth(halves[0] * (2 / drawn), halves[1] * (2 / drawn), drawn)
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
    digest = hashlib.sha256("|".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "little")


def view_seed(seed: int, split: Split, view: int) -> int:
    """The seed of one view of a dataset; views are independent of each other and of their order."""
    return derive_seed(seed, split, view, "render")


def picture_bytes(truth: Truth) -> bytes:
    """The 8-bit sRGB PNG."""
    return png_bytes(to_8bit(srgb_from_linear(truth.radiance)))


def radiance_bytes(truth: Truth) -> bytes:
    """The EXR: linear R, G, B and the half difference as noise.R, noise.G, noise.B, all half floats."""
    return encode_exr(truth.radiance, truth.half_difference)


def _pass_spp(cameras: Cameras) -> int:
    return min(MAX_SPP_PER_PASS, max(1, MAX_PATHS_PER_PASS // (cameras.width * cameras.height)))


def _truth(first: Float[np.ndarray, "h w 3"], second: Float[np.ndarray, "h w 3"], spp: int) -> Truth:
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
