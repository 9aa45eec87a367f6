"""Indices of refraction of glasses, crystals and liquids, by name."""

import functools
import math

from datagen.disk.errors import HyalineError

SUBSTANCES: dict[str, float] = {
    "air": 1.0,
    "ice": 1.309,
    "water": 1.333,
    "acetone": 1.359,
    "ethanol": 1.361,
    "fused-silica": 1.4585,
    "pyrex": 1.474,
    "glycerol": 1.4746,
    "acrylic": 1.491,
    "benzene": 1.501,
    "bk7": 1.5168,
    "soda-lime": 1.523,
    "polycarbonate": 1.585,
    "f2": 1.62,
    "sf10": 1.7283,
    "sapphire": 1.768,
    "sf11": 1.7847,
    "diamond": 2.417,
}
"""Index of refraction at the yellow line (d or D, 588 or 589 nm), liquids at 20 degrees Celsius, relative to air.

Sources: data sheets of Schott (N-BK7, N-F2, N-SF10, N-SF11) and Corning (7740); CRC Handbook of Chemistry and Physics
for liquids and ice; Malitson 1965 (fused silica) and 1962 (sapphire, ordinary ray); Rubin 1985 (clear soda-lime glass);
Sultanova et al. 2009 (acrylic, polycarbonate); Peter 1923 (diamond).
"""

MEASURED = "measured"

PARTINGS: dict[str, tuple[float, float]] = {
    "air": (0.0, 0.0),
    "water": (0.00189, 0.00409),
    "acetone": (0.00194, 0.00465),
    "ethanol": (0.00182, 0.00428),
    "fused-silica": (0.00209, 0.00467),
    "acrylic": (0.00274, 0.00648),
    "bk7": (0.00248, 0.00558),
    "soda-lime": (0.00255, 0.00564),
    "polycarbonate": (0.00615, 0.01484),
    "f2": (0.00499, 0.01203),
    "sf10": (0.00737, 0.01815),
    "sapphire": (0.00329, 0.00734),
    "sf11": (0.00876, 0.02179),
    "diamond": (0.00758, 0.01805),
}
"""Difference from the index at the yellow line to that at the red (C, 656.3 nm) and the blue line (F, 486.1 nm).

By the dispersion formulas of the sources above; water: Daimon and Masumura 2007 (20 °C); acetone and ethanol: Rheims.
"""

Ior = float | str
"""An index of refraction, or the name of a substance."""

Dispersion = float | str
"""20 over the Abbe number V_d = (n_d - 1) / (n_F - n_C), as in glTF, or `measured` for a named substance's own."""

MAX_IOR = 10.0
MAX_DISPERSION = 20.0
"""Largest dispersion: an Abbe number of 1, where glass has 20 to 85."""


def index_of(ior: Ior) -> float:
    """The index itself, or that of the named substance."""
    return SUBSTANCES[ior] if isinstance(ior, str) else ior


@functools.cache
def indices_of(ior: Ior, dispersion: Dispersion) -> tuple[float, float, float]:
    """The index of each colour channel: n_C for red, n_d for green and n_F for blue.

    Source for numbers: KHR_materials_dispersion's README, in which red and blue differ equally from green.
    """
    index = index_of(ior)
    if isinstance(dispersion, str):
        assert isinstance(ior, str)
        below, above = PARTINGS[ior]
    else:
        below = above = (index - 1) * dispersion / 40
    return index - below, index, index + above


def check_ior(ior: Ior) -> None:
    """Checks that it is an index of refraction or a known substance."""
    if isinstance(ior, str):
        if ior not in SUBSTANCES:
            raise HyalineError(f"ior: is {ior!r}; expected a number, or one of {', '.join(SUBSTANCES)}")
    elif not 1 <= ior < MAX_IOR:
        raise HyalineError(
            f"ior: is {ior}; expected an index of refraction from 1 to below {MAX_IOR:g} (glass has 1.5)"
        )


def check_dispersion(ior: Ior, dispersion: Dispersion) -> None:
    """Checks that it is a number in range, or `measured` for a substance with known lines."""
    if not isinstance(dispersion, str):
        if not (math.isfinite(dispersion) and 0 <= dispersion <= MAX_DISPERSION):
            raise HyalineError(
                f"dispersion: is {dispersion}; expected 20 over the Abbe number, from 0 to {MAX_DISPERSION:g}"
            )
    elif dispersion != MEASURED:
        raise HyalineError(f"dispersion: is {dispersion!r}; expected a number, or {MEASURED!r}")
    elif ior not in PARTINGS:
        raise HyalineError(
            f"dispersion: is {MEASURED!r} for ior {ior!r}; expected ior to be one of {', '.join(PARTINGS)}"
        )
