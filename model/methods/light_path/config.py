"""Configuration of the method `light-path`."""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, Self

from datagen.data.paths import follows_light
from datagen.disk.errors import HyalineError
from model.methods.protocol import MethodConfig
from model.settings import (
    RATE,
    SHARE,
    LossConfig,
    PixelOptimisation,
    check_samples,
    check_texels,
    choice,
    unflagged,
)

MAX_SURFACES = 255
"""Surface ids are bytes, and 0 means empty."""


SKY_HEIGHT, MAX_SKY_HEIGHT = 32, 256
"""Default height in texels of the learned sky's finest map, and its limit where pixels see the sky finer."""

FINER_COUNTS = 0.7
"""Weight of a level of a pyramid, of textures or of the sky, relative to the next coarser one. Adam moves all texels at
the same speed, so coarse ones learn first, and fine ones add the rest: rarely sampled texels are filled in from nearby
ones. At 0.5 the sky's finest map hardly counts."""

RENDER_SAMPLES, REFINED_SAMPLES = 16, 64
"""Default rays per pixel while rendering: for all pixels, and in addition for those whose rays differ."""


@dataclass(frozen=True, kw_only=True)
class LightPathConfig(MethodConfig):
    """Ours: neural textures where light paths through the glass end, composited by physics."""

    room: ClassVar[str] = "model.methods.light_path.net"
    page: ClassVar[str] = "model.methods.light_path.page"
    knowledge: ClassVar[str] = "materials (all but diffuse colours)"
    draws_cameras: ClassVar[bool] = True
    has_radiance: ClassVar[bool] = True

    texture_size: int = choice(0, "t{}")
    """Least width and height of an average texture in texels; more visible objects get more texels, and all get texels
    as fine as training pixels see them. 0: the image's width."""
    train_samples: int = choice(4, "{}-rays", flag="rays")
    """Rays per pixel while training, a square number."""
    render_samples: int = choice(RENDER_SAMPLES, "{}-render-rays", flag="render-rays")
    """Rays per pixel while rendering, a square number."""
    refined_samples: int = choice(0, "{}-refined-rays", flag="refined-rays")
    """Further rays per pixel, a square number, where rays differ (edges, glass), and four times as many again where
    these do, too; none if this is at most --render-rays. 0: 64, or --render-rays if that is not 16."""
    branches: int = choice(12, "{}-branches", limits=(1, 64))
    """Branches traced per ray: the refracted one, the first reflection, then those that carry most light."""
    stack_hidden: int = choice(32, "stack{}", flag="stack", limits=(0, 4096))
    """Units of the two hidden layers of the stack network, which sees the stacked vertices and adds light that physics
    leaves out; 0: no stack network. On proxies 96."""
    straight_layers: int = choice(0, "{}-straight", limits=(0, 255))
    """Straight layers that the stack network sees in addition to the paths. On proxies 24."""
    shells: int = choice(1, "{}-shells", limits=(1, MAX_SURFACES))
    """Nested copies of each surface that straight layers meet: copy k of n is 1 - k / n times as large as the proxy and
    has its own texture, so that some layers lie near the object inside a coarse proxy. On proxies 4. Source: layered
    semi-transparent meshes (Volumetric Surfaces, 2024), there fitted to the truth."""
    relief: bool = choice(False, {True: "relief", False: "no-relief"})
    """Learn the depth of the true surface below the proxy, and look up the colour where the ray meets that, to first
    order. On proxies on. Source: relief mapping (Policarpo et al. 2005), with learned depths."""
    environment_size: int = choice(SKY_HEIGHT, "sky{}", flag="environment", limits=(1, 1024))
    """Height in texels of the finest map of the learned sky, a sum of latitude-longitude maps, each half as large as
    the one before down to a single colour, so that directions without training rays are filled in from nearby ones; 1:
    two colours. 32, the default, grows to 256 where training pixels see the sky finer."""
    sky_lobes: int = choice(12, "{}-lobes", limits=(0, 256))
    """Spherical Gaussians of the learned sky, which represent lamps. No effect on a sky of two colours."""
    sky_lr: float = choice(0.1, "sky-lr{}", limits=RATE)
    """Learning rate of the learned sky's maps; its lobes learn 2.5 times as fast. At 0.03, windows stay blurred."""
    directions: bool = choice(False, {True: "directions", False: "no-directions"})
    """Give the decoder the mirrored direction. True geometry does not need it: gloss is traced, so only diffuse light
    is left. On proxies on."""
    debias: float = choice(1.0, "debias{}", limits=SHARE)
    """Fraction, 0 to 1, of the noise of training rays to subtract from the loss; above 0, rays come in independent
    pairs. At 0 lamps are learned too dim. On proxies 0: not tried there."""
    fill_in: bool = choice(True, {True: "filled", False: "unfilled"})
    """After training, fill in rarely sampled texels from their neighbours. On proxies off: not tried there."""
    texture_levels: int = choice(5, "{}-levels", limits=(1, 8))
    """Number of textures summed, each half as wide as the one before: coarser levels fill in rarely sampled texels."""
    finer_counts: float = unflagged(0.5, limits=(0.001, 1))
    """`FINER_COUNTS`; in runs of earlier versions 0.5."""
    texture_sizes: tuple[int, ...] = unflagged(())
    """Width and height of each object's texture in texels."""
    texture_features: int = unflagged(8, limits=(1, 256))
    """Channels of a texture; the paper's 16 do no better and take twice the memory."""
    hidden: int = unflagged(128, limits=(1, 4096))
    """Units of the decoder's two hidden layers. 64 score 0.3 / 0.6 dB less (400 steps of 1,024 pixels, one seed)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.texture_sizes, default=2) < 2:
            raise HyalineError(f"texture_sizes: are {self.texture_sizes}; expected at least 2 texels for each object")
        if self.shells * len(self.texture_sizes) > MAX_SURFACES:
            raise HyalineError(
                f"shells: is {self.shells} for {len(self.texture_sizes)} objects; expected at most 255 copies"
            )
        check_texels("texture_size", self.texture_size, is_open=True)
        for name in ("train_samples", "render_samples"):
            check_samples(name, getattr(self, name))
        check_samples("refined_samples", self.refined_samples or 1)

    @property
    def needs_details(self) -> bool:
        """True if the ends of paths need a mirrored direction and a slope of uv."""
        return self.relief or self.directions

    @property
    def passes(self) -> tuple[int, ...]:
        """Rays per pixel of each pass of rendering; after the first, only pixels whose rays differ are drawn again."""
        refined = self.refined_samples
        return (self.render_samples, refined, 4 * refined) if refined > self.render_samples else (self.render_samples,)

    @property
    def seen_straight(self) -> int:
        """Straight layers that matter: only the stack network uses them."""
        return self.straight_layers if self.stack_hidden else 0

    @property
    def paired_rays(self) -> bool:
        """True if a pixel's training rays come in independent pairs, which measure its noise, instead of one in each
        cell of a grid, which is less noisy."""
        return self.debias > 0

    def usual(self, geometry: str) -> Self:
        """On proxies, paths are wrong where the surface is off.

        The stack network then also sees the straight layers, including those of nested shells, gives each an opacity,
        and mixes their light with that of the paths.
        """
        if follows_light(geometry):
            return type(self)()
        return type(self)(
            stack_hidden=96,
            straight_layers=24,
            shells=4,
            relief=True,
            directions=True,
            debias=0.0,
            fill_in=False,
        )

    def hurried(self) -> Self:
        return dataclasses.replace(self, render_samples=1, refined_samples=1)

    def optimisation(self) -> PixelOptimisation:
        # A quarter of the pixels with four rays each: as many rays a step as `paper`.
        by_muon = not self.straight_layers  # On proxies not tried.
        return PixelOptimisation(
            steps=1750 if by_muon else 2500,
            batch=2048,
            optimizer="muon" if by_muon else "adam",
            lr=0.002,
            texture_lr=0.04,
            lr_decay="cosine",
            updates=4,
            loss=LossConfig(softness=0.05),
        )

    def sized(self, texture_sizes: tuple[int, ...]) -> Self:
        """The same for objects with textures of these widths."""
        refined = self.refined_samples
        if not refined:  # A number of rays that was asked for is kept.
            refined = REFINED_SAMPLES if self.render_samples == RENDER_SAMPLES else self.render_samples
        is_chosen = self.shells != self.usual("box").shells
        return dataclasses.replace(
            self,
            texture_sizes=texture_sizes,
            shells=self.shells if is_chosen else max(1, min(self.shells, MAX_SURFACES // len(texture_sizes))),
            finer_counts=FINER_COUNTS,
            sky_lobes=0 if self.environment_size == 1 else self.sky_lobes,
            refined_samples=refined,
        )
