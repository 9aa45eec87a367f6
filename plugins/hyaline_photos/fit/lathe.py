"""Outlines, and the meshes that they sweep around an axis."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from datagen.data.meshes import Mesh

SEGMENTS = 96
"""Around the axis; 64 lose 1 dB on a tumbler of the true shape."""

CREASE_COS = np.cos(np.radians(35))
"""Edges of an outline that turn by more are shaded as edges."""

TURNS = 0.05
"""A turn by one radian gets as many points as this share of the outside's length: evenly spaced points would cut off
the edge of a thin foot."""

Outline = Float64[np.ndarray, "_ 2"]
"""Points (radius, height along the axis) in metres, from the axis at the bottom and back to it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Axis:
    """A line in space."""

    point: Float64[np.ndarray, "3"]
    direction: Float64[np.ndarray, "3"]

    def moved(self, tilt: Float[np.ndarray, "2"], shift: Float[np.ndarray, "2"]) -> "Axis":
        """Shifted across (metres) and tilted by small amounts (radians) along two directions perpendicular to it."""
        frame = perpendicular(self.direction)
        direction = self.direction + tilt @ frame
        return Axis(point=self.point + shift @ frame, direction=direction / np.linalg.norm(direction))


def perpendicular(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "2 3"]:
    """Two unit vectors perpendicular to a direction and to each other; right-handed, the direction being third."""
    first = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def revolved(axis: Axis, outline: Outline) -> Mesh:
    """The solid that an outline sweeps around an axis; u goes around, v along the outline, edge by edge."""
    edges = np.diff(outline, axis=0)
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    # Each edge has two rings of its own, which share the normals of its neighbours unless there is a crease.
    starts, ends = normals.copy(), normals.copy()
    smooth = np.einsum("ec,ec->e", normals[:-1], normals[1:]) > CREASE_COS
    mean = normals[:-1] + normals[1:]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    ends[:-1][smooth], starts[1:][smooth] = mean[smooth], mean[smooth]
    rings = np.stack([outline[:-1], outline[1:]], axis=1).reshape(-1, 2)
    ring_normals = np.stack([starts, ends], axis=1).reshape(-1, 2)
    u, v = perpendicular(axis.direction)
    angles = (np.arange(SEGMENTS + 1) % SEGMENTS * (2 * np.pi / SEGMENTS))[:, None]  # The last repeats the first.
    outward = np.cos(angles) * u + np.sin(angles) * v
    swept, turned = (
        values[:, :1, None] * outward + values[:, None, 1:] * axis.direction for values in (rings, ring_normals)
    )
    index = np.arange(len(rings) * (SEGMENTS + 1)).reshape(-1, SEGMENTS + 1)
    low, high = index[0::2], index[1::2]
    lower = np.stack([low[:, :-1], low[:, 1:], high[:, 1:]], axis=-1)
    upper = np.stack([low[:, :-1], high[:, 1:], high[:, :-1]], axis=-1)
    # At the axis a quadrangle is one triangle.
    faces = np.concatenate([lower[1:].reshape(-1, 3), upper[:-1].reshape(-1, 3)])
    along = np.repeat(np.arange(len(outline)), 2)[1:-1] / (len(outline) - 1)
    uv = np.stack(np.broadcast_arrays(np.linspace(0, 1, SEGMENTS + 1), along[:, None]), axis=-1)
    return Mesh(
        vertices=(axis.point + swept).reshape(-1, 3).astype(np.float32),
        faces=faces.astype(np.int32),
        normals=turned.reshape(-1, 3).astype(np.float32),
        uv=uv.reshape(-1, 2).astype(np.float32),
    )


def spread(line: Outline, count: int) -> Outline:
    """Points along a line, the closer the more it turns."""
    ways = np.linalg.norm(np.diff(line, axis=0), axis=1)
    tangents = np.diff(line, axis=0) / np.maximum(ways, 1e-12)[:, None]
    turns = np.arccos(np.clip((tangents[1:] * tangents[:-1]).sum(axis=1), -1, 1))
    lengths = ways + TURNS * ways.sum() * (np.append(turns, 0) + np.insert(turns, 0, 0)) / 2
    return _at_shares(line, np.insert(np.cumsum(lengths), 0, 0), count)


def evenly(line: Outline, count: int) -> Outline:
    """Points along a line at even distances."""
    return _at_shares(line, lengths_of(line), count)


def _at_shares(line: Outline, lengths: Float64[np.ndarray, " point"], count: int) -> Outline:
    """Points along a line at even steps of a length that grows along it."""
    steps = np.linspace(0, lengths[-1], count)
    return np.stack([np.interp(steps, lengths, line[:, axis]) for axis in range(2)], axis=1)


def point_at(line: Outline, reach: float) -> Float64[np.ndarray, "2"]:
    """The point of a line this far along it."""
    return np.array([np.interp(reach, lengths_of(line), line[:, axis]) for axis in range(2)])


def lengths_of(line: Outline) -> Float64[np.ndarray, " point"]:
    """How far along the line each point is."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
