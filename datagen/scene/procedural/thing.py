"""One thing of a random scene: objects that belong together, standing on z = 0 around the z axis."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.description import SceneObject
from datagen.scene.materials import Dielectric
from datagen.scene.modelling import moved, rotation, transformed


@dataclass(frozen=True, kw_only=True, eq=False)
class Thing:
    """Such as a glass, its drink and the ice in it."""

    words: str
    """What it is, for the scene's description."""
    objects: tuple[SceneObject, ...]
    """The outermost first."""

    @property
    def reach(self) -> float:
        """Radius in metres of the upright cylinder around the z axis that holds it."""
        return max(float(np.linalg.norm(item.mesh.vertices[:, :2], axis=-1).max()) for item in self.objects)

    @property
    def height(self) -> float:
        """Metres from the lowest to the highest point."""
        low = min(float(item.mesh.vertices[:, 2].min()) for item in self.objects)
        return max(float(item.mesh.vertices[:, 2].max()) for item in self.objects) - low

    @property
    def is_glass(self) -> bool:
        """Whether any of it is glass."""
        return any(item.material.is_glass for item in self.objects)


def standing(mesh: Mesh) -> Mesh:
    """The mesh with its lowest point at z = 0 and its middle over the origin."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return moved(mesh, (-float(low[0] + high[0]) / 2, -float(low[1] + high[1]) / 2, -float(low[2])))


def put(thing: Thing, place: tuple[float, float, float], *, turn_deg: float = 0.0) -> Thing:
    """The thing turned about its axis and moved; its textures come along."""
    linear = rotation((0, 0, 1), turn_deg)
    objects = tuple(
        dataclasses.replace(item, mesh=transformed(item.mesh, linear, place), material=item.material.moved(place))
        for item in thing.objects
    )
    return dataclasses.replace(thing, objects=objects)


def enlarged(thing: Thing, factor: float) -> Thing:
    """The thing in another size; its glass keeps the colour that it had, since it absorbs less the larger it is."""
    objects = []
    for item in thing.objects:
        material = item.material
        if isinstance(material, Dielectric):
            red, green, blue = (round(value / factor, 3) for value in material.absorption)
            material = dataclasses.replace(material, absorption=(red, green, blue))
        objects.append(
            dataclasses.replace(item, mesh=transformed(item.mesh, factor * np.eye(3), (0, 0, 0)), material=material)
        )
    return dataclasses.replace(thing, objects=tuple(objects))
