"""The network of `light-path`: neural textures where light paths end, composited by the physics of glass."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional

from datagen.data.cameras import Cameras, subpixel_offsets
from datagen.data.dataset import check_has_meshes
from datagen.disk.errors import HyalineError
from datagen.terminal.command import track
from model.batches.rays import LEAST_PAIRED, mean_color, srgb_curve
from model.methods.light_path.config import SKY_HEIGHT, LightPathConfig
from model.methods.light_path.pixels import (
    MANY_RAYS,
    STACKED_VERTICES,
    LightPathBatch,
    LightPathPixels,
    Stack,
    trace_light_paths,
)
from model.methods.light_path.sizes import measure_sizes
from model.methods.protocol import Inputs
from model.methods.renderer import ParameterGroup, PatchTerms, Renderer, pixel_loss
from model.nets.filling import add_visits, fill_in, filled_layout
from model.nets.learned_sky import LearnedSky
from model.nets.pixel_mlp import LEAKY_SLOPE, spherical_harmonics
from model.nets.texture import NeuralTextures, TexturePyramid, level_scales, object_layout
from model.settings import Optimisation

RELIEF_DEPTH = 0.01
"""Metres of depth for a texel's 1 in a learned relief: at the textures' learning rate a step moves it by 0.4 mm."""

STACK_SHIFT = 4.0
"""Subtracted from the stack network's outputs before the softplus, so that they start near black."""

RELIEF_COARSER = 4
"""Width of a relief texel, in texels of the finest colour texture."""


SKY_EPS = 4e-4
"""Adam's epsilon for the sky's coarsest map and its lobes. Directions that are seen in faint reflections alone have
small gradients, mostly noise, which Adam would blow up: at 1e-8, or 1e-5 times a map's weight, the sky of `plant_shelf`
and of the demo is blotched from new sides (docs/notes/history.md)."""

COUNTED_AGAIN = 16
"""One in this many training pixels is traced again to count how often texels were sampled."""


class LightPathRenderer(Renderer[LightPathPixels]):
    """Light paths in, sRGB colours out.

    Radiance = sum over branches of throughput times the radiance at the branch's end (a texel's decoded radiance, or
    the environment), averaged over the pixel's rays in linear light; plus a small non-negative residual from the
    stacked features of the first vertices, for paths that are not traced.

    With straight layers (on proxies) the same decoder shades these, too. Each gets an opacity from its own texel and
    from the stack network, they are composited front to back, and replace a learned share of the paths' radiance.
    """

    def __init__(self, config: LightPathConfig) -> None:
        super().__init__()
        self.config = config
        self.textures = TexturePyramid(
            [
                object_layout([max(2, size >> level) for size in config.texture_sizes for _ in range(config.shells)])
                for level in range(config.texture_levels)
            ],
            config.texture_features,
            finer_counts=config.finer_counts,
        )
        relief_sizes = [max(2, size // RELIEF_COARSER) for size in config.texture_sizes for _ in range(config.shells)]
        self.relief = NeuralTextures(object_layout(relief_sizes), 1) if config.relief else None
        # Feature, cosine, spherical harmonics of the mirrored direction -> linear radiance.
        self.decoder = _Mlp(config.texture_features + 1 + (9 if config.directions else 0), config.hidden, 3)
        # Feature, cosine, spherical harmonics of the ray's direction -> opacity of a straight layer.
        self.cover = _Mlp(config.texture_features + 1 + 9, config.hidden, 1) if config.straight_layers else None
        self.environment = LearnedSky(config.environment_size, config.sky_lobes, config.finer_counts)
        slots = sum(STACKED_VERTICES) + config.straight_layers
        inputs = slots * (config.texture_features + 2) + (3 if config.straight_layers else 0)
        # Colour; opacity of each straight layer; share of the paths.
        outputs = 3 + (config.straight_layers + 1 if config.straight_layers else 0)
        self.stack_net = _Mlp(inputs, config.stack_hidden, outputs) if config.stack_hidden else None

    def forward(self, paths: LightPathBatch, **_: object) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours of the pixels, at least 0."""
        return mean_color(self.radiance(paths))

    def render(self, pixels: LightPathPixels, index: Int[Tensor, " pixel"] | None = None) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours of pixels; those whose rays differ get more rays."""
        return draw_refined(self.radiance, pixels, torch.arange(len(pixels.rgb)) if index is None else index)

    def loss(
        self,
        training: LightPathPixels,
        batch: int,
        rng: np.random.Generator,
        *,
        softness: float = 0.0,
        patch_terms: PatchTerms | None = None,
    ) -> Tensor:
        """The usual loss, minus the bias from the noise of few rays per pixel; the sky learns from squared errors."""
        return pixel_loss(
            self,
            training,
            batch,
            rng,
            softness=softness,
            radiance=self._radiance_apart,
            debias=self.config.debias,
            patch_terms=patch_terms,
        )

    @torch.no_grad()
    def finish(self, training: LightPathPixels, *, batch: int, updates: int, rng: np.random.Generator) -> None:
        """Fills in rarely sampled texels; a share of the training rays is traced again to find them."""
        if not self.config.fill_in:
            return
        layout = filled_layout(self.textures)
        met = torch.zeros(layout.num_texels, device=self.textures.tables()[0].device)
        # Few large parts, as in rendering, take a third of the time; a tracer records a kernel for each size.
        seen = updates * batch
        large = MANY_RAYS // self.config.train_samples
        part = large if seen // COUNTED_AGAIN >= large else batch
        parts = -(-seen // COUNTED_AGAIN // part)
        for _ in track(range(parts), label="fill in", total=parts):
            paths = training.take(torch.from_numpy(rng.integers(len(training.rgb), size=part)), rng)
            ends, stack = paths.ends, paths.stack
            add_visits(met, layout, ends.uv, ends.surface, ends.throughput.mean(dim=1))
            if stack is not None:
                add_visits(met, layout, stack.uv.flatten(0, 1), stack.surface.flatten(), stack.throughput.flatten())
        fill_in(self.textures, met * (seen / (parts * part * self.config.train_samples)))

    def groups(self, optimisation: Optimisation) -> list[ParameterGroup]:
        """The usual groups, but the sky has its own learning rate."""
        net, textures = super().groups(optimisation)
        sky = self.environment
        others = self.all_but([*sky.parameters(), *textures.parameters])
        # A map's gradients are as small as its weight, and fewer rays meet a texel of a finer one: with one epsilon for
        # all, fine maps would hardly learn.
        scales = level_scales(sky.num_maps, sky.finer_counts)
        parts = [*zip(sky.maps, scales, strict=True)]
        if sky.lobes is not None:
            parts += [(value, 1.0) for value in sky.lobes.parameters()]
        return [
            dataclasses.replace(net, parameters=others),
            textures,
            *(
                ParameterGroup(parameters=[part], lr=self.config.sky_lr, eps=SKY_EPS * scale**2)
                for part, scale in parts
            ),
        ]

    def radiance(self, paths: LightPathBatch) -> Float32[Tensor, "pixel sample 3"]:
        """Linear radiance of every ray."""
        others, sky = self._light(paths)
        return others + sky

    def _radiance_apart(
        self, paths: LightPathBatch
    ) -> tuple[Float32[Tensor, "pixel sample 3"], Float32[Tensor, "pixel sample 3"] | None]:
        """`radiance` twice: without gradients of the sky, and with only those.

        Where a pixel has too few rays to measure their noise, `radiance` with all gradients, and None.
        """
        if paths.samples < LEAST_PAIRED:
            return self.radiance(paths), None
        others, sky = self._light(paths)
        return others + sky.detach(), others.detach() + sky

    def _light(
        self, paths: LightPathBatch
    ) -> tuple[Float32[Tensor, "pixel sample 3"], Float32[Tensor, "pixel sample 3"]]:
        """Linear radiance of every ray in two parts: from surfaces and the stack network, and from the sky.

        Straight layers mix the sky into the first part, with its gradients; the second is then zero.
        """
        num_rays, ends = paths.num_pixels * paths.samples, paths.ends
        at_ends, at_stack = self._features(paths)
        dark = torch.zeros(num_rays, 3, device=ends.uv.device)
        others = dark.index_add(0, ends.ray, self._decode(at_ends, ends.cosine, ends.reflected) * ends.throughput)
        sky = dark.index_add(0, paths.sky.ray, self.environment(paths.sky.direction) * paths.sky.throughput)
        if at_stack is not None:
            assert paths.stack is not None
            assert self.stack_net is not None
            stack = paths.stack
            inputs = torch.cat([at_stack, stack.throughput[..., None], stack.cosine[..., None]], dim=-1).flatten(1)
            if self.config.straight_layers:
                inputs = torch.cat([inputs, stack.direction], dim=-1)
            out = self.stack_net(inputs)
            if self.config.straight_layers:
                share = torch.sigmoid(out[:, 3:4])
                others = share * (others + sky) + (1 - share) * self._over(stack, at_stack, out[:, 4:])
                sky = dark
            others = others + functional.softplus(out[:, :3] - STACK_SHIFT)
        return others.view(-1, paths.samples, 3), sky.view(-1, paths.samples, 3)

    def _features(self, paths: LightPathBatch) -> tuple[Float32[Tensor, "end c"], Float32[Tensor, "ray slot c"] | None]:
        """Texture features at the ends, and in the stack where the configuration has one.

        They share one look-up, because each look-up makes a gradient as large as the textures.
        """
        ends = paths.ends
        uv = ends.uv
        if self.relief is not None:
            assert ends.uv_slope is not None
            uv = self._shifted(uv[:, None], ends.surface[:, None], ends.uv_slope[:, None])[:, 0]
        slots = [(uv, ends.surface)]
        stack = paths.stack if self.stack_net is not None else None
        if stack is not None:
            slots.append((self._relieved(stack).flatten(0, 1), stack.surface.flatten()))
        uv, surface = (torch.cat(parts)[:, None] for parts in zip(*slots, strict=True))
        parts = self.textures(uv, surface)[:, 0].split([len(surface) for _, surface in slots])
        return parts[0], None if stack is None else parts[1].unflatten(0, stack.surface.shape)

    def _relieved(self, stack: Stack) -> Float32[Tensor, "ray slot 2"]:
        """The stack's texture coordinates; only those of straight layers are shifted by the relief."""
        if self.relief is None or stack.uv_slope is None:
            return stack.uv
        first = sum(STACKED_VERTICES)
        straight = self._shifted(stack.uv[:, first:], stack.surface[:, first:], stack.uv_slope)
        return torch.cat([stack.uv[:, :first], straight], dim=1)

    def _shifted(
        self,
        uv: Float32[Tensor, "ray slot 2"],
        surface: UInt8[Tensor, "ray slot"],
        uv_slope: Float32[Tensor, "ray slot 2"],
    ) -> Float32[Tensor, "ray slot 2"]:
        """The uv at which the rays meet the learned relief below (or above) the surfaces."""
        assert self.relief is not None
        return (uv + RELIEF_DEPTH * self.relief(uv, surface) * uv_slope).clamp(0, 1)

    def _over(self, stack: Stack, features: Tensor, opacity_logits: Float32[Tensor, "ray straight"]) -> Tensor:
        """Linear radiance of the straight layers, composited front to back over the sky."""
        first = sum(STACKED_VERTICES)
        hits = (stack.surface[:, first:] > 0).nonzero(as_tuple=True)
        behind = (hits[0], hits[1] + first)
        assert stack.reflected is not None
        shine = self._decode(features[behind], stack.cosine[behind], stack.reflected[hits])
        # A layer's opacity has a term of its own and one from the whole stack.
        assert self.cover is not None
        turned = spherical_harmonics(stack.direction)[hits[0]]
        own = self.cover(torch.cat([features[behind], stack.cosine[behind][:, None], turned], dim=-1))[:, 0]
        opacity = torch.sigmoid(opacity_logits.index_put(hits, own, accumulate=True))
        opacity = opacity * (stack.surface[:, first:] > 0)
        passed = torch.cumprod(1 - opacity, dim=1)
        before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)
        sky = self.environment(stack.direction) * passed[:, -1:]
        return sky.index_add(0, hits[0], shine * (opacity * before)[hits][:, None])

    def _decode(self, features: Tensor, cosine: Tensor, reflected: Tensor | None) -> Float32[Tensor, "end 3"]:
        inputs = [features, cosine[:, None]]
        if self.config.directions:
            assert reflected is not None
            inputs.append(spherical_harmonics(reflected))
        # The first features are added as colour: a texel learns its own at once, the decoder what depends on the view.
        return functional.softplus(self.decoder(torch.cat(inputs, dim=-1)) + features[:, :3])


class _Mlp(nn.Sequential):
    """Linear layers with a LeakyReLU between each two of them."""

    def __init__(self, num_inputs: int, hidden: int, num_outputs: int) -> None:
        super().__init__(
            nn.Linear(num_inputs, hidden),
            nn.LeakyReLU(LEAKY_SLOPE, inplace=True),
            nn.Linear(hidden, hidden),
            nn.LeakyReLU(LEAKY_SLOPE, inplace=True),
            nn.Linear(hidden, num_outputs),
        )


MOST_DOUBT = 2.5 / 255
"""Standard error of a pixel's sRGB colour above which it gets more rays. Held-out training views of the glass table
gain 0.05 dB above 2 / 255, in 1.5 times the time, and 0.07 with 272 rays for all pixels, in 2.8 (notes/speed.md)."""

ROUND_NUMBER = 256
"""Batches of pixels are padded to a multiple of this: a tracer records a kernel for each number of rays."""


def draw_refined(
    radiance_of: Callable[[LightPathBatch], Float32[Tensor, "pixel sample 3"]],
    pixels: LightPathPixels,
    index: Int[Tensor, " pixel"],
) -> Float32[Tensor, "pixel 3"]:
    """sRGB colours of the pixels with these row numbers: `render_samples` rays each, `refined_samples` more for those
    whose rays differ, and four times as many again where these differ, too."""
    mean = torch.zeros(len(index), 3, device=pixels.rgb.device)
    again, drawn = torch.arange(len(index)), 0
    for samples in pixels.config.passes:
        # Dr.Jit 1.5 aborts the process when it traces no rays, and an empty tensor splits into one empty part.
        if not len(again):
            break
        source, doubts, drawn = pixels.with_rays(samples), [], drawn + samples
        for part in again.split(source.chunk):
            filled = torch.cat([part, part[:1].expand(-len(part) % ROUND_NUMBER)])
            radiance = radiance_of(source.take(index[filled], None))[: len(part)]
            mean[part] = torch.lerp(mean[part], radiance.mean(dim=1), samples / drawn)
            doubts.append(is_doubtful(radiance).cpu())
        again = again[torch.cat(doubts)]
    return srgb_curve(mean)


def is_doubtful(radiance: Float32[Tensor, "pixel sample 3"]) -> Bool[Tensor, " pixel"]:
    """True where the standard error of the mean over a pixel's rays exceeds `MOST_DOUBT` in any channel.

    The rays lie on a grid, whose mean is exact where radiance changes linearly over the pixel. So only deviations from
    the best-fitting plane count as error.
    """
    samples = radiance.shape[1]
    if samples == 1:
        return torch.zeros(len(radiance), dtype=torch.bool, device=radiance.device)
    mean = radiance.mean(dim=1)
    off_plane = torch.einsum("rs,psc->prc", _off_plane(samples, radiance.device), radiance)
    error = torch.linalg.vector_norm(off_plane, dim=1) / ((samples - 3) * samples) ** 0.5
    # Colours beyond white clip, so noise there does not matter.
    most, least = (srgb_curve(value.clamp_min(0)).clamp_max(1) for value in (mean + error, mean - error))
    return ((most - least) / 2 > MOST_DOUBT).any(dim=1)


@functools.cache
def _off_plane(samples: int, device: torch.device) -> Float32[Tensor, "sample sample"]:
    """The matrix that subtracts the best-fitting plane from values on a pixel's grid of rays."""
    plane = np.column_stack([np.ones(samples), subpixel_offsets(samples)])
    with torch.inference_mode(False):
        return torch.from_numpy(np.eye(samples) - plane @ np.linalg.pinv(plane)).float().to(device)


def complete(config: LightPathConfig, inputs: Inputs) -> LightPathConfig:
    """The same with the sky's height and the objects' texture sizes, which depend on traced paths."""
    dataset = inputs.dataset
    check_has_meshes(dataset)
    usual = LightPathConfig().usual(inputs.geometry).sized((2,) * len(dataset.objects))
    training = trace_light_paths(usual, dataset, inputs.geometry, dataset.cameras("train"))
    size = config.texture_size or dataset.config.resolution.mean_side
    widths, height = measure_sizes(training, size)
    if config.environment_size == SKY_HEIGHT:
        config = dataclasses.replace(config, environment_size=height)
    return config.sized(widths)


def build(config: LightPathConfig, inputs: Inputs) -> LightPathRenderer:
    sizes, objects = config.texture_sizes, inputs.dataset.objects
    if len(sizes) != len(objects):
        raise HyalineError(f"texture_sizes: are {len(sizes)}; expected one for each of {len(objects)} objects")
    return LightPathRenderer(config)


def load_cameras(config: LightPathConfig, inputs: Inputs, cameras: Cameras) -> LightPathPixels:
    return trace_light_paths(config, inputs.dataset, inputs.geometry, cameras)
