"""Proxies of kind `noise`: the true surface displaced by a smooth random field, to study how much error is tolerable.

A noisy mesh keeps the truth's faces and uv, so it needs no room of its own and encloses nothing. An open mesh stays
open. Both walls of thin glass move alike where they are closer than the field's correlation length, so a wall keeps its
thickness to first order; from an amount of a few hundredths on, the field may fold and walls run into each other.
"""

import numpy as np
from jaxtyping import Float64

from datagen.data.meshes import Mesh, face_areas
from datagen.disk.errors import HyalineError

AMOUNTS = (0.001, 0.05)
"""Least and greatest standard deviation that is accepted, in parts of an object's bounding-box diagonal."""

CORRELATION = 0.1
"""Distance over which the field varies, in parts of the diagonal: its correlation there has fallen to exp(-1/2)."""

EDGE_LENGTHS = 2.0
"""Yet never less than this many edges of typical length, or coarse triangles could not follow the field."""

WAVES = 256
"""Plane waves that make up the field."""

SEED = 20_220_608
"""With an object's place in its dataset, the seed of its field."""


def check_amount(amount: float) -> None:
    """Refuses an amount of noise that is no small share of an object."""
    if not AMOUNTS[0] <= amount <= AMOUNTS[1]:
        raise HyalineError(
            f"amount {amount:g}: expected {AMOUNTS[0]:g} to {AMOUNTS[1]:g}, parts of each object's diagonal"
        )


def noisy_mesh(truth: Mesh, amount: float, *, place: int) -> Mesh:
    """An object's mesh with noise of its own; the same object in the same place always gets the same.

    Args:
        amount: standard deviation along any direction, in parts of the object's bounding-box diagonal.
        place: of the object in its dataset, from 0.
    """
    return noisy(truth, amount, rng=np.random.default_rng((SEED, place)))


def noisy(truth: Mesh, amount: float, *, rng: np.random.Generator) -> Mesh:
    """The mesh with each position p moved to p + f(p), f a Gaussian random field of three independent coordinates.

    The field depends on the position alone, so vertices that stand several times move together and no seam opens.
    Normals turn with the field's derivative rather than being averaged over faces: creases stay, and without noise
    they would be the truth's. Over the vertices, a coordinate of f has exactly the root mean square asked for.

    Source: Rahimi and Recht 2007, random Fourier features of the Gaussian kernel.
    """
    positions, position_of = np.unique(truth.vertices, axis=0, return_inverse=True)
    position_of = position_of.reshape(-1)
    size = float(np.linalg.norm(np.ptp(positions.astype(np.float64), axis=0)))
    frequencies = rng.normal(size=(WAVES, 3)) / _correlation_length(truth, size)
    phases, weights = rng.uniform(0, 2 * np.pi, WAVES), rng.normal(size=(WAVES, 3))
    center = positions.mean(axis=0, dtype=np.float64)
    moved, gradients = _field(positions - center, frequencies, phases, weights)
    scale = amount * size / float(np.sqrt((moved**2).mean()))
    # Areas turn with the cofactors of the derivative, which keep their sense where the field folds space over.
    a, b, c = np.moveaxis(np.eye(3) + scale * gradients[position_of], -1, 0)
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    normals = np.einsum("vij,vj->vi", cofactors, truth.normals.astype(np.float64))
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    return Mesh(
        vertices=(positions + scale * moved)[position_of].astype(np.float32),
        faces=truth.faces,
        normals=np.where(lengths > 0, normals / np.where(lengths > 0, lengths, 1), truth.normals).astype(np.float32),
        uv=truth.uv,
    )


def noise_problem(mesh: Mesh, truth: Mesh) -> str | None:
    """What is wrong with a noisy mesh, in a few words; None when it has the truth's faces and uv, in other places."""
    if not (np.array_equal(mesh.faces, truth.faces) and np.array_equal(mesh.uv, truth.uv)):
        return "has other faces or another uv than its object"
    if np.array_equal(mesh.vertices, truth.vertices):
        return "has no noise"
    return None


def _correlation_length(truth: Mesh, size: float) -> float:
    """In metres; the typical edge is the root of twice the median area per face, half of the area being in larger."""
    areas = np.sort(face_areas(truth))
    typical = areas[np.searchsorted(np.cumsum(areas), 0.5 * areas.sum())]
    return max(CORRELATION * size, EDGE_LENGTHS * float(np.sqrt(2 * typical)))


def _field(
    points: Float64[np.ndarray, "point 3"], frequencies: np.ndarray, phases: np.ndarray, weights: np.ndarray
) -> tuple[Float64[np.ndarray, "point 3"], Float64[np.ndarray, "point 3 3"]]:
    """The field at the points, and its derivative: row i holds how coordinate i changes along x, y and z."""
    values, gradients = [], []
    for start in range(0, len(points), 4096):
        angles = points[start : start + 4096] @ frequencies.T + phases
        values.append(np.cos(angles) @ weights)
        gradients.append(np.einsum("pw,wi,wj->pij", -np.sin(angles), weights, frequencies, optimize=True))
    return np.concatenate(values), np.concatenate(gradients)
