"""Materials of a glTF file: its metallic-roughness model and those of Khronos's extensions that glass needs.

Source: glTF 2.0 section 3.9 and the READMEs of the extensions in KhronosGroup/glTF.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from datagen.disk.errors import HyalineError
from datagen.scene.materials import Color
from hyaline_import.foreign import (
    PLAIN,
    Factor,
    FactorImage,
    ForeignImage,
    ForeignMaterial,
    clipped,
    clipped_color,
)
from hyaline_import.gltf import file as records
from hyaline_import.gltf.file import GltfFile
from hyaline_import.remarks import Remarks

READ = {
    f"KHR_materials_{name}" for name in ("dispersion", "emissive_strength", "ior", "transmission", "unlit", "volume")
}
"""Extensions of a material that are read."""
ALPHA_MODES: dict[str, Literal["opaque", "mask", "blend"]] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
REPEAT = 10497
GLOSS, TRANSMISSION = "KHR_materials_pbrSpecularGlossiness", "KHR_materials_transmission"
REPEATS = "its image does not repeat in the file; here it does, where uv reach beyond it"


@dataclass(frozen=True, kw_only=True)
class TextureUse:
    """How a material's image lies on a mesh."""

    channel: int
    """Which TEXCOORD of the mesh."""
    offset: tuple[float, ...]
    scale: tuple[float, ...]
    rotation: float

    def uv_from_file(self, uv: Float[np.ndarray, "vertex 2"]) -> Float[np.ndarray, "vertex 2"]:
        """From uv of the file, v down, to uv of its image, v up. Source: KHR_texture_transform's README."""
        cos, sin = math.cos(self.rotation), math.sin(self.rotation)
        u, v = uv[:, 0] * self.scale[0], uv[:, 1] * self.scale[1]
        sides = [cos * u + sin * v + self.offset[0], -sin * u + cos * v + self.offset[1]]
        return np.stack([sides[0], 1 - sides[1]], axis=-1)


def read_material(file: GltfFile, index: int | None, remarks: Remarks) -> tuple[ForeignMaterial, TextureUse | None]:
    """A material of the file, and how its image lies (its base colour's, if any); `PLAIN` for None."""
    if index is None:
        return PLAIN, None
    entry = file.item(file.root.materials, index, where=str(file.path))
    name = entry.name or f"material_{index}"
    if GLOSS in entry.extensions:
        advice = "`npx @gltf-transform/cli metalrough IN OUT` converts it"
        remarks.approximate(name, f"is of the withdrawn specular-glossiness model; drawn grey and matt, {advice}")
        return replace(PLAIN, name=name), None
    pbr = entry.pbr_metallic_roughness
    *color, alpha = pbr.base_color_factor
    metallic, roughness = 1.0 if pbr.metallic_factor is None else pbr.metallic_factor, pbr.roughness_factor
    texture = pbr.base_color_texture
    others: list[tuple[Factor, records.Use, int]] = []
    if (shared := pbr.metallic_roughness_texture) is not None:
        others = [("metallic", shared, 2), ("roughness", shared, 1)]
    if "KHR_materials_unlit" in entry.extensions:
        metallic, roughness, others = 0.0, 1.0, []
        remarks.approximate(name, "is unlit; drawn as a matt surface that light falls on")
    image, use = (None, None) if texture is None else _texture(file, texture, name, remarks)
    looks = (name for name in sorted(entry.extensions) if name.startswith("KHR_materials_"))
    left_out = [name.removeprefix("KHR_materials_") for name in looks if name not in READ]
    left_out += ["a normal map"] * (entry.normal_texture is not None)
    left_out += ["an occlusion map"] * (entry.occlusion_texture is not None)
    for what in left_out:
        remarks.approximate(name, f"has {what}, which is left out")
    transmission = entry.extension(TRANSMISSION)
    if transmission.transmission_texture is not None:
        others.append(("transmission", transmission.transmission_texture, 0))
    factor_images = []
    for factor, other, channel in others:
        found, own_use = _texture(file, other, name, remarks)
        if found is not None:
            use = use or own_use
            factor_images.append(FactorImage(factor=factor, image=found, channel=channel, lies_as_color=own_use == use))
        elif factor == "metallic":
            # The factor's default of 1 would turn into metal what the missing image may not.
            metallic = pbr.metallic_factor or 0.0
    volume = entry.extension("KHR_materials_volume")
    material = ForeignMaterial(
        name=name,
        base_color=clipped_color(color),
        image=image,
        alpha=clipped(alpha),
        alpha_mode=ALPHA_MODES[entry.alpha_mode],
        alpha_cutoff=max(entry.alpha_cutoff, 0.0),
        metallic=clipped(metallic),
        roughness=clipped(roughness),
        transmission=clipped(transmission.transmission_factor),
        factor_images=tuple(factor_images),
        ior=_ior(entry, name),
        is_volume=volume.thickness_factor > 0,
        attenuation_color=clipped_color(volume.attenuation_color),
        attenuation_distance=math.inf if volume.attenuation_distance is None else volume.attenuation_distance,
        dispersion=max(entry.extension("KHR_materials_dispersion").dispersion, 0.0),
        emission=_emission(entry, name, remarks),
    )
    return material, use


def _ior(entry: records.Material, name: str) -> float:
    if "KHR_materials_unlit" in entry.extensions and TRANSMISSION not in entry.extensions:
        return 1.0
    # 0 is the extension's word for a surface that mirrors all.
    ior = entry.extension("KHR_materials_ior").ior or 1.5
    if not 1 <= ior < 10:
        raise HyalineError(f"{entry.where}: material {name} has an index of refraction of {ior:g}; expected 1 to 10")
    return ior


def _emission(entry: records.Material, name: str, remarks: Remarks) -> Color:
    color = clipped_color(entry.emissive_factor)
    if entry.emissive_texture is not None and max(color) > 0:
        remarks.approximate(name, "emits light by an image, which is ignored")
        return 0.0, 0.0, 0.0
    strength = entry.extension("KHR_materials_emissive_strength").emissive_strength
    red, green, blue = (max(strength, 0.0) * c for c in color)
    return red, green, blue


# Images


def _texture(
    file: GltfFile, texture: records.Use, name: str, remarks: Remarks
) -> tuple[ForeignImage | None, TextureUse | None]:
    where = f"{file.path}: material {name}"
    entry = file.item(file.root.textures, texture.index, where=where)
    webp = entry.extension("EXT_texture_webp")
    source = entry.source if webp.source is None else webp.source
    if source is None:
        kinds = ", ".join(entry.extensions)
        remarks.approximate(name, f"has an image of a kind that is not read ({kinds}), which is left out")
        return None, None
    image = file.item(file.root.images, source, where=entry.where)
    if image.uri is not None:
        where = f"{image.where}.uri"
        if not image.uri.startswith("data:") and not (found := file.beside(image.uri, where=where)).exists():
            remarks.approximate(name, f"has an image that is not there ({found.name}); drawn without it")
            return None, None
        data = file.uri(image.uri, where=where)
    elif image.buffer_view is not None:
        data = bytes(file.buffer_view(image.buffer_view, where=image.where)[0])
    else:
        raise HyalineError(f"{image.where}: has no bytes; the file is incomplete, export it again")
    transform = texture.extension("KHR_texture_transform")
    if entry.sampler is not None:
        sampler = file.item(file.root.samplers, entry.sampler, where=entry.where)
        if not sampler.wrap_s == sampler.wrap_t == REPEAT:
            remarks.approximate(name, REPEATS)
    use = TextureUse(
        channel=texture.tex_coord if transform.tex_coord is None else transform.tex_coord,
        offset=transform.offset,
        scale=transform.scale,
        rotation=transform.rotation,
    )
    return ForeignImage(name=name, data=data), use
