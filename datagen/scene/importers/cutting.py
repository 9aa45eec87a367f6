"""Which parts of a foreign surface its material's opacity cuts away."""

import numpy as np

from datagen.data.meshes import Mesh
from datagen.data.tonemap import srgb_from_linear
from datagen.scene.cutouts import Cut, Opacity, corner_uv_of
from datagen.scene.importers.foreign import ForeignMaterial
from datagen.scene.importers.mapping import SOLID_BLEND
from datagen.scene.importers.pictures import decoded
from datagen.scene.importers.remarks import Remarks

BLEND_CUTOFF = 0.5
"""Opacity from which on a blended surface is drawn."""
PARTLY = (0.1, 0.9)
"""Opacity that is neither nothing nor all."""
MAX_PARTLY = 0.02
"""Share of an image's texels that may be partly opaque, as its edges are."""


def cut_of(material: ForeignMaterial, mesh: Mesh, remarks: Remarks, *, has_uv: bool, where: str) -> Cut | None:
    """How a surface is to be cut; None where nothing is cut away."""
    is_pane = material.alpha_mode == "blend" and material.alpha < SOLID_BLEND
    if material.alpha_mode == "opaque" or is_pane:
        return None
    opacity = _opacity(material)
    cutoff = material.alpha_cutoff if material.alpha_mode == "mask" else BLEND_CUTOFF
    if opacity.min() >= cutoff:
        return None
    if not has_uv and opacity.size > 1:
        remarks.approximate(where, "is cut out by an image, and has no uv; drawn whole")
        return None
    partly = float(((opacity > PARTLY[0]) & (opacity < PARTLY[1])).mean())
    what = f"is cut out where the opacity of its image is below {cutoff:.2g}"
    if material.alpha_mode == "blend" and partly > MAX_PARTLY:
        remarks.approximate(where, f"{what}; {100 * partly:.0f} % of its texels let a part of the light through")
    else:
        remarks.note(where, what)
    return Cut(opacity=opacity, cutoff=min(cutoff, 2.0), corner_uv=corner_uv_of(mesh))


def _opacity(material: ForeignMaterial) -> Opacity:
    """By texel, the factor included; one texel where there is no image."""
    if material.opacity is not None:
        pixels = decoded(material.opacity)
        has_alpha = pixels[..., 3].min() < 1
        values = pixels[..., 3] if has_alpha else srgb_from_linear(pixels[..., :3].astype(np.float64)).mean(axis=-1)
    elif material.image is not None:
        values = decoded(material.image)[..., 3]
    else:
        values = np.ones((1, 1))
    return (values * material.alpha).astype(np.float32)
