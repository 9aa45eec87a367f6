"""Faces of a mesh, found by uv and position: where stored layers lie on the surface, without tracing a ray again."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.data.meshes import Mesh

MAX_SIDE = 1024
"""Cells a side of the grid over uv in which faces are listed."""

MARGIN = 1e-5
"""By which a face's box in uv is larger than the face: stored uv are off by up to 7.6e-6."""

HITS_AT_ONCE = 1 << 17


@dataclass(frozen=True, kw_only=True, eq=False)
class FacePoints:
    """Points of a mesh's surface."""

    face: Int[np.ndarray, " hit"]
    weights: Float[np.ndarray, "hit 3"]
    """Barycentric: how much each corner of the face counts; they add up to 1."""
    distance: Float[np.ndarray, " hit"]
    """Metres between the point on the face and the position that was asked for."""


class FaceFinder:
    """A mesh whose faces are listed by cell of its atlas."""

    def __init__(self, mesh: Mesh) -> None:
        self._uv = mesh.uv[mesh.faces].astype(np.float64)
        self._positions = mesh.vertices[mesh.faces].astype(np.float64)
        count = len(mesh.faces)
        self._side = int(np.clip(np.sqrt(count), 1, MAX_SIDE))
        low, high = self._cells(self._uv.min(axis=1) - MARGIN), self._cells(self._uv.max(axis=1) + MARGIN)
        size = high - low + 1
        face, place = _spread(size.prod(axis=-1))
        row, column = np.divmod(place, size[face, 0])
        cell = (low[face, 1] + row) * self._side + low[face, 0] + column
        order = np.argsort(cell, kind="stable")
        self._faces = face[order]
        self._first = np.searchsorted(cell[order], np.arange(self._side**2 + 1))

    def find(self, uv: Float[np.ndarray, "hit 2"], position: Float[np.ndarray, "hit 3"]) -> FacePoints:
        """The point of the surface that has a uv; of several, the one nearest to the position (metres, world)."""
        blocks = [
            self._find(uv[first : first + HITS_AT_ONCE], position[first : first + HITS_AT_ONCE])
            for first in range(0, max(len(uv), 1), HITS_AT_ONCE)
        ]
        return FacePoints(
            face=np.concatenate([block.face for block in blocks]),
            weights=np.concatenate([block.weights for block in blocks]),
            distance=np.concatenate([block.distance for block in blocks]),
        )

    def _find(self, uv: Float[np.ndarray, "hit 2"], position: Float[np.ndarray, "hit 3"]) -> FacePoints:
        cells = self._cells(uv)
        cell = cells[:, 1] * self._side + cells[:, 0]
        hit, place = _spread(self._first[cell + 1] - self._first[cell])
        face = self._faces[self._first[cell[hit]] + place]
        weights = _barycentric(self._uv[face], uv[hit])
        nearest = np.einsum("hk,hkc->hc", weights, self._positions[face])
        distance = np.linalg.norm(nearest - position[hit], axis=-1)
        order = np.lexsort((distance, hit))
        best = order[np.searchsorted(hit[order], np.arange(len(uv)))]
        assert np.array_equal(hit[best], np.arange(len(uv))), "every uv of a layer lies in a face"
        return FacePoints(face=face[best], weights=weights[best], distance=distance[best])

    def _cells(self, uv: Float[np.ndarray, "*any 2"]) -> Int[np.ndarray, "*any 2"]:
        return np.clip(np.floor(uv * self._side), 0, self._side - 1).astype(np.int64)


def _spread(counts: Int[np.ndarray, " item"]) -> tuple[Int[np.ndarray, " entry"], Int[np.ndarray, " entry"]]:
    """For items with so many entries each: of every entry its item, and its place among the item's entries."""
    item = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return item, np.arange(len(item)) - first[item]


def _barycentric(corners: Float[np.ndarray, "pair 3 2"], uv: Float[np.ndarray, "pair 2"]) -> np.ndarray:
    """Barycentric weights (pair, 3) of the points of triangles at uv, or next to it where that is outside."""
    e1, e2, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], uv - corners[:, 0]
    area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    safe = np.where(np.abs(area) > 1e-14, area, np.inf)  # A face without area in the atlas: its first corner.
    w1 = (d[:, 0] * e2[:, 1] - d[:, 1] * e2[:, 0]) / safe
    w2 = (e1[:, 0] * d[:, 1] - e1[:, 1] * d[:, 0]) / safe
    weights = np.clip(np.stack([1 - w1 - w2, w1, w2], axis=-1), 0, 1)
    return weights / weights.sum(axis=-1, keepdims=True)
