"""Indices of refraction of glasses, crystals and liquids, by name."""

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
"""At the yellow line (d or D, 588 or 589 nm), liquids at 20 degrees, relative to air.

Sources: data sheets of Schott (N-BK7, N-F2, N-SF10, N-SF11) and Corning (7740); CRC Handbook of Chemistry and Physics
for liquids and ice; Malitson 1965 (fused silica) and 1962 (sapphire, ordinary ray); Rubin 1985 (clear soda-lime glass);
Sultanova et al. 2009 (acrylic, polycarbonate); Peter 1923 (diamond).
"""

Ior = float | str
"""An index of refraction, or the name of a substance."""

MAX_IOR = 10.0


def index_of(ior: Ior) -> float:
    """The number that it says, or that of the substance."""
    return SUBSTANCES[ior] if isinstance(ior, str) else ior


def check_ior(ior: Ior) -> None:
    """Refuses what is neither an index of refraction nor a substance that is known."""
    if isinstance(ior, str):
        if ior not in SUBSTANCES:
            raise HyalineError(f"ior: is {ior!r}; expected a number, or one of {', '.join(SUBSTANCES)}")
    elif not 1 <= ior < MAX_IOR:
        raise HyalineError(f"ior: is {ior}; expected an index of refraction of at least 1 (glass has 1.5)")
