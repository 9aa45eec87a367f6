"""BSDFs of a Mitsuba scene, in the terms of foreign materials."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from datagen.disk.errors import HyalineError, shown
from datagen.scene.materials import Color
from hyaline_import.foreign import ForeignImage, ForeignMaterial, clipped, clipped_color, read_foreign
from hyaline_import.mitsuba.nodes import Node
from hyaline_import.pictures import stored
from hyaline_import.remarks import Remarks

IORS = {
    "vacuum": 1.0, "helium": 1.000036, "hydrogen": 1.000132, "air": 1.000277, "carbon dioxide": 1.00045,
    "water": 1.3330, "acetone": 1.36, "ethanol": 1.361, "carbon tetrachloride": 1.461, "glycerol": 1.4729,
    "benzene": 1.501, "silicone oil": 1.52045, "bromine": 1.661, "water ice": 1.31, "fused quartz": 1.458,
    "pyrex": 1.470, "acrylic glass": 1.49, "polypropylene": 1.49, "bk7": 1.5046, "sodium chloride": 1.544,
    "amber": 1.55, "pet": 1.5750, "diamond": 2.419,
}  # fmt: skip
"""Source: Mitsuba 3's documentation of `dielectric`."""

METALS: dict[str, Color] = {
    "none": (1.0, 1.0, 1.0),
    "Au": (1.0, 0.78, 0.34),
    "Ag": (0.97, 0.96, 0.91),
    "Al": (0.91, 0.92, 0.92),
    "Cu": (0.96, 0.64, 0.54),
    "Cr": (0.55, 0.55, 0.55),
}
"""Reflectance at normal incidence."""

WRAPPERS = ("twosided", "mask", "bumpmap", "normalmap")
"""BSDFs around another one."""
MAX_DEPTH = 8
"""BSDFs within BSDFs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundMaterial:
    """A material, and how its image lies: (4, 4), from uv of the mesh to uv of the image."""

    material: ForeignMaterial
    image_from_uv: np.ndarray = field(default_factory=lambda: np.eye(4))
    repeats: bool = True
    """Else the image's edges are extended, or every other repeat is mirrored."""


def read_bsdf(node: Node, remarks: Remarks, *, depth: int = 0) -> FoundMaterial:
    """The material of a BSDF."""
    if node.plugin in WRAPPERS:
        inner = node.inner("BSDF")
        if inner is None or depth > MAX_DEPTH:
            raise HyalineError(f"{node.where}: holds no BSDF, itself, or more than {MAX_DEPTH} others; expected a BSDF")
        if node.plugin != "twosided":
            remarks.approximate(node.name, f"is a {node.plugin}; only the material inside it is drawn")
        return read_bsdf(inner, remarks, depth=depth + 1)
    if node.plugin not in READERS:
        known = ", ".join(sorted([*READERS, *WRAPPERS]))
        raise HyalineError(f"{node.where}: is of a kind that is not read; known are {known}")
    return READERS[node.plugin](node, remarks)


def _ior(node: Node, key: str, default: str) -> float:
    if key not in node or isinstance(node.props[key], str):
        name = node.text(key, default)
        if name not in IORS:
            raise HyalineError(f"{node.where}: {key} is {shown(name)}; expected a number, or one of {', '.join(IORS)}")
        return IORS[name]
    return node.number(key, 1.5)


def _ratio(node: Node, inside: str = "bk7") -> float:
    int_ior, ext_ior = _ior(node, "int_ior", inside), _ior(node, "ext_ior", "air")
    if not 1 <= int_ior / max(ext_ior, 1e-9) < 10:
        raise HyalineError(
            f"{node.where}: has int_ior {int_ior:g} and ext_ior {ext_ior:g}; expected a ratio of 1 to 10: make each "
            "medium a closed mesh with ext_ior 1, the inner one in the outer one, where it fills the space"
        )
    return int_ior / ext_ior


def _facets(node: Node, remarks: Remarks) -> float:
    """The perceptual roughness of GGX facets."""
    if (name := node.text("distribution", "beckmann")) != "ggx":
        remarks.approximate(node.name, f"has facets of the distribution {name}; drawn with GGX of the same alpha")
    if "alpha_u" in node:
        remarks.approximate(node.name, "has a grain (alpha_u, alpha_v); drawn without one")
        return clipped(node.number("alpha_u", 0.1) * node.number("alpha_v", 0.1)) ** 0.25
    if (texture := node.child("alpha")) is None:
        return math.sqrt(clipped(node.number("alpha", 0.1)))
    if texture.plugin != "bitmap":
        raise HyalineError(f"{texture.where}: is roughness of a kind that is not read; known is bitmap")
    image = ForeignImage(name=node.name, data=read_foreign(texture.file("filename")))
    mean = float(stored(image)[..., :3].mean()) / 255
    remarks.approximate(node.name, f"has an image of roughness; drawn with its mean, alpha {mean:.2f}")
    return math.sqrt(mean)


def _remark_on_scale(node: Node, key: str, remarks: Remarks) -> None:
    """A line for a reflectance or transmittance that the file scales."""
    if node.child(key) is not None or node.color(key, 1.0) != (1, 1, 1):
        remarks.approximate(node.name, f"scales its {key.removeprefix('specular_')}, which is left out")


def _glass(node: Node, remarks: Remarks) -> FoundMaterial:
    key, is_thin, color = "specular_transmittance", node.plugin == "thindielectric", (1.0, 1.0, 1.0)
    _remark_on_scale(node, "specular_reflectance", remarks)
    if node.child(key) is None:
        color = clipped_color(node.color(key, 1.0))
    else:
        _remark_on_scale(node, key, remarks)
    material = ForeignMaterial(
        name=node.name,
        # What passes both surfaces of a solid is its colour.
        base_color=color if is_thin else clipped_color(c**2 for c in color),
        transmission=1.0,
        ior=_ratio(node),
        is_volume=not is_thin,
        is_thin=is_thin,
        roughness=_facets(node, remarks) if node.plugin == "roughdielectric" else 0.0,
    )
    return FoundMaterial(material=material)


def _diffuse(node: Node, remarks: Remarks) -> FoundMaterial:
    return _colored(ForeignMaterial(name=node.name, roughness=1.0, ior=1.0), node, "reflectance", 0.5, remarks)


def _plastic(node: Node, remarks: Remarks) -> FoundMaterial:
    if not node.flag("nonlinear"):
        remarks.approximate(node.name, "has a base without colour shifts from light below its coat; drawn with them")
    _remark_on_scale(node, "specular_reflectance", remarks)
    roughness = _facets(node, remarks) if node.plugin == "roughplastic" else 0.0
    ior = max(_ratio(node, "polypropylene"), 1.0001)
    material = ForeignMaterial(name=node.name, roughness=roughness, ior=ior, is_base=True)
    return _colored(material, node, "diffuse_reflectance", 0.5, remarks)


def _conductor(node: Node, remarks: Remarks) -> FoundMaterial:
    name = node.text("material", "none")
    if name not in METALS:
        raise HyalineError(f"{node.where}: is the metal {shown(name)}; expected one of {', '.join(METALS)}")
    color = METALS[name]
    if "eta" in node:
        # Fresnel's reflectance of a metal at normal incidence.
        eta, k = np.array(node.color("eta", 0.0)), np.array(node.color("k", 1.0))
        color = (((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)).tolist()
    if "eta" in node or name != "none":
        remarks.approximate(node.name, "is a metal; drawn with its reflectance at normal incidence at all angles")
    key, roughness = "specular_reflectance", _facets(node, remarks) if node.plugin == "roughconductor" else 0.0
    metal = ForeignMaterial(name=node.name, base_color=clipped_color(color), metallic=1.0, roughness=roughness)
    found = _colored(metal, node, key, 1.0, remarks)
    if node.child(key) is None:
        color = (a * b for a, b in zip(color, found.material.base_color, strict=True))
    return replace(found, material=replace(found.material, base_color=clipped_color(color)))


def _principled(node: Node, remarks: Remarks) -> FoundMaterial:
    for key in ("clearcoat", "sheen", "flatness", "anisotropic", "spec_tint"):
        if key in node and (node.child(key) is not None or node.number(key, 0.0) > 0):
            remarks.approximate(node.name, f"has {key}, which is left out")
    specular = min(max(node.number("specular", 0.5), 1e-3), 1.0)
    eta = node.number("eta", 2 / (1 - math.sqrt(0.08 * specular)) - 1)
    material = ForeignMaterial(
        name=node.name,
        metallic=clipped(node.number("metallic", 0.0)),
        roughness=clipped(node.number("roughness", 0.5)),
        transmission=clipped(node.number("spec_trans", 0.0)),
        is_volume=True,
        ior=min(max(eta, 1.0), 9.0),
    )
    return _colored(material, node, "base_color", 0.5, remarks)


READERS = {
    "dielectric": _glass, "roughdielectric": _glass, "thindielectric": _glass, "diffuse": _diffuse,
    "plastic": _plastic, "roughplastic": _plastic, "conductor": _conductor, "roughconductor": _conductor,
    "principled": _principled,
}  # fmt: skip


def absorption_of(medium: Node | None) -> Color:
    """What a homogeneous medium takes away, per unit of length."""
    if medium is None:
        return (0.0, 0.0, 0.0)
    if medium.plugin != "homogeneous":
        raise HyalineError(f"{medium.where}: is not a homogeneous medium; expected one, or none")
    if max(medium.color("albedo", 0.75)) > 0:
        raise HyalineError(f"{medium.where}: scatters light; expected an albedo of 0, which only absorbs")
    scale = medium.number("scale", 1.0)
    red, green, blue = (scale * c for c in medium.color("sigma_t", 1.0))
    return red, green, blue


def _colored(material: ForeignMaterial, node: Node, key: str, default: float, remarks: Remarks) -> FoundMaterial:
    """The material with a colour, or the image of a texture."""
    texture = node.child(key)
    if texture is None:
        return FoundMaterial(material=replace(material, base_color=clipped_color(node.color(key, default))))
    if texture.plugin != "bitmap":
        raise HyalineError(f"{texture.where}: is of a kind that is not read; known is bitmap")
    if texture.flag("raw"):
        remarks.approximate(node.name, "has an image of linear values; drawn as sRGB")
    image = ForeignImage(name=node.name, data=read_foreign(texture.file("filename")))
    return FoundMaterial(
        material=replace(material, image=image),
        image_from_uv=texture.matrix("to_uv"),
        repeats=texture.text("wrap_mode", "repeat") == "repeat",
    )
