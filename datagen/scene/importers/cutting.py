"""Which parts of a foreign surface its material's opacity cuts away."""

import dataclasses

import numpy as np

from datagen.data.meshes import Mesh
from datagen.data.tonemap import srgb_from_linear
from datagen.scene.cutouts import Cut, Opacity, corner_uv_of
from datagen.scene.importers.foreign import ForeignMaterial
from datagen.scene.importers.mapping import INVISIBLE, SOLID_BLEND
from datagen.scene.importers.pictures import decoded, values_on
from datagen.scene.importers.remarks import Remarks

BLEND_CUTOFF = 0.5
"""Opacity from which on a blended surface is drawn."""
PARTLY = (0.1, 0.9)
"""Opacity that is neither nothing nor all."""
MAX_PARTLY = 0.02
"""Share of an image's texels that may be partly opaque, as its edges are."""
MOSTLY = 0.5
"""Share of a surface from which on it is a pane if its image is partly opaque there."""


def veiled(material: ForeignMaterial, mesh: Mesh, *, has_uv: bool) -> ForeignMaterial:
    """The material as one of a single alpha where its image lets a part of the light through nearly everywhere.

    Panes are drawn so in many files: an image of their colour whose alpha is, say, 0.3 all over.
    """
    if material.alpha_mode != "blend" or not has_uv or (material.image is None and material.opacity is None):
        return material
    seen, areas = values_on(mesh, _opacity(material))
    partly = areas[(seen > PARTLY[0]) & (seen < PARTLY[1])].sum() / areas.sum()
    if partly < MOSTLY:
        return material
    return dataclasses.replace(material, alpha=float(seen @ areas / areas.sum()), opacity=None)


def cut_of(
    material: ForeignMaterial, mesh: Mesh, remarks: Remarks, *, has_uv: bool, is_solid: bool, where: str
) -> Cut | None:
    """How a surface is to be cut; None where nothing is cut away."""
    is_pane = material.alpha_mode == "blend" and INVISIBLE <= material.alpha < SOLID_BLEND
    if material.alpha_mode == "opaque" or is_pane or (is_solid and material.alpha_mode == "blend"):
        return None
    opacity = _opacity(material)
    cutoff = min(material.alpha_cutoff, 2.0) if material.alpha_mode == "mask" else BLEND_CUTOFF
    if opacity.min() >= cutoff:
        return None
    if is_solid:
        remarks.approximate(where, "is cut out by its opacity, which would open a solid; drawn whole")
        return None
    if not has_uv and opacity.size > 1:
        remarks.approximate(where, "is cut out by an image, and has no uv; drawn whole")
        return None
    partly = float(((opacity > PARTLY[0]) & (opacity < PARTLY[1])).mean())
    what = f"is cut out where its opacity is below {cutoff:.2g}"
    if material.alpha_mode == "blend" and partly > MAX_PARTLY:
        remarks.approximate(where, f"{what}; {100 * partly:.0f} % of its texels let a part of the light through")
    else:
        remarks.note(where, what)
    return Cut(opacity=opacity, cutoff=cutoff, corner_uv=corner_uv_of(mesh))


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
