"""Tests the indices of substances against the Abbe numbers of their data sheets."""

import pytest

from datagen.disk.errors import HyalineError
from datagen.scene.materials import Dielectric, RoughDielectric
from datagen.scene.substances import PARTINGS, SUBSTANCES, indices_of

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


def test_every_substance_parts_blue_from_green_more_than_green_from_red() -> None:
    for name, (below, above) in PARTINGS.items():
        assert above > 1.5 * below > 0 or name == "air", name


def test_a_number_parts_red_and_blue_as_gltf_says() -> None:
    """The example of KHR_materials_dispersion: half a spread of (ior - 1) * 0.025 * dispersion on each side."""
    assert indices_of(1.5, 0.4) == pytest.approx((1.495, 1.5, 1.505))
    red, green, blue = indices_of("bk7", 20 / 64.17)
    assert (green - 1) / (blue - red) == pytest.approx(64.17)
    assert indices_of(1.5, 0.0) == (1.5, 1.5, 1.5)


@pytest.mark.parametrize("kind", [Dielectric, RoughDielectric])
def test_a_dispersion_that_is_not_known_is_refused(kind: type[Dielectric]) -> None:
    with pytest.raises(HyalineError, match=r"^dispersion: is -0.1; expected 20 over the Abbe number, from 0 to 20"):
        kind(dispersion=-0.1)
    with pytest.raises(HyalineError, match=r"^dispersion: is 'much'; expected a number, or 'measured'"):
        kind(dispersion="much")
    with pytest.raises(HyalineError, match=r"^dispersion: is 'measured' for ior 1.5; expected ior to be one of air, "):
        kind(dispersion="measured")
    with pytest.raises(HyalineError, match=r"^dispersion: is 'measured' for ior 'ice'; expected ior to be one of"):
        kind(ior="ice", dispersion="measured")
