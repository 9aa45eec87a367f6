"""Tests that foreign materials become the nearest ones of ours, by the formulas of glTF's extensions."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.foreign import add, use_of
from support.gltf import BOX, GltfBuilder, clear, glass

from datagen.scene.materials import (
    Conductor,
    Dielectric,
    Diffuse,
    ImageTexture,
    Material,
    Plastic,
    RoughDielectric,
    ThinDielectric,
)
from hyaline_import.foreign import ForeignMaterial
from hyaline_import.gltf.scene import read_gltf
from hyaline_import.mapping import MIN_ALPHA, Coat, Mapper
from hyaline_import.remarks import Remarks


def foreign(folder: Path, **entry: object) -> ForeignMaterial:
    """A material as it is read from a file."""
    builder = add(GltfBuilder(), "stuff", BOX, entry)
    material = read_gltf(builder.written(folder), Remarks()).objects[0].material
    assert isinstance(material, ForeignMaterial)
    return material


def mapped(material: ForeignMaterial, *, is_closed: bool = True, metres: float = 1.0) -> tuple[Material, list[str]]:
    """The material of ours, and the approximations that it takes."""
    remarks = Remarks()
    mapper = Mapper(metres=metres, remarks=remarks)
    found = mapper.material(material, is_closed=is_closed, has_uv=True, where="thing")
    return found, [line.what for line in remarks.lines if line.is_approximation]


def test_attenuation_becomes_absorption_per_metre(tmp_path: Path) -> None:
    extensions = glass(attenuationColor=[0.1, 0.5, 0.9], attenuationDistance=1.0)
    material, lines = mapped(foreign(tmp_path, pbrMetallicRoughness=clear(), extensions=extensions), metres=0.015)
    assert isinstance(material, Dielectric)
    # Of Khronos's attenuation test, made 0.015 times as large: -ln(colour) / 0.015 m.
    np.testing.assert_allclose(material.absorption, [153.505673, 46.209812, 7.024034], rtol=1e-6)
    assert material.ior == 1.5
    assert lines == []
    # A ray straight through what is one unit thick comes out in the colour that the file names.
    np.testing.assert_allclose(np.exp(-0.015 * np.array(material.absorption)), [0.1, 0.5, 0.9])


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (
            {"extensions": {"KHR_materials_ior": {"ior": 1.33}}},
            Dielectric(ior=1.33),
        ),
        ({"pbrMetallicRoughness": clear(roughnessFactor=0.5)}, RoughDielectric(ior=1.5, roughness=0.25)),
        ({"extensions": {"KHR_materials_dispersion": {"dispersion": 0.5}}}, Dielectric(ior=1.5, dispersion=0.5)),
    ],
)
def test_index_and_roughness_are_those_of_the_file(entry: dict, expected: Material, tmp_path: Path) -> None:
    extensions = {**glass(), **entry.get("extensions", {})}
    given = {"pbrMetallicRoughness": clear(), **entry, "extensions": extensions}
    assert mapped(foreign(tmp_path, **given)) == (expected, [])


THIN = {**glass()}
del THIN["KHR_materials_volume"]


@pytest.mark.parametrize(
    ("extensions", "is_closed", "expected"),
    [
        (glass(), True, Dielectric),
        (THIN, True, Dielectric),
        (glass(), False, ThinDielectric),
        (THIN, False, ThinDielectric),
    ],
)
def test_glass_is_solid_where_its_mesh_is_closed(
    extensions: dict, is_closed: bool, expected: type, tmp_path: Path
) -> None:
    entry = foreign(tmp_path, pbrMetallicRoughness=clear(), extensions=extensions)
    assert isinstance(mapped(entry, is_closed=is_closed)[0], expected)


def test_the_base_colour_tints_a_pane_once_and_a_solid_at_both_of_its_surfaces(tmp_path: Path) -> None:
    entry = foreign(tmp_path, pbrMetallicRoughness=clear(baseColorFactor=[0.8, 0.5, 1.0, 1.0]), extensions=glass())
    assert mapped(entry, is_closed=False)[0] == ThinDielectric(ior=1.5, tint=(0.8, 0.5, 1.0))
    solid, lines = mapped(entry)
    assert isinstance(solid, Dielectric) and solid.absorption == (0, 0, 0)
    # As in Cycles, where a slab of base colour 0.5 shows 0.519 of white light: 0.04 is mirrored in front, 0.02 behind.
    np.testing.assert_allclose(np.array(solid.tint) ** 2, [0.8, 0.5, 1.0])
    assert lines == []


@pytest.mark.parametrize(
    ("pbr", "expected"),
    [
        ({"roughnessFactor": 0.95}, Conductor(color=(1, 1, 1), roughness=0.95**2)),
        (
            {"metallicFactor": 1.0, "roughnessFactor": 0.5, "baseColorFactor": [0.9, 0.6, 0.3, 1]},
            Conductor(color=(0.9, 0.6, 0.3), roughness=0.25),
        ),
        ({"metallicFactor": 1.0, "roughnessFactor": 0.0}, Conductor(color=(1, 1, 1), roughness=0.0)),
        (clear(roughnessFactor=0.9), Diffuse(color=(1, 1, 1))),
        (clear(roughnessFactor=0.55), Plastic(color=(1, 1, 1), ior=1.5, roughness=0.55**2)),
        (clear(baseColorFactor=[0, 0, 0, 1]), Plastic(color=(0, 0, 0), ior=1.5, roughness=0.001)),
    ],
)
def test_what_lets_no_light_through_is_metal_plastic_or_matt(pbr: dict, expected: Material, tmp_path: Path) -> None:
    found, lines = mapped(foreign(tmp_path, pbrMetallicRoughness=pbr))
    assert found == expected
    assert lines == []


@pytest.mark.parametrize(("ior", "returned"), [(1.33, 0.4712), (1.5, 0.5963), (1.8, 0.7325)])
def test_a_smooth_coat_is_inverted_by_its_closed_form(ior: float, returned: float) -> None:
    coat = Coat(ior=ior, alpha=MIN_ALPHA)
    # Fresnel's internal diffuse reflectance F (Egan and Hilgeman 1973), by which a base b shows (1 - F) b / (1 - F b).
    assert 1 - (1 - coat.mirrored) / ior**2 == pytest.approx(returned, abs=1e-3)
    color = np.array([0.05, 0.5, 0.9])
    np.testing.assert_allclose(coat.base_of(color), color / (1 - returned * (1 - color)), atol=1e-3)


def test_matt_things_keep_the_light_of_their_sheen(tmp_path: Path) -> None:
    pbr = clear(roughnessFactor=0.8, baseColorFactor=[0, 0.5, 0.5, 1])
    found, _ = mapped(foreign(tmp_path, pbrMetallicRoughness=pbr))
    assert isinstance(found, Diffuse)
    # Cycles shows 0.031 of light from everywhere on black of this roughness, and 0.515 on grey: its coats give what
    # they lose to the base.
    np.testing.assert_allclose(np.array(found.color, np.float64), [0.031, 0.515, 0.515], atol=7e-3)


def test_a_blended_surface_becomes_a_pane_that_lets_through_what_it_does_not_cover(tmp_path: Path) -> None:
    pbr = clear(baseColorFactor=[0.0, 0.5, 1.0, 0.4])
    found, lines = mapped(foreign(tmp_path, pbrMetallicRoughness=pbr, alphaMode="BLEND"))
    assert isinstance(found, ThinDielectric)
    np.testing.assert_allclose(found.tint, [0.6, 0.8, 1.0])
    assert len(lines) == 1


def test_an_image_is_multiplied_by_its_factor_on_plastic_and_metal_and_glass_gets_its_mean(tmp_path: Path) -> None:
    builder = GltfBuilder()
    use = use_of(builder, np.repeat([[[0] * 3] * 4, [[255] * 3] * 4], 2, axis=0))
    for metallic, extensions in ((0.0, {}), (1.0, {}), (0.0, THIN)):
        pbr = {**clear(metallicFactor=metallic), "baseColorTexture": use, "baseColorFactor": [1.0, 0.5, 0.0, 1.0]}
        add(builder, "thing", BOX, {"pbrMetallicRoughness": pbr, "extensions": extensions})
    mapper = Mapper(metres=1.0, remarks=Remarks())
    matt, metal, pane = (
        mapper.material(item.material, is_closed=False, has_uv=True, where="thing")
        for item in read_gltf(builder.written(tmp_path), Remarks()).objects
        if isinstance(item.material, ForeignMaterial)
    )
    assert isinstance(matt, Plastic) and isinstance(metal, Conductor)
    # Half of linear white is 188 in sRGB. Plastic's base is 0.71 for it, 219: its coat swallows the rest.
    for color, half in ((matt.color, 219), (metal.color, 188)):
        assert isinstance(color, ImageTexture)
        pixels = np.asarray(Image.open(io.BytesIO(mapper.images[color.path])))
        assert pixels[0, 0].tolist() == [0, 0, 0]
        np.testing.assert_allclose(pixels[3, 0], [255, half, 0], atol=1)
    assert isinstance(pane, ThinDielectric)
    np.testing.assert_allclose(pane.tint, [0.5, 0.25, 0.0], atol=1e-6)
