"""The textures of the room, and drawing through glass that changes in front of them."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int
from torch import Tensor

from datagen.data.dataset import Dataset
from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene
from datagen.scene.materials import Material
from datagen.terminal.command import track
from datagen.trace.surface_tables import LIMITS, Limits
from hyaline_photos.fit.search import Misses, penalty
from hyaline_photos.fit.shapes import Glass
from model.batches.rays import linear_curve, read_colors, srgb_curve
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import LightPathBatch, LightPathPixels
from model.methods.light_path.sizes import measure_sizes
from model.nets.filling import add_visits, filled_layout
from model.nets.learned_sky import LearnedSky
from model.nets.texture import TextureLayout, bilinear_taps
from model.run.optimizer import make_optimizer
from model.settings import decay
from model.state import State

BATCH = 1024
"""Training pixels per step; rays and branches are those of `light-path`."""
RAYS = 9
"""A pixel, while glass is drawn; with 4 its error is larger than that of a wall which is a tenth off."""
FROSTED_RAYS = 36
"""The same for frosted glass, which scatters them: with 9, a loss was least for 0.12 where the truth is 0.2."""
COARSE_ROUNDS = 3
"""Rounds of a search before light is followed as far as `FINE`."""
FINE = LIMITS._replace(max_branches=12, makes_up=True)
"""How far light is followed in a search's last rounds. True vessels are then 0.002 too dark (sRGB), solids are not."""
COARSE = FINE._replace(max_branches=8, min_throughput=1 / 64)
"""The same before. It takes half as long, but what is not followed is brighter than the rest where bright walls or sky
are mirrored: true vessels are 0.012 too dark, and a higher index makes up for it."""
SKY_LEVEL = 1
"""The map of the sky whose texels are counted; in the finest, level 0, noise leaves gaps."""
ENOUGH = 1.0
"""Visits after which a texel counts as half known."""
STEEPNESS = 4
"""Exponent of a pixel's weight. True glass (the bottle of random-7104), drawn through textures that never saw glass,
has a loss of 0.006 where more than 95 % of a pixel's light is known, 0.02 at 85 %, and 0.07 below 60 %."""
COUNTED_BRANCHES = 4
JUDGED, NAMED = 400, 5
"""Pixels of a picture that tell how well the room shows it, and how many of the worst pictures are named."""
LEAST_TRUST = 1e-6
"""Weight of every pixel, so that all count alike where pictures show nothing beside the glass."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SomePixels(LightPathPixels):
    """Some of the pixels of a source, as a source of their own."""

    rows: Int[Tensor, " pixel"]
    """Places in the source of the pixels of `rgb`."""

    def take(self, index: Int[Tensor, "*pixel"], rng: np.random.Generator | None) -> LightPathBatch:
        return super().take(self.rows[index], rng)


def load_pixels(
    dataset: Dataset, scene: Scene, meshes: tuple[Mesh, ...], materials: tuple[Material, ...], limits: Limits
) -> LightPathPixels:
    """Loads the training views' pixels over a scene with these meshes and materials.

    The stack network is off because it would learn to hide wrong glass: with it, an index of 1.50 was found as 1.465.
    """
    use_mitsuba()
    from datagen.trace.light_path import LightPathTracer
    from datagen.trace.surface_tables import tints_of

    views = range(dataset.config.train.views)
    config = LightPathConfig(stack_hidden=0, branches=limits.max_branches)
    return LightPathPixels(
        tracer=LightPathTracer(meshes, materials, tints_of(scene, own_uv=True)),
        straight_tracer=None,
        cameras=dataset.cameras("train"),
        num_objects=len(meshes),
        rgb=read_colors(dataset, "train", views),
        limits=limits,
        config=config.sized((2,) * len(meshes)),
    )


def learn(
    pixels: LightPathPixels,
    rows: Int[np.ndarray, " pixel"],
    sky: Int[np.ndarray, " sky"],
    directions: Float32[np.ndarray, "sky 3"],
    steps: int,
    *,
    seed: int,
) -> LightPathRenderer:
    """Learns textures and sky from some of the pixels; the sky starts from what is seen of it.

    Args:
        sky: pixels that show the sky and nothing else.
        directions: of these.
    """
    torch.manual_seed(seed)
    widths, height = measure_sizes(pixels, pixels.resolution.mean_side)
    renderer = LightPathRenderer(dataclasses.replace(pixels.config, texture_sizes=widths, environment_size=height))
    if len(sky):
        colors = linear_curve(pixels.rgb[torch.from_numpy(sky)].float() / 255)
        renderer.environment.start_from(torch.from_numpy(directions), colors)
    optimisation = pixels.config.optimisation()
    groups = renderer.groups(optimisation)
    optimizer = make_optimizer(groups, beta1=optimisation.beta1)
    chosen = torch.from_numpy(rows)
    source = SomePixels(**{**vars(pixels), "rgb": pixels.rgb[chosen]}, rows=chosen)
    for step in track(range(steps), label="textures", total=steps):
        loss = renderer.loss(source, BATCH, np.random.default_rng((seed, step)), softness=optimisation.loss.softness)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        factor = decay(optimisation.lr_decay, step / steps)
        for slot, group in zip(optimizer.param_groups, groups, strict=True):
            slot["lr"] = group.lr * factor
        optimizer.step()
    return renderer.eval()


@dataclass(frozen=True, kw_only=True, eq=False)
class Visits:
    """Visits by some pixels, in whole pixels (`add_visits`)."""

    layout: TextureLayout
    texels: Float32[Tensor, " texel"]
    """Visits of the room's texels."""
    environment: LearnedSky
    directions: Float32[Tensor, " direction"]
    """Visits of the texels of the sky's map `SKY_LEVEL`."""

    def trust(self, paths: LightPathBatch) -> Float32[Tensor, " pixel"]:
        """Weights of pixels: 1 where all light comes from well-known places, 0 where none does."""
        ends, sky = paths.ends, paths.sky
        texels, shares = bilinear_taps(ends.uv, ends.surface, self.layout)
        at_sky = self.environment.texels_at(SKY_LEVEL, sky.direction)
        visits = torch.cat([(self.texels[texels] * shares).sum(dim=1), self.directions[at_sky]])
        light = torch.cat([ends.throughput, sky.throughput]).mean(dim=1)
        pixel = torch.cat([ends.ray, sky.ray]) // paths.samples
        known, total = (
            torch.zeros(paths.num_pixels).index_add(0, pixel, part)
            for part in (light * visits / (visits + ENOUGH), light)
        )
        return (known / total.clamp_min(1e-6)) ** STEEPNESS


@torch.no_grad()
def count_visits(renderer: LightPathRenderer, pixels: LightPathPixels, rows: Int[np.ndarray, " pixel"]) -> Visits:
    """Counts visits by these pixels, a ray each."""
    config = dataclasses.replace(pixels.config, render_samples=1, branches=COUNTED_BRANCHES)
    single = dataclasses.replace(pixels, config=config)
    layout, environment = filled_layout(renderer.textures), renderer.environment
    texels = torch.zeros(layout.num_texels)
    directions = torch.zeros(environment.maps[SKY_LEVEL][0].numel())
    for part in torch.from_numpy(rows).split(single.chunk):
        paths = single.take(part, None)
        add_visits(texels, layout, paths.ends.uv, paths.ends.surface, paths.ends.throughput.mean(dim=1))
        at_sky = environment.texels_at(SKY_LEVEL, paths.sky.direction)
        directions.index_add_(0, at_sky, paths.sky.throughput.mean(dim=1).square())
    return Visits(layout=layout, texels=texels, environment=environment, directions=directions)


@dataclass(frozen=True, kw_only=True, eq=False)
class Room:
    """Learned textures, and training pixels that are drawn with them while glass changes."""

    renderer: LightPathRenderer
    pixels: LightPathPixels
    visits: Visits
    """By pixels beside unknown glass."""

    def put(self, object_ids: Sequence[int], glass: Glass) -> None:
        """Replaces objects by a glass and its drink; vertex counts must match."""
        self.pixels.tracer.change({each - 1: body for each, body in glass.bodies(object_ids).items()})

    def draw(self, rows: Int[np.ndarray, " pixel"], samples: int = RAYS) -> Float32[np.ndarray, "pixel 3"]:
        """sRGB colours of some pixels, in [0, 1], by this number of rays each."""
        pixels = dataclasses.replace(
            self.pixels, config=dataclasses.replace(self.pixels.config, render_samples=samples)
        )
        parts = torch.from_numpy(rows).split(pixels.chunk)
        with torch.inference_mode():
            rays = [self.renderer.radiance(pixels.take(part, None)) for part in parts]
            return torch.cat([srgb_curve(part.mean(dim=1)).clamp(0, 1) for part in rays]).numpy()

    def decibels(self, is_beside: Bool[np.ndarray, "view h w"]) -> Float64[np.ndarray, " view"]:
        """PSNR of `JUDGED` pixels beside the glass in each training picture; infinite where it has none."""
        found, rng = np.full(len(is_beside), np.inf), np.random.default_rng(0)
        for view, flat in enumerate(is_beside.reshape(len(is_beside), -1)):
            rows = view * flat.size + rng.permutation(np.flatnonzero(flat))[:JUDGED]
            if len(rows):
                truth = self.pixels.rgb[torch.from_numpy(rows)].numpy() / np.float32(255)
                found[view] = -10 * np.log10(max(np.mean((self.draw(rows) - truth) ** 2), 1e-10))
        return found

    def misses(self, object_ids: Sequence[int], rows: Int[np.ndarray, " pixel"], guesses: Sequence[Glass]) -> Misses:
        """The loss of some pixels as a function of the glass that replaces these objects.

        Pixels count less, the less is known of where their light comes from through some guesses of the glass.
        """
        truth = self.pixels.rgb[torch.from_numpy(rows)].numpy() / np.float32(255)
        trust = np.ones(len(rows), np.float32)
        for glass in guesses:
            self.put(object_ids, glass)
            parts = torch.from_numpy(rows).split(self.pixels.chunk)
            trust *= torch.cat([self.visits.trust(self.pixels.take(part, None)) for part in parts]).numpy()
        weights = trust ** (1 / len(guesses)) + LEAST_TRUST
        weights /= weights.mean()

        def miss(glass: Glass) -> Float32[np.ndarray, "pixel 3"]:
            self.put(object_ids, glass)
            drawn = self.draw(rows, FROSTED_RAYS if "roughness" in glass.numbers else RAYS)
            return weights[:, None] * penalty(drawn - truth)

        return miss


def in_words(decibels: Float64[np.ndarray, " view"]) -> str:
    """How well a room shows the training pictures, and which of them worst."""
    worst = ", ".join(f"train/{view:04d} ({decibels[view]:.1f})" for view in np.argsort(decibels)[:NAMED])
    return f"{np.median(decibels):.1f} dB beside the glass of pictures (median); least in {worst}"


def room_state(renderer: LightPathRenderer) -> dict[str, State]:
    """The state that `load_room` reads."""
    return {"weights": renderer.state_dict(), "texture_sizes": list(renderer.config.texture_sizes)}


def load_room(state: dict[str, State], pixels: LightPathPixels, beside: Int[np.ndarray, " pixel"]) -> Room:
    """Learned textures with pixels to draw, each by `RAYS`.

    Args:
        beside: the pixels beside unknown glass.
    """
    weights = cast(dict[str, Tensor], state["weights"])
    config = dataclasses.replace(
        pixels.config,
        texture_sizes=tuple(cast(list[int], state["texture_sizes"])),
        environment_size=weights["environment.0"].shape[1],
    )
    renderer = LightPathRenderer(config)
    renderer.load_state_dict(weights)
    drawn = dataclasses.replace(config, render_samples=RAYS)
    visits = count_visits(renderer, pixels, beside)
    return Room(renderer=renderer.eval(), pixels=dataclasses.replace(pixels, config=drawn), visits=visits)
