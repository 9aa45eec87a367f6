"""What a dataset's objects are: their materials and meshes, looked up by the object ids and uv of layers."""

import dataclasses
import functools
import weakref
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.meshes import Mesh
from datagen.data.paths import TRUTH
from datagen.scene.description import Scene, image_bytes
from datagen.scene.folder import open_scene
from datagen.scene.images import linear_pixels, look_up
from datagen.scene.materials import Conductor, Diffuse, Material, Plastic, RoughDielectric
from datagen.scene.textures import ImageTexture, Reflectance, SolidTexture, evaluate_texture

if TYPE_CHECKING:
    from datagen.trace.light_path import LightPathTracer

MAX_SIDE = 1024
"""Largest number of cells per side of the uv grid that lists faces."""

MARGIN = 1e-5
"""Added around a face's bounding box in uv: stored uv are off by up to 7.6e-6."""

HITS_AT_ONCE = 1 << 17


@dataclass(frozen=True, kw_only=True, eq=False)
class FacePoints:
    """Points of a mesh's surface."""

    face: Int[np.ndarray, " hit"]
    weights: Float[np.ndarray, "hit 3"]
    """Barycentric weights of the face's corners; they add up to 1."""
    distance: Float[np.ndarray, " hit"]
    """Metres between the point on the face and the requested position."""


class FaceFinder:
    """Finds the faces of a mesh by uv and position, without tracing rays; faces are listed by cell of the atlas."""

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
        """The surface point with each uv; of several, the one nearest to the position (metres, world)."""
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
    """For items with `counts` entries each: the item of every entry, and the entry's place within its item."""
    item = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return item, np.arange(len(item)) - first[item]


def _barycentric(corners: Float[np.ndarray, "pair 3 2"], uv: Float[np.ndarray, "pair 2"]) -> np.ndarray:
    """Barycentric weights (pair, 3) of uv in triangles, clipped to the triangle."""
    e1, e2, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], uv - corners[:, 0]
    area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    safe = np.where(np.abs(area) > 1e-14, area, np.inf)  # A face without area in uv gives its first corner.
    w1 = (d[:, 0] * e2[:, 1] - d[:, 1] * e2[:, 0]) / safe
    w2 = (e1[:, 0] * d[:, 1] - e1[:, 1] * d[:, 0]) / safe
    weights = np.clip(np.stack([1 - w1 - w2, w1, w2], axis=-1), 0, 1)
    return weights / weights.sum(axis=-1, keepdims=True)


@dataclass(frozen=True, kw_only=True, eq=False)
class Surfaces:
    """The true geometry of a dataset and its materials. Tables are indexed by object id; 0 means no object."""

    scene: Scene
    meshes: tuple[Mesh, ...]
    """In object order, verified; the mesh of object id i is `meshes[i - 1]`."""
    _finders: dict[int, FaceFinder] = field(default_factory=dict, repr=False)
    _images: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def materials(self) -> tuple[Material, ...]:
        """Materials in object order."""
        return tuple(item.material for item in self.scene.objects)

    @property
    def is_glass(self) -> Bool[np.ndarray, " id"]:
        """Whether an object is transparent."""
        return np.array([False, *(material.is_glass for material in self.materials)])

    @property
    def is_solid(self) -> Bool[np.ndarray, " id"]:
        """Whether an object is solid glass or liquid; thin panes are not."""
        return np.array([False, *(material.medium is not None for material in self.materials)])

    @property
    def ior(self) -> Float32[np.ndarray, " id"]:
        """Index of refraction of glass, liquids and thin panes; 0 for everything else."""
        values = [material.surface().ior if material.is_glass else 0.0 for material in self.materials]
        return np.array([0.0, *values], np.float32)

    @property
    def ior_by_channel(self) -> Float32[np.ndarray, "id 3"]:
        """`ior` for red, green and blue, which differ where glass disperses; thin panes do not disperse."""
        media = [material.medium for material in self.materials]
        values = np.repeat(self.ior[:, None], 3, axis=1)
        for place, medium in enumerate(media, 1):
            if medium is not None:
                values[place] = medium.iors
        return values

    def face_finder(self, object_id: int) -> FaceFinder:
        """Finds the faces of an object that layers lie on."""
        if object_id not in self._finders:
            self._finders[object_id] = FaceFinder(self.meshes[object_id - 1])
        return self._finders[object_id]

    def albedo(
        self, object_id: int, uv: Float[np.ndarray, "hit 2"], position: Float[np.ndarray, "hit 3"]
    ) -> Float32[np.ndarray, "hit 3"]:
        """Linear reflectance (Rec. 709) of an object at points on it; NaN for materials without one, such as glass."""
        match self.materials[object_id - 1]:
            case Diffuse(color=color) | Plastic(color=color) | Conductor(color=color):
                return self._reflectance(color, uv, position)
            case _:
                return np.full((len(uv), 3), np.nan, np.float32)

    @functools.cached_property
    def tracer(self) -> "LightPathTracer":
        """Follows light through the scene; rough glass counts as smooth. Call `use_mitsuba` first."""
        from datagen.trace.light_path import LightPathTracer
        from datagen.trace.surface_tables import tints_of

        smooth = (
            dataclasses.replace(material, roughness=0.0) if isinstance(material, RoughDielectric) else material
            for material in self.materials
        )
        return LightPathTracer(self.meshes, tuple(smooth), tints_of(self.scene, own_uv=True))

    def _reflectance(
        self, color: Reflectance, uv: Float[np.ndarray, "hit 2"], position: Float[np.ndarray, "hit 3"]
    ) -> Float32[np.ndarray, "hit 3"]:
        match color:
            case SolidTexture():
                return evaluate_texture(color, position)
            case ImageTexture(path=path):
                if path not in self._images:
                    self._images[path] = linear_pixels(image_bytes(self.scene, color), where=path)
                return look_up(self._images[path], uv, repeats=False).astype(np.float32)
            case _:
                return np.tile(np.array(color, np.float32), (len(uv), 1))


_OPENED: "weakref.WeakKeyDictionary[Dataset, Surfaces]" = weakref.WeakKeyDictionary()


def surfaces_of(dataset: Dataset) -> Surfaces:
    """The surfaces of an opened dataset, read once and verified."""
    if dataset not in _OPENED:
        meshes = read_meshes(dataset, TRUTH)
        scene = open_scene(dataset)
        _OPENED[dataset] = Surfaces(scene=scene, meshes=meshes)
    return _OPENED[dataset]
