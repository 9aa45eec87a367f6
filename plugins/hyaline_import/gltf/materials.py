"""Materials of a glTF file: its metallic-roughness model and those of Khronos's extensions that glass needs.

Source: glTF 2.0 section 3.9 and the READMEs of the extensions in KhronosGroup/glTF.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
from jaxtyping import Float, Int

from datagen.data.images import png_bytes
from datagen.disk.errors import HyalineError
from datagen.scene.remarks import Remarks
from datagen.scene.substances import SUBSTANCES
from datagen.scene.values import Color
from hyaline_import.fields import Fields
from hyaline_import.foreign import PLAIN, Factor, FactorImage, ForeignImage, ForeignMaterial, substance_of
from hyaline_import.gltf.file import GltfFile
from hyaline_import.pictures import decoded, stored

IGNORED = {
    "KHR_materials_anisotropy": "brushed grain (anisotropy)",
    "KHR_materials_clearcoat": "a clear coat",
    "KHR_materials_diffuse_transmission": "diffuse transmission",
    "KHR_materials_iridescence": "iridescence",
    "KHR_materials_sheen": "sheen",
    "KHR_materials_specular": "a specular weight or tint",
}
MAX_PRIORITY = 9
REPEAT, CLAMP_TO_EDGE, MIRRORED_REPEAT = 10497, 33071, 33648
LEAST_METAL = 0.25
"""Reflectance at normal incidence that only metals have; a diamond has 0.17."""
ROUNDING = 1e-4
"""Largest distance of uv from an image's edge, in images, that counts as rounding."""


@dataclass(frozen=True, kw_only=True)
class TextureUse:
    """How a material's image lies on a mesh."""

    channel: int
    """Which TEXCOORD of the mesh."""
    offset: tuple[float, ...]
    scale: tuple[float, ...]
    rotation: float
    clamps: tuple[bool, bool]
    """Along u and v, the image's edges are extended instead of repeating the image."""
    mirrors: tuple[bool, bool]
    """Along u and v, every other repeat is mirrored: the image is one from `mirrored`."""

    def uv_from_file(self, uv: Float[np.ndarray, "vertex 2"]) -> Float[np.ndarray, "vertex 2"]:
        """From uv of the file, v down, to uv of its image, v up. Source: KHR_texture_transform's README."""
        cos, sin = math.cos(self.rotation), math.sin(self.rotation)
        u, v = uv[:, 0] * self.scale[0], uv[:, 1] * self.scale[1]
        sides = [cos * u + sin * v + self.offset[0], -sin * u + cos * v + self.offset[1]]
        sides = [side / 2 if mirror else side for side, mirror in zip(sides, self.mirrors)]
        return np.stack([sides[0], 1 - sides[1]], axis=-1)


def read_material(file: GltfFile, index: int | None, remarks: Remarks) -> tuple[ForeignMaterial, TextureUse | None]:
    """A material of the file, and how its image lies (its base colour's, if any); `PLAIN` for None."""
    if index is None:
        return PLAIN, None
    fields = file.item("materials", index, where=str(file.path))
    name = fields.text("name") or f"material_{index}"
    pbr = fields.fields("pbrMetallicRoughness")
    red, green, blue, alpha = pbr.numbers("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
    metallic, roughness = pbr.share("metallicFactor", 1.0), pbr.share("roughnessFactor", 1.0)
    texture = pbr.fields("baseColorTexture") if "baseColorTexture" in pbr else None
    others: list[tuple[Factor, Fields, int]] = []
    if "metallicRoughnessTexture" in pbr:
        shared = pbr.fields("metallicRoughnessTexture")
        others = [("metallic", shared, 2), ("roughness", shared, 1)]
    if (gloss := fields.extension("KHR_materials_pbrSpecularGlossiness")) is not None:
        red, green, blue, alpha = gloss.numbers("diffuseFactor", (1.0, 1.0, 1.0, 1.0))
        metallic, roughness = 0.0, 1 - gloss.share("glossinessFactor", 1.0)
        texture = gloss.fields("diffuseTexture") if "diffuseTexture" in gloss else None
        is_shiny = "specularGlossinessTexture" in gloss
        others = [("roughness", gloss.fields("specularGlossinessTexture"), 3)] if is_shiny else []
        specular = np.array(gloss.color("specularFactor", (1.0, 1.0, 1.0)))
        shown = _texture(file, gloss.fields("specularGlossinessTexture"), name, remarks)[0] if is_shiny else None
        if shown is not None:
            specular *= decoded(shown)[..., :3].mean(axis=(0, 1))
        what = "plastic of its diffuse colour"
        if specular.max() > LEAST_METAL:
            (red, green, blue), metallic, texture = specular.tolist(), 1.0, None
            what = "metal of its specular colour"
        remarks.approximate(name, f"is of the specular-glossiness model; drawn as {what}")
    if is_unlit := fields.extension("KHR_materials_unlit") is not None:
        metallic, roughness, others = 0.0, 1.0, []
        remarks.approximate(name, "is unlit; drawn as a matt surface that light falls on")
    image, use = (None, None) if texture is None else _texture(file, texture, name, remarks)
    _remark_on(fields, name, remarks)
    transmission = fields.extension("KHR_materials_transmission")
    if transmission is not None and "transmissionTexture" in transmission:
        others.append(("transmission", transmission.fields("transmissionTexture"), 0))
    factor_images, use = _factor_images(file, others, use, name, remarks, is_glossiness=gloss is not None)
    if others and others[0][0] == "metallic" and not any(found.factor == "metallic" for found in factor_images):
        # Its image is missing. The factor's default of 1 would turn into metal what the image may not.
        metallic = pbr.share("metallicFactor", 0.0)
    volume = fields.extension("KHR_materials_volume")
    dispersion = fields.extension("KHR_materials_dispersion")
    material = ForeignMaterial(
        name=name,
        base_color=cast(tuple[float, float, float], tuple(min(max(c, 0.0), 1.0) for c in (red, green, blue))),
        image=image,
        alpha=min(max(alpha, 0.0), 1.0),
        alpha_mode=_alpha_mode(fields),
        alpha_cutoff=max(fields.number("alphaCutoff", 0.5), 0.0),
        metallic=metallic,
        roughness=roughness,
        transmission=0.0 if transmission is None else transmission.share("transmissionFactor", 0.0),
        factor_images=factor_images,
        ior=1.0 if is_unlit and transmission is None else _ior(fields, name, remarks),
        is_volume=volume is not None and volume.number("thicknessFactor", 0.0) > 0,
        attenuation_color=(1.0, 1.0, 1.0) if volume is None else volume.color("attenuationColor", (1.0, 1.0, 1.0)),
        attenuation_distance=_distance(volume),
        dispersion=0.0 if dispersion is None else max(dispersion.number("dispersion", 0.0), 0.0),
        priority=_priority(fields),
        emission=_emission(fields, name, remarks),
    )
    return material, use


def _alpha_mode(fields: Fields) -> Literal["opaque", "mask", "blend"]:
    mode = fields.text("alphaMode", "OPAQUE")
    modes: dict[str, Literal["opaque", "mask", "blend"]] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
    if mode not in modes:
        raise HyalineError(f"{fields.where}.alphaMode: is {mode[:40]!r}; expected one of {', '.join(modes)}")
    return modes[mode]


def _ior(fields: Fields, name: str, remarks: Remarks) -> float:
    extension = fields.extension("KHR_materials_ior")
    named = substance_of(name) if fields.extension("KHR_materials_transmission") is not None else None
    if extension is None and named is not None:
        remarks.note(name, f"the file gives no index of refraction; by its name it is {named}, {SUBSTANCES[named]:g}")
        return SUBSTANCES[named]
    ior = 1.5 if extension is None else extension.number("ior", 1.5)
    if ior == 0:  # The extension's word for a surface that mirrors all: of the specular-glossiness model.
        remarks.approximate(name, "has an index of refraction of 0, which means none; drawn with 1.5")
        return 1.5
    if not 1 <= ior < 10:
        raise HyalineError(f"{fields.where}: material {name} has an index of refraction of {ior:g}; expected 1 to 10")
    return ior


def _distance(volume: Fields | None) -> float:
    if volume is None or "attenuationDistance" not in volume:
        return math.inf
    distance = volume.number("attenuationDistance", 1.0)
    if distance <= 0:
        raise HyalineError(f"{volume.where}.attenuationDistance: is {distance:g}; expected a positive number")
    return distance


def _priority(fields: Fields) -> int:
    extras = fields.data.get("extras")
    if not isinstance(extras, dict) or "priority" not in extras:
        return 0
    return Fields(extras, f"{fields.where}.extras").integer("priority", low=-MAX_PRIORITY, high=MAX_PRIORITY)


def _remark_on(fields: Fields, name: str, remarks: Remarks) -> None:
    """A line for each property of a material that is not drawn."""
    for extension in fields.extensions():
        if extension in IGNORED:
            remarks.approximate(name, f"has {IGNORED[extension]}, which is left out")
    for key, what in (("normalTexture", "a normal map"), ("occlusionTexture", "an occlusion map")):
        if key in fields:
            remarks.approximate(name, f"has {what}, which is left out")
    volume = fields.extension("KHR_materials_volume")
    if volume is not None and "thicknessTexture" in volume:
        remarks.note(name, "has an image of thickness, which path tracers do not need: light crosses the mesh itself")


def _emission(fields: Fields, name: str, remarks: Remarks) -> Color:
    red, green, blue = fields.color("emissiveFactor", (0.0, 0.0, 0.0))
    if "emissiveTexture" in fields and max(red, green, blue) > 0:
        remarks.approximate(name, "emits light by an image, which is ignored")
        return 0.0, 0.0, 0.0
    extension = fields.extension("KHR_materials_emissive_strength")
    strength = 1.0 if extension is None else max(extension.number("emissiveStrength", 1.0), 0.0)
    return strength * red, strength * green, strength * blue


# Images


def _factor_images(
    file: GltfFile,
    entries: list[tuple[Factor, Fields, int]],
    use: TextureUse | None,
    name: str,
    remarks: Remarks,
    *,
    is_glossiness: bool,
) -> tuple[tuple[FactorImage, ...], TextureUse | None]:
    """The images that multiply factors, and how the material's image lies: as `use`, or as the first of these.

    Args:
        entries: factor, texture and channel of each.
        is_glossiness: of what is given for roughness.
    """
    images = []
    for factor, entry, channel in entries:
        image, own_use = _texture(file, entry, name, remarks)
        if image is None:
            continue
        use = use or own_use
        is_inverted = is_glossiness and factor == "roughness"
        images.append(
            FactorImage(
                factor=factor, image=image, channel=channel, lies_as_color=own_use == use, is_glossiness=is_inverted
            )
        )
    return tuple(images), use


def _texture(
    file: GltfFile, texture: Fields, name: str, remarks: Remarks
) -> tuple[ForeignImage | None, TextureUse | None]:
    entry = file.item("textures", texture.integer("index"), where=texture.where)
    webp = entry.extension("EXT_texture_webp")
    source = webp if webp is not None else entry
    if "source" not in source:
        kinds = ", ".join(entry.extensions())
        remarks.approximate(name, f"has an image of a kind that is not read ({kinds}), which is left out")
        return None, None
    image = file.item("images", source.integer("source"), where=entry.where)
    if "uri" in image:
        uri, where = image.text("uri"), f"{image.where}.uri"
        if not uri.startswith("data:") and not (found := file.beside(uri, where=where)).exists():
            remarks.approximate(name, f"has an image that is not there ({found.name}); drawn without it")
            return None, None
        data = file.uri(uri, where=where)
    else:
        view, _ = file.buffer_view(image.integer("bufferView"), where=image.where)
        data = bytes(view)
    transform = texture.extension("KHR_texture_transform")
    channel = texture.integer("texCoord", 0, high=31)
    if transform is not None:
        channel = transform.integer("texCoord", channel, high=31)
    wraps = {"wrapS": REPEAT, "wrapT": REPEAT}
    if "sampler" in entry:
        sampler = file.item("samplers", entry.integer("sampler"), where=entry.where)
        wraps = {key: sampler.integer(key, REPEAT) for key in wraps}
    mirrors = wraps["wrapS"] == MIRRORED_REPEAT, wraps["wrapT"] == MIRRORED_REPEAT
    use = TextureUse(
        channel=channel,
        offset=(0.0, 0.0) if transform is None else transform.numbers("offset", (0.0, 0.0)),
        scale=(1.0, 1.0) if transform is None else transform.numbers("scale", (1.0, 1.0)),
        rotation=0.0 if transform is None else transform.number("rotation", 0.0),
        clamps=(wraps["wrapS"] == CLAMP_TO_EDGE, wraps["wrapT"] == CLAMP_TO_EDGE),
        mirrors=mirrors,
    )
    return mirrored(ForeignImage(name=name, data=data), mirrors), use


def mirrored(image: ForeignImage, mirrors: tuple[bool, bool]) -> ForeignImage:
    """The image beside its mirror image, along u, v or both; its repeats are mirrored repeats of the image."""
    if not any(mirrors):
        return image
    pixels = stored(image)
    pixels = np.concatenate([pixels, pixels[:, ::-1]], axis=1) if mirrors[0] else pixels
    pixels = np.concatenate([pixels, pixels[::-1]], axis=0) if mirrors[1] else pixels
    return replace(image, data=png_bytes(pixels))


def clamped(
    uv: Float[np.ndarray, "vertex 2"],
    faces: Int[np.ndarray, "face 3"],
    clamps: tuple[bool, bool],
    remarks: Remarks,
    *,
    where: str,
) -> Float[np.ndarray, "vertex 2"]:
    """uv of an image whose edges are extended: on its edge where they miss it by rounding; a remark if beyond it."""
    inside = np.clip(uv, 0, 1)
    uv = np.where(clamps & (np.abs(uv - inside) < ROUNDING), inside, uv)
    if (clamps & (uv != inside))[faces].any():
        remarks.approximate(
            where, "its uv reach beyond its image, whose edges the file extends; the image repeats there"
        )
    return uv
