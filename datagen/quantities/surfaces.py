"""What a dataset's objects are: their materials and meshes, looked up by the object ids and uv of layers."""

import dataclasses
import functools
import weakref
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.meshes import Mesh
from datagen.data.paths import TRUTH
from datagen.scene.description import Scene, image_bytes
from datagen.scene.folder import open_scene
from datagen.scene.images import linear_pixels, look_up
from datagen.scene.materials import (
    Conductor,
    Diffuse,
    ImageTexture,
    Material,
    Plastic,
    Reflectance,
    RoughDielectric,
    SolidTexture,
)
from datagen.scene.textures import evaluate_texture

if TYPE_CHECKING:
    from datagen.trace.light_path import LightPathTracer
    from datagen.trace.peel import Peeler


@dataclass(frozen=True, kw_only=True, eq=False)
class Surfaces:
    """The true geometry of a dataset and its materials. Tables are indexed by object id; 0 means no object."""

    scene: Scene
    meshes: tuple[Mesh, ...]
    """In object order, verified; the mesh of object id i is `meshes[i - 1]`."""
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
    def peeler(self) -> "Peeler":
        """Finds the faces along rays. Call `use_mitsuba` first."""
        from datagen.trace.peel import Peeler

        return Peeler(self.meshes)

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
