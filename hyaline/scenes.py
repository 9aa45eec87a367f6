"""Scenes described in Python: meshes with materials, light and cameras."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, Integer, Real

from datagen.data.meshes import Mesh, mesh_from
from datagen.disk.errors import HyalineError, printable
from datagen.disk.records import checked
from datagen.scene import description
from datagen.scene.description import (
    MAX_OBJECTS,
    CameraList,
    CameraRig,
    Environment,
    RectangleLight,
    SceneObject,
)
from datagen.scene.description import Card as Card
from datagen.scene.description import EnvironmentMap as EnvironmentMap
from datagen.scene.description import Lobe as Lobe
from datagen.scene.description import SoftEnvironment as SoftEnvironment
from datagen.scene.description import WalkPoint as WalkPoint
from datagen.scene.materials import Conductor as Conductor
from datagen.scene.materials import Dielectric as Dielectric
from datagen.scene.materials import Diffuse as Diffuse
from datagen.scene.materials import ImageTexture as ImageTexture
from datagen.scene.materials import Material, Vector, check_material, check_positive
from datagen.scene.materials import Plastic as Plastic
from datagen.scene.materials import RoughDielectric as RoughDielectric
from datagen.scene.materials import SolidTexture as SolidTexture
from datagen.scene.materials import ThinDielectric as ThinDielectric


@runtime_checkable
class Triangles(Protocol):
    """A mesh of trimesh, or any other object with these two arrays; the uv of a textured `visual` are used, too."""

    vertices: np.ndarray
    """(vertex, 3) positions in metres, +z up."""
    faces: np.ndarray
    """(face, 3) vertex indices, counter-clockwise seen from outside."""


Arrays = tuple[Real[np.ndarray, "vertex 3"], Integer[np.ndarray, "face 3"]]


@checked
@dataclass(frozen=True)
class Object:
    """One object of a scene: a mesh of one material, which layers name by one id.

    >>> import hyaline as hy, trimesh
    >>> ball = hy.Object("ball", trimesh.creation.icosphere(radius=0.1), hy.Dielectric(ior=1.5))
    >>> ball.material.is_glass
    True
    """

    name: str
    """Letters, digits, _ and -."""
    mesh: Triangles | Arrays | Path | str
    """A trimesh mesh, a pair of arrays (vertices, faces), or a .glb, .gltf, .obj, .ply, .stl or .xml file, of
    which only the triangles are read. Lengths are metres and +z is up, in files, too. Glass has to be closed. Meshes
    are shaded smoothly except across edges of more than 40 degrees, and unwrapped unless they have uv."""
    material: Material
    """Such as `Dielectric()`, which is glass, or `Diffuse(color=(0.8, 0.7, 0.6))`."""

    def __post_init__(self) -> None:
        check_material(self.material, where=f"object {printable(self.name)}")


@checked
@dataclass(frozen=True, kw_only=True)
class Hemisphere:
    """Training and interpolating cameras on a hemisphere around the glass, and an extrapolating walk that leaves it.

    >>> Hemisphere(views=96, elevation_deg=(10, 60)).views
    96
    """

    views: int | None = None
    """Training views; the preset's number unless given."""
    test_views: int | None = None
    """Views in each of the two test splits; the preset's number unless given."""
    target: Vector | None = None
    """What the cameras look at, in metres; the middle of the glass unless given."""
    radius: float | None = None
    """Metres from there; as near as shows all of the glass, in pictures at least as high as wide, unless given."""
    elevation_deg: tuple[float, float] = (5.0, 65.0)
    """Lowest and highest elevation above the horizon."""
    azimuth_deg: tuple[float, float] | None = None
    """First and last azimuth, from +x towards +y; all around unless given."""
    fov_deg: float = 40.0
    """Horizontal field of view."""

    def __post_init__(self) -> None:
        if self.radius is not None:
            check_positive("camera radius", self.radius)
        if not 0 < self.fov_deg < 170:
            raise HyalineError(f"camera fov_deg: is {self.fov_deg}; expected 0 to 170")


@checked
@dataclass(frozen=True, kw_only=True)
class Scene:
    """A scene described in Python, which `hyaline.build` path-traces.

    >>> import hyaline as hy, trimesh
    >>> floor = trimesh.creation.box((2, 2, 0.02), transform=trimesh.transformations.translation_matrix((0, 0, -0.2)))
    >>> scene = hy.Scene(
    ...     objects=[
    ...         hy.Object("ball", trimesh.creation.icosphere(radius=0.1), hy.Dielectric(ior=1.5)),
    ...         hy.Object("floor", floor, hy.Diffuse(color=(0.7, 0.6, 0.5))),
    ...     ],
    ...     cameras=hy.Hemisphere(views=20),
    ... )
    >>> hy.show(scene).size                             # path-traced, as notebooks show it
    (341, 256)
    """

    objects: Sequence[Object]
    """1 to 255; the id of the first in layers is 1."""
    light: Environment | None = None
    """Light from infinitely far, such as `EnvironmentMap(path="studio.exr")` or a `SoftEnvironment`; softboxes all
    around unless given."""
    lamps: Sequence[RectangleLight] = ()
    """Light from near."""
    cameras: Hemisphere | CameraRig | CameraList = Hemisphere()
    name: str = "scene"
    """Letters, digits, _ and -; `hyaline.build` writes to data/NAME unless told where."""
    folder: Path | str = "."
    """Where files of image textures and of the environment map are."""
    license: str | None = None
    """An SPDX name such as CC-BY-4.0, or a line of text: the licence of meshes and images, and so of the dataset."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.objects) <= MAX_OBJECTS:
            raise HyalineError(
                f"scene {printable(self.name)}: has {len(self.objects)} objects; expected 1 to {MAX_OBJECTS}"
            )

    def described(self) -> description.Scene:
        """The scene as the renderer needs it: meshes are unwrapped unless they have an atlas, and checked.

        Raises:
            HyalineError: an object that would render wrong, such as glass with holes, or a file that cannot be read.
        """
        from datagen.scene.mending import assemble
        from datagen.scene.rig import LIGHT

        read = [_described(item) for item in self.objects]
        objects = tuple(item for item, _ in read)
        scene = description.Scene(
            name=self.name,
            license=self.license,
            objects=objects,
            environment=self.light or LIGHT,
            lights=tuple(self.lamps),
            cameras=_rig(self.cameras, objects) if isinstance(self.cameras, Hemisphere) else self.cameras,
            folder=Path(self.folder),
        )
        return assemble(scene, without_uv={item.name for item, has_uv in read if not has_uv})


def _rig(cameras: Hemisphere, objects: Sequence[SceneObject]) -> CameraRig:
    """The cameras of a hemisphere, fitted around a scene's objects."""
    from datagen.scene.rig import ALL_AROUND, rig_around

    fitted = rig_around(
        objects,
        target=cameras.target,
        radius=cameras.radius,
        azimuth_deg=cameras.azimuth_deg or ALL_AROUND,
        fov_deg=cameras.fov_deg,
    )
    return dataclasses.replace(fitted, elevation_deg=cameras.elevation_deg)


def _described(item: Object) -> tuple[SceneObject, bool]:
    """An object with a mesh of ours, and whether that came with uv."""
    from datagen.scene.finding import find_source
    from datagen.scene.modelling import CREASE_DEG
    from datagen.scene.shading_normals import with_new_normals

    where, given = f"object {printable(item.name)}", item.mesh
    if isinstance(given, Mesh):
        return SceneObject(name=item.name, mesh=given, material=item.material), bool(given.uv.any())
    if isinstance(given, (str, Path)):
        source = find_source(str(given), is_of_files=True)
        if source is None or source.read_mesh is None:
            raise HyalineError(f"{given}: reading mesh files needs the plug-in hyaline_import; give vertices and faces")
        vertices, faces, uv = source.read_mesh(Path(given))
    elif isinstance(given, tuple):
        (vertices, faces), uv = given, None
    else:
        vertices, faces, uv = given.vertices, given.faces, getattr(getattr(given, "visual", None), "uv", None)
    vertices, faces = _checked(vertices, faces, where=where)
    has_uv = uv is not None and np.shape(uv) == (len(vertices), 2) and bool(np.any(uv))
    bare = mesh_from(vertices, faces, np.zeros(vertices.shape), np.asarray(uv, np.float32) if has_uv else None)
    mesh = with_new_normals(bare, crease_deg=CREASE_DEG)
    return SceneObject(name=item.name, mesh=mesh, material=item.material), has_uv


def _checked(
    vertices: object, faces: object, *, where: str
) -> tuple[Float[np.ndarray, "vertex 3"], Int[np.ndarray, "face 3"]]:
    """Vertices and faces as numbers that are safe to use."""
    places, corners = np.asarray(vertices), np.asarray(faces)
    for name, values, kinds in (("vertices", places, "fiu"), ("faces", corners, "iu")):
        if values.ndim != 2 or values.shape[1] != 3 or not len(values) or values.dtype.kind not in kinds:
            expected = "(vertex, 3) numbers" if name == "vertices" else "(face, 3) vertex indices"
            raise HyalineError(f"{where}: {name} are {values.dtype} of shape {values.shape}; expected {expected}")
    if not np.isfinite(places).all():
        raise HyalineError(f"{where}: vertices are not all finite; expected metres")
    if corners.min() < 0 or corners.max() >= len(places):
        raise HyalineError(f"{where}: a face names vertex {corners.max()}; expected 0 to {len(places) - 1}")
    return places.astype(np.float64), corners.astype(np.int64)
