"""Tests that each material is one thing to the scene's file, to Mitsuba, to the tracer and to edits."""

import dataclasses
import typing

import numpy as np
import pytest
from support.checked import unchecked
from support.synthetic import quad, synthetic_scene

from datagen.disk.errors import HyalineError
from datagen.disk.records import from_json, to_json
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import SceneObject, SoftEnvironment
from datagen.scene.materials import (
    Conductor,
    Dielectric,
    Diffuse,
    ImageTexture,
    Material,
    Plastic,
    RoughDielectric,
    SolidTexture,
    ThinDielectric,
)
from datagen.scene.soundness import check_scene
from datagen.scene.substances import PARTINGS, SUBSTANCES, indices_of

use_mitsuba()

from datagen.render.mitsuba_scene import load_scene_mitsuba  # noqa: E402
from datagen.trace.light_path import LightPathTracer  # noqa: E402
from datagen.trace.surface_tables import Limits  # noqa: E402

SAMPLES: dict[type[Material], Material] = {
    Dielectric: Dielectric(ior=1.4, absorption=(1.0, 2.0, 3.0), tint=(0.9, 0.7, 0.2), priority=-2, dispersion=0.3),
    RoughDielectric: RoughDielectric(
        ior=1.4, absorption=(1.0, 2.0, 3.0), tint=(0.9, 0.7, 0.2), priority=-2, dispersion=0.3, roughness=0.001
    ),
    ThinDielectric: ThinDielectric(ior=1.4, tint=(0.9, 0.5, 0.2)),
    Diffuse: Diffuse(color=(0.2, 0.4, 0.6)),
    Plastic: Plastic(color=(0.2, 0.4, 0.6), ior=1.6, roughness=0.001),
    Conductor: Conductor(color=(0.9, 0.6, 0.3), roughness=0.0),
}
"""One of each material, smooth and without anything at its default."""

STRIPES = SolidTexture(pattern="stripes", colors=((0, 0, 0), (1, 1, 1)), scale=0.1)
FURNACE = SoftEnvironment(zenith=(1, 1, 1), horizon=(1, 1, 1), ground=(1, 1, 1))


@pytest.fixture(params=typing.get_args(Material), ids=lambda kind: kind.__name__)
def material(request: pytest.FixtureRequest) -> Material:
    """Each material that is listed; one without a sample fails."""
    return SAMPLES[request.param]


def test_a_material_is_read_as_it_was_written(material: Material) -> None:
    assert from_json(Material, to_json(material), where="here") == material  # type: ignore[arg-type]


def test_only_materials_that_light_passes_are_glass(material: Material) -> None:
    assert material.is_glass == (material.surface().event in ("passes", "refracts"))
    assert (material.medium is not None) == (material.surface().event == "refracts")


@pytest.mark.parametrize("cosine", [0.95, 0.5])
def test_the_tracer_splits_light_as_mitsuba_does(material: Material, cosine: float) -> None:
    """What is mirrored and what passes, by the tracer's throughput and by Mitsuba's own BSDF."""
    import mitsuba as mi

    d = np.array([[np.sqrt(1 - cosine**2), 0, -cosine]], np.float32)
    tracer = LightPathTracer((quad(0.0),), (material,))
    paths = tracer.trace(-d.copy(), d, Limits(max_branches=2))
    passed, mirrored = paths.end_throughput[0, 0], paths.end_throughput[1, 0]

    scene = dataclasses.replace(synthetic_scene(), environment=FURNACE)
    item = SceneObject(name="surface", mesh=quad(0.0), material=material)
    loaded = load_scene_mitsuba(dataclasses.replace(scene, objects=(item,)))
    si = loaded.ray_intersect(mi.Ray3f(mi.Point3f(*(-d[0]).tolist()), mi.Vector3f(*d[0].tolist())))
    draws = (np.arange(4096) + 0.5) / 4096
    rng = np.random.default_rng(0)
    sample, weight = si.bsdf().sample(
        mi.BSDFContext(), si, mi.Float(draws), mi.Point2f(rng.random((2, 4096)).astype(np.float32)), True
    )
    # Of plastic and of paint, what comes out of the base is no path's business.
    is_specular = np.array(mi.has_flag(sample.sampled_type, mi.BSDFFlags.Diffuse)) == 0
    is_up = np.array(sample.wo.z) > 0
    weights = np.broadcast_to(np.array(weight).reshape(3, -1).T, (4096, 3))
    for found, side in ((mirrored, is_up), (passed, ~is_up)):
        expected = np.where((is_specular & side)[:, None], weights, 0).mean(axis=0)
        assert found == pytest.approx(expected, abs=2e-3)


def test_every_texture_of_a_material_moves_with_its_object_and_is_found_by_its_field() -> None:
    painted = Plastic(color=STRIPES)
    assert painted.moved((0.5, 0.0, -0.25)) == Plastic(color=dataclasses.replace(STRIPES, origin=(0.5, 0.0, -0.25)))
    pictured = Diffuse(color=ImageTexture(path="a.png"))
    assert pictured.moved((1, 2, 3)) == pictured
    assert pictured.images() == {"color": ImageTexture(path="a.png")}
    assert painted.images() == {} == Conductor(color=(1, 1, 1)).textures()


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrostedGlass(Dielectric):
    """What a plug-in might bring: it derives from what is known, and is something else."""


def test_a_material_that_is_not_listed_is_refused_by_the_objects_name_instead_of_drawn_opaque() -> None:
    strange, message = FrostedGlass(), "its material is a FrostedGlass; expected one of Dielectric, RoughDielectric"
    scene = synthetic_scene()
    objects = tuple(dataclasses.replace(item, material=strange) for item in scene.objects[:1])
    with unchecked(), pytest.raises(HyalineError, match=rf"object {objects[0].name}: {message}"):
        check_scene(dataclasses.replace(scene, objects=objects))
    with unchecked(), pytest.raises(HyalineError, match=rf"^light paths: object 2: {message}"):
        LightPathTracer((quad(0.0), quad(1.0)), (None, strange))


ABBE = {
    "bk7": 64.17,
    "f2": 36.43,
    "sf10": 28.53,
    "sf11": 25.68,
    "fused-silica": 67.82,
    "water": 55.7,
    "diamond": 55.3,
    "sapphire": 72.3,
}
"""V_d of Schott's and Corning's data sheets; of water, diamond and sapphire as handbooks give it."""


@pytest.mark.parametrize("name", ABBE)
def test_measured_lines_give_the_abbe_number_of_the_data_sheet(name: str) -> None:
    red, green, blue = indices_of(name, "measured")
    assert (green - 1) / (blue - red) == pytest.approx(ABBE[name], rel=5e-3)
    assert green == SUBSTANCES[name]


def test_a_number_parts_red_and_blue_as_gltf_says_and_every_substance_blue_more() -> None:
    """The example of KHR_materials_dispersion: half a spread of (ior - 1) * 0.025 * dispersion on each side."""
    assert indices_of(1.5, 0.4) == pytest.approx((1.495, 1.5, 1.505))
    assert indices_of(1.5, 0.0) == (1.5, 1.5, 1.5)
    for name, (below, above) in PARTINGS.items():
        assert above > 1.5 * below > 0 or name == "air", name


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"dispersion": -0.1}, "dispersion: is -0.1; expected 20 over the Abbe number, from 0 to 20"),
        ({"dispersion": "much"}, "dispersion: is 'much'; expected a number, or 'measured'"),
        ({"dispersion": "measured"}, "dispersion: is 'measured' for ior 1.5; expected ior to be one of air, "),
        ({"ior": "ice", "dispersion": "measured"}, "dispersion: is 'measured' for ior 'ice'; expected ior to be one"),
    ],
)
def test_a_dispersion_that_is_not_known_is_refused(fields: dict, message: str) -> None:
    for kind in (Dielectric, RoughDielectric):
        with pytest.raises(HyalineError, match=f"^{message}"):
            kind(**fields)
