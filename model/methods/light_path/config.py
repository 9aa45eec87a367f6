"""What the method `light-path` is made of."""

from dataclasses import dataclass

from datagen.disk.errors import HyalineError
from model.batches.samples import check_samples

MAX_SURFACES = 255
"""Ids of surfaces are bytes, and 0 is the empty one."""


SKY_LOBES = 12
"""Lobes of the learned sky unless told otherwise."""


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
    sees_directions: bool = True
    """The decoder is told the mirrored direction. On true geometry it need not be: gloss is traced, and what is left is
    diffuse."""
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
    paired_rays: bool = False
    """While training the rays of a pixel come in independent pairs, which tell how noisy it is, instead of one in each
    cell of a grid, which is less noisy."""
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
    return LightPathConfig(texture_sizes=texture_sizes, sees_directions=False, sky_lobes=SKY_LOBES)
