"""Owns the method `light-path`: neural textures where light paths end, composited by the physics of glass."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional

from datagen.dataset import Dataset
from datagen.errors import HyalineError
from datagen.geometry import TRUTH
from model.choices import LightPathChoices
from model.extrinsics import spherical_harmonics
from model.fused_mlp import ChainLayer, can_fuse, run_chain
from model.learned_sky import LearnedSky
from model.pixel_mlp import LEAKY_SLOPE
from model.samples import check_samples, srgb_curve
from model.texture import FINER_COUNTS, NeuralTextures, TexturePyramid, object_layout

STACKED_VERTICES = (4, 2)
"""Vertices of the refracted and of the first mirror branch that the stack network sees."""

RELIEF_DEPTH = 0.01
"""Metres of depth for a texel's 1 in a learned relief: at the textures' learning rate a step moves it by 0.4 mm."""

RELIEF_COARSER = 4
"""How many times wider a texel of the relief is than the finest one of colour."""

SKY_LOBES = 12
"""Lobes of the learned sky unless told otherwise."""

MAX_SURFACES = 255
"""Ids of surfaces are bytes, and 0 is the empty one."""


@dataclass(frozen=True, kw_only=True)
class LightPathConfig:
    """What our renderer is made of."""

    texture_sizes: tuple[int, ...]
    """Width and height of each object's texture in texels."""
    texture_features: int = 8
    """Channels of a texture; the paper's 16 do no better and take twice the memory."""
    texture_levels: int = 5
    """Textures summed, each half as wide as the one before: what few rays have met is filled in from around it."""
    hidden: int = 128
    """Units of the decoder's two hidden layers. 64 score 0.3 / 0.6 dB less (400 steps of 1,024 pixels, one seed)."""
    position_octaves: int = 0
    """Octaves of the sines and cosines of a path end's position that the decoder is told."""
    composite: bool = True
    """Paths are composited by physics; else the stack network alone makes the colour."""
    stack_hidden: int = 32
    """Units of the stack network's two hidden layers; 0 leaves it out."""
    straight_layers: int = 0
    """Straight layers that the stack network sees beside the paths, for proxies."""
    shells: int = 1
    """Copies of each surface, one inside the other, that straight layers meet: copy k of n is 1 - k / n as large as the
    proxy and has a texture of its own, so that there are layers near what lies inside of a coarse proxy. Source:
    layered semi-transparent meshes (Volumetric Surfaces, 2024), there fitted to the truth."""
    relief: bool = False
    """Surfaces learn how deep below them the true ones lie, and colour is looked up where the ray meets those, to first
    order. Source: relief mapping (Policarpo et al. 2005), with learned depths."""
    environment_size: int = 32
    """Height in texels of the finest of the learned latitude-longitude maps that sum to the light from outside. It is
    twice as wide; the others are halved down to a single colour: directions in which no training ray left are filled in
    from around them, as texels are."""
    sky_lobes: int = 0
    """Spherical Gaussians that the learned sky has besides its maps; runs from before there were any have none."""
    branches: int = 12
    """Branches traced for each ray: refracted, first mirror, further ones."""
    train_samples: int = 4
    """Rays per pixel while training, a square number."""
    render_samples: int = 16
    """Rays per pixel while rendering, a square number."""
    refined_samples: int = 64
    """Rays per pixel while rendering pixels whose rays differ (rough metal, edges, glass), a square number. Where it is
    no more than `render_samples`, none are drawn anew."""

    def __post_init__(self) -> None:
        if not self.texture_sizes or min(self.texture_sizes) < 2:
            raise HyalineError(f"texture_sizes: are {self.texture_sizes}; expected at least 2 texels for each object")
        if not self.composite and not self.stack_hidden:
            raise HyalineError("compositing: is stack, but the stack network has no units; expected --stack above 0")
        for name in ("texture_features", "texture_levels", "hidden", "shells", "environment_size", "branches"):
            if getattr(self, name) < 1:
                raise HyalineError(f"{name}: is {getattr(self, name)}; expected at least 1")
        if self.shells * len(self.texture_sizes) > MAX_SURFACES:
            raise HyalineError(
                f"shells: is {self.shells} for {len(self.texture_sizes)} objects; expected at most 255 copies"
            )
        if self.sky_lobes < 0:
            raise HyalineError(f"sky_lobes: is {self.sky_lobes}; expected at least 0")
        for name in ("train_samples", "render_samples", "refined_samples"):
            check_samples(name, getattr(self, name))


def default_light_path(texture_sizes: tuple[int, ...], *, is_proxy: bool) -> LightPathConfig:
    """What `model train --method light-path` builds unless told otherwise.

    Paths through a proxy mislead where its surface is off. There the stack network sees the straight layers, too, those
    of nested shells among them, gives each an opacity, and mixes what they show with what the paths show.
    """
    if is_proxy:
        shells = max(1, min(4, MAX_SURFACES // len(texture_sizes)))
        return LightPathConfig(
            texture_sizes=texture_sizes,
            stack_hidden=96,
            straight_layers=24,
            shells=shells,
            relief=True,
            sky_lobes=SKY_LOBES,
        )
    return LightPathConfig(texture_sizes=texture_sizes, sky_lobes=SKY_LOBES)


def configure_light_path(
    choices: LightPathChoices,
    dataset: Dataset,
    geometry: str,
    num_layers: int,  # noqa: ARG001
) -> LightPathConfig:
    """The configuration that a user's choices make on a dataset; paths are traced to see how texels are shared.

    Raises:
        HyalineError: a choice that cannot be.
    """
    from model.traced_batches import share_texels  # It imports this file.

    sizes = share_texels(dataset, geometry, choices.texture_size or dataset.config.resolution)
    known = default_light_path(sizes, is_proxy=geometry != TRUTH)
    refined = choices.refined_rays
    if refined is None:  # Who asks for a number of rays gets that many.
        refined = known.refined_samples if choices.render_rays is None else choices.render_rays
    return dataclasses.replace(
        known,
        texture_levels=choices.texture_levels,
        position_octaves=choices.position_octaves,
        composite=choices.compositing == "physics",
        stack_hidden=known.stack_hidden if choices.stack is None else choices.stack,
        straight_layers=known.straight_layers if choices.straight_layers is None else choices.straight_layers,
        shells=known.shells if choices.shells is None else choices.shells,
        relief=known.relief if choices.relief is None else choices.relief == "on",
        environment_size=choices.environment,
        sky_lobes=0 if choices.environment == 1 else choices.sky_lobes,
        branches=choices.branches,
        train_samples=known.train_samples if choices.rays is None else choices.rays,
        render_samples=known.render_samples if choices.render_rays is None else choices.render_rays,
        refined_samples=refined,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Ends:
    """The opaque vertices on which branches end."""

    ray: Int[Tensor, " end"]
    """The ray that each belongs to; a ray has as many as branches that end on a surface."""
    surface: UInt8[Tensor, " end"]
    """Whose texture it looks up: shell k of n of object i is surface (i - 1) n + k + 1. Paths meet the outermost."""
    uv: Float32[Tensor, "end 2"]
    position: Float32[Tensor, "end 3"]
    throughput: Float32[Tensor, "end 3"]
    cosine: Float32[Tensor, " end"]
    """Of the angle between the arriving ray and the surface's normal, 0 to 1."""
    reflected: Float32[Tensor, "end 3"]
    """The arriving direction, mirrored at the surface."""
    uv_slope: Float32[Tensor, "end 2"]
    """Change of uv for every metre of depth below the surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sky:
    """The branches that leave the scene."""

    ray: Int[Tensor, " exit"]
    direction: Float32[Tensor, "exit 3"]
    throughput: Float32[Tensor, "exit 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Stack:
    """The first vertices of each ray's paths, then its straight layers."""

    surface: UInt8[Tensor, "ray slot"]
    """As of `Ends`, of every shell; 0 where there is no vertex."""
    uv: Float32[Tensor, "ray slot 2"]
    throughput: Float32[Tensor, "ray slot"]
    """Mean over the colour channels."""
    cosine: Float32[Tensor, "ray slot"]
    direction: Float32[Tensor, "ray 3"]
    """Of the camera's ray."""
    position: Float32[Tensor, "ray straight 3"] | None
    """Of each straight layer; None without straight layers."""
    reflected: Float32[Tensor, "ray straight 3"] | None
    """The ray's direction, mirrored at the surface of each straight layer."""
    uv_slope: Float32[Tensor, "ray straight 2"] | None
    """Change of uv for every metre of depth below the surface of each straight layer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPathBatch:
    """The light paths of some pixels: `samples` rays for each, pixel by pixel."""

    num_pixels: int
    samples: int
    ends: Ends
    sky: Sky
    stack: Stack | None


class LightPathRenderer(nn.Module):
    """Light paths in, sRGB colours out.

    Radiance = sum over branches of throughput times what shines at the branch's end (a texel's decoded radiance, or
    the environment), averaged over the pixel's rays in linear light; plus a small non-negative residual from the
    stacked features of the first vertices, for the paths that are not traced. Edits stay valid: what is removed from
    the scene is no vertex of any path.

    With straight layers (on proxies) the same decoder shades these, too, each gets an opacity from its own texel and
    from the stack network, they are laid over each other, and a learned share of the paths' radiance is replaced.
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
            finer_counts=FINER_COUNTS,
        )
        relief_sizes = [max(2, size // RELIEF_COARSER) for size in config.texture_sizes for _ in range(config.shells)]
        self.relief = NeuralTextures(object_layout(relief_sizes), 1) if config.relief else None
        if config.composite:
            # Feature, cosine, spherical harmonics of the mirrored direction, position -> linear radiance.
            self.decoder = _Mlp(config.texture_features + 1 + 9 + 6 * config.position_octaves, config.hidden, 3)
            # Feature, cosine, spherical harmonics of the ray's direction -> opacity of a straight layer.
            self.cover = _Mlp(config.texture_features + 1 + 9, config.hidden, 1) if config.straight_layers else None
            self.environment = LearnedSky(config.environment_size, config.sky_lobes)
        slots = sum(STACKED_VERTICES) + config.straight_layers
        inputs = slots * (config.texture_features + 2) + (3 if config.straight_layers else 0)
        # Colour; opacity of each straight layer; share of the paths.
        outputs = 3 + (config.straight_layers + 1 if config.straight_layers else 0)
        self.stack_net = _Mlp(inputs, config.stack_hidden, outputs) if config.stack_hidden else None

    def forward(self, paths: LightPathBatch, **_: object) -> Float32[Tensor, "pixel 3"]:
        """sRGB colours of the pixels, at least 0."""
        return srgb_curve(self.radiance(paths).mean(dim=1))

    def radiance(self, paths: LightPathBatch) -> Float32[Tensor, "pixel sample 3"]:
        """Linear radiance of every ray."""
        num_rays = paths.num_pixels * paths.samples
        radiance = torch.zeros(num_rays, 3, device=paths.ends.uv.device)
        if self.config.composite:
            radiance = radiance.index_add(0, paths.ends.ray, self._shine(paths.ends) * paths.ends.throughput)
            radiance = radiance.index_add(
                0, paths.sky.ray, self.environment(paths.sky.direction) * paths.sky.throughput
            )
        if self.stack_net is not None:
            assert paths.stack is not None
            stack = paths.stack
            uv = self._relieved(stack)
            features = self.textures(uv, stack.surface)
            inputs = torch.cat([features, stack.throughput[..., None], stack.cosine[..., None]], dim=-1).flatten(1)
            if self.config.straight_layers:
                inputs = torch.cat([inputs, stack.direction], dim=-1)
            out = self.stack_net(inputs)
            if self.config.straight_layers and self.config.composite:
                share = torch.sigmoid(out[:, 3:4])
                radiance = share * radiance + (1 - share) * self._over(stack, features, out[:, 4:])
            radiance = radiance + functional.softplus(out[:, :3] - (4 if self.config.composite else 1))
        return radiance.view(-1, paths.samples, 3)

    def _relieved(self, stack: Stack) -> Float32[Tensor, "ray slot 2"]:
        """Where the stack looks up its textures: only its straight layers, which pass on, are shifted."""
        if self.relief is None or stack.uv_slope is None:
            return stack.uv
        first = sum(STACKED_VERTICES)
        straight = self._shifted(stack.uv[:, first:], stack.surface[:, first:], stack.uv_slope)
        return torch.cat([stack.uv[:, :first], straight], dim=1)

    def _shifted(
        self, uv: Float32[Tensor, "ray slot 2"], surface: UInt8[Tensor, "ray slot"],
        uv_slope: Float32[Tensor, "ray slot 2"],
    ) -> Float32[Tensor, "ray slot 2"]:  # fmt: skip
        """Where the rays meet the learned relief below (or above) the surfaces."""
        if self.relief is None:
            return uv
        return (uv + RELIEF_DEPTH * self.relief(uv, surface) * uv_slope).clamp(0, 1)

    def _over(self, stack: Stack, features: Tensor, opacity_logits: Float32[Tensor, "ray straight"]) -> Tensor:
        """Linear radiance of the straight layers, each laid over those behind it, and of the sky behind all."""
        first = sum(STACKED_VERTICES)
        hits = (stack.surface[:, first:] > 0).nonzero(as_tuple=True)
        behind = (hits[0], hits[1] + first)
        assert stack.position is not None
        assert stack.reflected is not None
        shine = self._decode(features[behind], stack.cosine[behind], stack.reflected[hits], stack.position[hits])
        # What the layer itself says of its opacity, and what the whole stack says.
        assert self.cover is not None
        turned = spherical_harmonics(stack.direction)[hits[0]]
        own = self.cover(torch.cat([features[behind], stack.cosine[behind][:, None], turned], dim=-1))[:, 0]
        opacity = torch.sigmoid(opacity_logits.index_put(hits, own, accumulate=True))
        opacity = opacity * (stack.surface[:, first:] > 0)
        passed = torch.cumprod(1 - opacity, dim=1)
        before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)
        sky = self.environment(stack.direction) * passed[:, -1:]
        return sky.index_add(0, hits[0], shine * (opacity * before)[hits][:, None])

    def _shine(self, ends: Ends) -> Float32[Tensor, "end 3"]:
        """Linear radiance that leaves the ends towards their rays."""
        uv = self._shifted(ends.uv[:, None], ends.surface[:, None], ends.uv_slope[:, None])
        features = self.textures(uv, ends.surface[:, None])[:, 0]
        return self._decode(features, ends.cosine, ends.reflected, ends.position)

    def _decode(
        self, features: Tensor, cosine: Tensor, reflected: Tensor, position: Tensor
    ) -> Float32[Tensor, "end 3"]:
        inputs = [features, cosine[:, None], spherical_harmonics(reflected)]
        for octave in range(self.config.position_octaves):
            angle = position * (torch.pi * 2**octave)
            inputs += [torch.sin(angle), torch.cos(angle)]
        # The first features are colour: a texel learns its own at once, and the decoder what depends on the view.
        return functional.softplus(self.decoder(torch.cat(inputs, dim=-1)) + features[:, :3])


def build_light_path(config: LightPathConfig, dataset: Dataset, geometry: str, num_layers: int) -> LightPathRenderer:  # noqa: ARG001
    """A fresh renderer for a dataset; its random start is drawn from torch's default generator.

    Raises:
        HyalineError: the configuration is of a scene with another number of objects.
    """
    if len(config.texture_sizes) != len(dataset.objects):
        raise HyalineError(
            f"texture_sizes: are {len(config.texture_sizes)}; expected one for each of {len(dataset.objects)} objects"
        )
    return LightPathRenderer(config)


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

    def forward(self, input: Float32[Tensor, "row c_in"]) -> Float32[Tensor, "row c_out"]:  # noqa: A002  (torch's name)
        if not can_fuse(input):
            return super().forward(input)
        *others, last = [layer for layer in self if isinstance(layer, nn.Linear)]
        return run_chain(
            input, [*(ChainLayer(linear=layer, slope=LEAKY_SLOPE) for layer in others), ChainLayer(linear=last)]
        )
