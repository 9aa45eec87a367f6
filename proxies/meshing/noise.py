"""Proxies of kind `noise`: the true surface displaced by a smooth random field, to study how much error is tolerable.

A noisy mesh keeps the truth's faces and uv, and need not enclose anything; an open mesh stays open. Both walls of thin
glass move equally if they are closer than the field's correlation length, so a wall keeps its thickness to first order;
from an amount of a few hundredths, the field may fold, and walls may intersect.
"""

import numpy as np
from jaxtyping import Float64

from datagen.data.meshes import Mesh, face_areas
from datagen.disk.errors import HyalineError

AMOUNTS = (0.001, 0.05)
"""Least and greatest standard deviation, relative to an object's bounding-box diagonal."""

CORRELATION = 0.1
"""Distance at which the field's correlation has fallen to exp(-1/2), relative to the diagonal."""

EDGE_LENGTHS = 2.0
"""Least correlation length in typical edge lengths, so that coarse triangles can follow the field."""

WAVES = 256
"""Number of plane waves in the field."""

SEED = 20_220_608
"""Seed of an object's field, together with its index in the dataset."""


def check_amount(amount: float) -> None:
    """Raises a HyalineError for an amount outside of `AMOUNTS`."""
    if not AMOUNTS[0] <= amount <= AMOUNTS[1]:
        raise HyalineError(
            f"amount {amount:g}: expected {AMOUNTS[0]:g} to {AMOUNTS[1]:g}, relative to each object's diagonal"
        )


def noisy_mesh(truth: Mesh, amount: float, *, place: int) -> Mesh:
    """An object's mesh with noise, which is always the same for the same object and index.

    Args:
        amount: standard deviation along any direction, relative to the object's bounding-box diagonal.
        place: the object's index in its dataset, from 0.
    """
    return noisy(truth, amount, rng=np.random.default_rng((SEED, place)))


def noisy(truth: Mesh, amount: float, *, rng: np.random.Generator) -> Mesh:
    """The mesh with each position p moved to p + f(p), f a Gaussian random field of three independent coordinates.

    The field only depends on the position, so duplicate vertices move together and seams stay closed. Normals follow
    from the field's derivative instead of being averaged over faces: creases are kept, and without noise they equal
    the truth's. Over the positions of all faces' corners, f has exactly the requested root mean square.

    Source: Rahimi and Recht 2007, random Fourier features of the Gaussian kernel.
    """
    positions, position_of = np.unique(truth.vertices, axis=0, return_inverse=True)
    position_of = position_of.reshape(-1)
    # Vertices of no face move, too, but how far anything moves does not depend on them.
    used = np.unique(position_of[truth.faces])
    size = float(np.linalg.norm(np.ptp(positions[used].astype(np.float64), axis=0)))
    frequencies = rng.normal(size=(WAVES, 3)) / _correlation_length(truth, size)
    phases, weights = rng.uniform(0, 2 * np.pi, WAVES), rng.normal(size=(WAVES, 3))
    center = positions[used].mean(axis=0, dtype=np.float64)
    moved, gradients = _field(positions - center, frequencies, phases, weights)
    scale = amount * size / float(np.sqrt((moved[used] ** 2).mean()))
    # Normals transform with the cofactors of the derivative, which keep their sign where the field folds space.
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
    """The problem of a noisy mesh in a few words; None if it has the truth's faces and uv, and moved vertices."""
    if not (np.array_equal(mesh.faces, truth.faces) and np.array_equal(mesh.uv, truth.uv)):
        return "has other faces or another uv than its object"
    if np.array_equal(mesh.vertices, truth.vertices):
        return "has no noise"
    return None


def _correlation_length(truth: Mesh, size: float) -> float:
    """The correlation length in metres; the typical edge is the root of twice the area-weighted median face area."""
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
