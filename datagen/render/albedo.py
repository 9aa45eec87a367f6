"""The light that rough surfaces keep. Paths do not follow light from one facet to another, which would be lost.

Single scattering keeps a share of the light that falls on GGX facets from one direction: their albedo E. The truth and
light paths divide by it, so that white surfaces keep all light; the lobes keep their shapes. Light that leaves metal of
reflectance c after n facets has the share c^n E (1 - E)^(n - 1), so its lobe is divided by 1 - c (1 - E).
Source: Turquin 2019, "Practical multiple scattering compensation for microfacet models"; his factor for metal, of
light on one or two facets, is 1 + c (1 - E) / E.
"""

import functools

import numpy as np
from jaxtyping import Float, Float32
from numpy.typing import ArrayLike

AZIMUTHS, HEIGHTS = 16, 32
"""Facets that each direction meets."""
SHAPE = INDICES, ALPHAS, COSINES = 33, 16, 16
"""Entries of the table, which is bilinear in between: 0.3 % off (root mean square, at cosines above 0.1)."""
LEAST = 1e-2
"""Albedo below which light is lost: of facets seen edge-on between nearly equal indices."""
ANGLES = 64
"""Directions from which light comes evenly."""


def facet_shares(cosine: ArrayLike, alpha: ArrayLike, eta: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Shares of light that facets mirror and let through, without light that meets further facets.

    Args:
        cosine: of the angle between the light and the surface's normal.
        alpha: GGX roughness, more than 0.
        eta: index of refraction behind the surface over that in front.
    """
    cosine, alpha, eta = (np.asarray(values, np.float32)[..., None, None] for values in (cosine, alpha, eta))
    # Half of the azimuths; the others mirror them. Most points are where facets are steep, whose share changes most.
    azimuth = (np.arange(AZIMUTHS, dtype=np.float32)[:, None] + 0.5) / AZIMUTHS * np.pi
    steep = 1 - (np.arange(HEIGHTS, dtype=np.float32) + 0.5) / HEIGHTS
    sine = np.sqrt(1 - cosine**2)
    stretch = np.hypot(alpha * sine, cosine)
    x, z = alpha * sine / stretch, cosine / stretch
    height = steep**2 * (1 + z) - z
    radius = np.sqrt(np.maximum(1 - height**2, 0))
    m_x, m_y, m_z = alpha * (radius * np.cos(azimuth) + x), alpha * radius * np.sin(azimuth), height + z
    length = np.sqrt(m_x**2 + m_y**2 + m_z**2)
    m_x, m_z = m_x / length, m_z / length

    cos_i = np.clip(sine * m_x + cosine * m_z, 0, 1)
    cos_t = np.sqrt(np.maximum(1 - (1 - cos_i**2) / eta**2, 0))
    s, p = (cos_i - eta * cos_t) / (cos_i + eta * cos_t), (cos_t - eta * cos_i) / (cos_t + eta * cos_i)
    reflectance = np.where(cos_t > 0, (s**2 + p**2) / 2, 1)
    weights = steep / steep.sum() / AZIMUTHS
    mirrored = reflectance * _unshadowed(2 * cos_i * m_z - cosine, alpha)
    passed = (1 - reflectance) * _unshadowed(cosine / eta - m_z * (cos_i / eta - cos_t), alpha)
    return (weights * mirrored).sum(axis=(-2, -1)), (weights * passed).sum(axis=(-2, -1))


def _unshadowed(cosine: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Share that other facets do not hide from a direction; none below the surface."""
    tangent2 = 1 / np.maximum(cosine, 1e-6) ** 2 - 1
    return np.where(cosine > 0, 2 / (1 + np.sqrt(1 + alpha**2 * np.maximum(tangent2, 0))), 0)


@functools.cache
def albedo_table() -> Float32[np.ndarray, "index alpha cosine"]:
    """The albedo by index of refraction (the signed square root of (eta - 1) / (eta + 1)), alpha, and root of the
    cosine, each from end to end."""
    table = np.ones(SHAPE, np.float32)
    alpha = np.linspace(0, 1, ALPHAS)[1:, None]
    cosine = np.maximum(np.linspace(0, 1, COSINES), 1e-2) ** 2
    for index, root in enumerate(np.linspace(-1, 1, INDICES)):
        contrast = np.clip(root * abs(root), -1 + 1e-6, 1 - 1e-6)
        mirrored, passed = facet_shares(cosine, alpha, (1 + contrast) / (1 - contrast))
        table[index, 1:] = np.maximum(mirrored + passed, LEAST)
    return table


# Clear coats


@functools.lru_cache(maxsize=256)
def mirrored_by_coat(ior: float, alpha: float) -> float:
    """Share of light from everywhere that a coat mirrors."""
    cosine = (np.arange(ANGLES) + 0.5) / ANGLES
    mirrored, passed = facet_shares(cosine, alpha, ior)
    return float((mirrored / (mirrored + passed) * cosine).sum() / cosine.sum())


def below_coat(base: Float[np.ndarray, "..."], ior: float, alpha: float) -> Float[np.ndarray, "..."]:
    """The base with which Mitsuba's `roughplastic`, divided by the coat's albedo, loses no light; above 1 for white.

    Of the light that comes out of the base, through / ior^2 leaves the coat (reciprocity); Mitsuba loses some of it.
    """
    cosine = (np.arange(ANGLES) + 0.5) / ANGLES
    weights = cosine / cosine.sum()
    through = 1 - mirrored_by_coat(ior, alpha)
    lossy_through = (weights * facet_shares(cosine, alpha, ior)[1]).sum()
    ends = np.linspace(1e-6, 1, ANGLES)  # As in Mitsuba, whose sum counts both ends like the others.
    lossy_back = 2 * (ends * facet_shares(ends, alpha, 1 / ior)[0]).mean()
    shown = base / (1 - (1 - through / ior**2) * base) * through / lossy_through
    return shown / (1 + lossy_back * shown)
