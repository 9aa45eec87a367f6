"""What a clear coat of `Plastic` takes of its base's colour, and the base that looks as a file's base colour should.

Other renderers give the colour of a surface as it is seen, but for what its highlight mirrors. Ours is that of a base
below a coat, out of which only some of the light finds its way: a base of 0.5 shows 0.28.
"""

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

ANGLES, POINTS = 64, 32
"""Directions that light comes from, and facets a side of the square that each of them meets."""


@dataclass(frozen=True, kw_only=True)
class Coat:
    """Shares of light, averaged over all directions from which it comes evenly."""

    mirrored: float
    """By the coat, from outside."""
    passed: float
    """Through the coat, in and out again, were the base white and nothing thrown back onto it."""
    returned: float
    """Of what the base scatters, back onto it."""

    def seen(self, base: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """What light from everywhere shows of a base, without what the coat mirrors."""
        return self.passed * base / (1 - self.returned * base)

    def base_of(self, color: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """The base that is seen in a colour where the coat mirrors nothing; above 1 where there is none."""
        wanted = (1 - self.mirrored) * color
        return wanted / (self.passed + self.returned * wanted)

    def with_mirrored(self, color: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """A matt colour that is as bright as this one with what the coat mirrors."""
        return self.mirrored + (1 - self.mirrored) * color


@functools.lru_cache(maxsize=256)
def coat_of(ior: float, alpha: float) -> Coat:
    """The coat of index `ior` and GGX roughness `alpha`, as Mitsuba's `roughplastic` tabulates it.

    Facets that throw light onto others lose it there: white below a coat of alpha 0.35 shows 0.61 of the light.
    """
    mirrored, through = _shares(ior, alpha)
    returned, _ = _shares(1 / ior, alpha)
    return Coat(mirrored=mirrored, passed=(through / ior) ** 2, returned=returned)


@functools.lru_cache(maxsize=256)
def metal_share(alpha: float) -> float:
    """The share of even light that facets of white metal mirror; they lose what they throw onto each other."""
    return _shares(1e6, alpha)[0]


def _shares(eta: float, alpha: float) -> tuple[float, float]:
    """How much of even light facets mirror, and let through to the side of relative index `eta`.

    Source: visible facets as in Heitz 2018, "Sampling the GGX Distribution of Visible Normals"; Smith's shadowing.
    """
    cosine = (np.arange(ANGLES) + 0.5)[:, None, None] / ANGLES
    u, v = np.meshgrid((np.arange(POINTS) + 0.5) / POINTS, (np.arange(POINTS) + 0.5) / POINTS)
    wi = np.stack(np.broadcast_arrays(np.sqrt(1 - cosine**2), 0.0, cosine), axis=-1)
    stretched = _unit(wi * (alpha, alpha, 1))
    # A point of the disk that is seen along the stretched direction.
    radius, angle = np.sqrt(u), 2 * np.pi * v
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    lean = (1 + stretched[..., 2]) / 2
    y = (1 - lean) * np.sqrt(1 - x**2) + lean * y
    across = np.zeros_like(stretched)
    across[..., 1] = 1.0
    facet = (
        x[..., None] * across
        + y[..., None] * np.cross(stretched, across)
        + np.sqrt(np.maximum(1 - x**2 - y**2, 0))[..., None] * stretched
    )
    m = _unit(np.concatenate([alpha * facet[..., :2], np.maximum(facet[..., 2:], 1e-6)], axis=-1))
    cos_i = np.clip((wi * m).sum(axis=-1), 0, 1)
    cos_t = np.sqrt(np.maximum(1 - (1 - cos_i**2) / eta**2, 0))
    with np.errstate(invalid="ignore"):
        s, p = (cos_i - eta * cos_t) / (cos_i + eta * cos_t), (cos_t - eta * cos_i) / (cos_t + eta * cos_i)
    fresnel = np.where(cos_t > 0, (s**2 + p**2) / 2, 1.0)
    mirrored = 2 * cos_i * m[..., 2] - wi[..., 2]
    refracted = wi[..., 2] / eta - m[..., 2] * (cos_i / eta - cos_t)
    weights = 2 * cosine / ANGLES / POINTS**2
    return (
        float((weights * fresnel * _unshadowed(mirrored, alpha)).sum()),
        float((weights * (1 - fresnel) * _unshadowed(refracted, alpha)).sum()),
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _unshadowed(cosine: np.ndarray, alpha: float) -> np.ndarray:
    """Share that other facets do not hide from a direction; none below the surface."""
    tangent2 = 1 / np.maximum(cosine, 1e-6) ** 2 - 1
    return np.where(cosine > 0, 2 / (1 + np.sqrt(1 + alpha**2 * np.maximum(tangent2, 0))), 0.0)
