"""Per-pixel quantities of a view besides colour: depth, normals, masks, materials, glass, refractive flow.

All of them hold for the ray through the pixel's centre, whereas pictures average over a pixel's area. They are computed
from stored layers of the true geometry, meshes and scene; normals, amodal masks and `light_ends` trace rays.

World axes are the dataset's: metres, +z up. Camera axes are OpenGL's: +x right, +y up, +z towards the viewer.
"""

import dataclasses
import functools
import weakref
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset, View
from datagen.data.geometries import GeometryKey, read_meshes
from datagen.data.layers import Layers
from datagen.data.meshes import Mesh, is_there, normals_of
from datagen.data.paths import TRUTH
from datagen.disk.records import checked
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene, image_bytes
from datagen.scene.folder import open_scene
from datagen.scene.images import linear_pixels, look_up
from datagen.scene.materials import Conductor, Diffuse, ImageTexture, Material, Plastic, RoughDielectric, SolidTexture
from datagen.scene.textures import evaluate_texture
from datagen.terminal.plugins import naming_parts
from datagen.trace.surface_tables import Limits

if TYPE_CHECKING:
    from datagen.trace.light_path import LightPathTracer
    from datagen.trace.peel import Hits, Peeler


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
        material = self.materials[object_id - 1]
        color = material.color if isinstance(material, Diffuse | Plastic | Conductor) else (np.nan,) * 3
        match color:
            case SolidTexture():
                return evaluate_texture(color, position)
            case ImageTexture(path=path):
                if path not in self._images:
                    self._images[path] = linear_pixels(image_bytes(self.scene, color), where=path)
                return look_up(self._images[path], uv, repeats=False).astype(np.float32)
            case _:
                return np.tile(np.array(color, np.float32), (len(uv), 1))

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


@functools.lru_cache(maxsize=2)
def peeler_of(key: GeometryKey) -> "Peeler":
    """What finds the surfaces of a geometry along straight rays, loaded once."""
    from datagen.trace.peel import Peeler

    use_mitsuba()
    return Peeler(read_meshes(key.dataset, key.geometry))


_OPENED: "weakref.WeakKeyDictionary[Dataset, Surfaces]" = weakref.WeakKeyDictionary()


def surfaces_of(dataset: Dataset) -> Surfaces:
    """The surfaces of an opened dataset, read once and verified."""
    if dataset not in _OPENED:
        _OPENED[dataset] = Surfaces(scene=open_scene(dataset), meshes=read_meshes(dataset, TRUTH))
    return _OPENED[dataset]


@dataclass(frozen=True, kw_only=True, eq=False)
class LightEnds:
    """Where the refracted light path through each pixel's centre ends. Everything is 0 where it was abandoned.

    A light path (datagen/trace/light_path.py) starts at the camera, is refracted by every glass surface, and ends on
    the first opaque surface or leaves the scene. Rough glass counts as smooth; its facets spread light around the path.
    """

    object_id: UInt8[np.ndarray, "h w"]
    """Id of the opaque object that the path ends on; 0 where it left the scene."""
    has_left: Bool[np.ndarray, "h w"]
    """Whether the path ends in the sky or in a light."""
    position: Float32[np.ndarray, "h w 3"]
    """Where the path ends, in metres, in world axes; 0 where it left."""
    depth_along_axis: Float32[np.ndarray, "h w"]
    """Depth of `position` along the camera's viewing axis, in metres; negative behind the camera, 0 where it left."""
    distance: Float32[np.ndarray, "h w"]
    """Straight distance from the camera's centre to `position` in metres; where glass refracts, `position` is not on
    the pixel's ray. 0 where it left."""
    direction: Float32[np.ndarray, "h w 3"]
    """Unit direction, in world axes, of the path's last segment."""
    attenuation: Float32[np.ndarray, "h w 3"]
    """Share of the light from the path's end, per colour channel, that reaches the camera along it: the part that
    surfaces do not reflect (Fresnel) times the part that media do not absorb (Beer and Lambert). 1 without glass; if
    the path ends inside a medium of index n, also times 1 / n², since radiance is n² times as large there."""
    flow: Float32[np.ndarray, "h w 2"]
    """Refractive flow in pixels, (right, down): pixel (x, y) shows the point, or the direction of the sky, that the
    camera would see at (x, y) + flow without refraction. 0 without glass."""
    has_flow: Bool[np.ndarray, "h w"]
    """False where `flow` is undefined, and stored as 0: the path ends behind the camera, or was abandoned."""


def find_light_ends(camera: Camera, tracer: "LightPathTracer", is_glass: Bool[np.ndarray, " id"]) -> LightEnds:
    """Follows the ray through the centre of each pixel of a camera in air.

    Args:
        is_glass: by object id.
    """
    shape = (camera.height, camera.width)
    origin, directions = camera.rays()
    rays = directions.reshape(-1, 3)
    # With room for one vertex, the path's last one is kept.
    paths = tracer.trace(np.tile(origin, (len(rays), 1)), rays, Limits(max_branches=1, max_vertices=1))
    object_id, has_left = paths.object_id[0, 0].reshape(shape), paths.has_left[0].reshape(shape)
    has_ended = (object_id > 0) & ~is_glass[object_id] & ~has_left
    is_known = has_ended | has_left

    def where_known(ended: Float32[np.ndarray, "ray 3"], left: Float32[np.ndarray, "ray 3"]) -> np.ndarray:
        values = np.where(has_left[..., None], left.reshape(*shape, 3), ended.reshape(*shape, 3))
        return np.where(is_known[..., None], values, np.float32(0))

    position = np.where(has_ended[..., None], paths.position[0, 0].reshape(*shape, 3), np.float32(0))
    direction = where_known(paths.direction[0, 0], paths.end_direction[0])
    attenuation = where_known(paths.throughput[0, 0], paths.end_throughput[0])
    # The end as seen from the camera; the sky is infinitely far, so only its direction counts.
    center = camera.world_from_camera[:3, 3]
    seen = np.where(has_left[..., None], direction, position - center).astype(np.float64)
    pixels, ahead = (values.reshape(*shape, -1) for values in camera.project((center + seen).reshape(-1, 3)))
    has_flow = is_known & (ahead[..., 0] > 1e-6)
    flow = pixels - np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1) - 0.5
    return LightEnds(
        object_id=np.where(has_ended, object_id, 0).astype(np.uint8),
        has_left=has_left,
        position=position.astype(np.float32),
        depth_along_axis=np.where(has_ended, ahead[..., 0], 0).astype(np.float32),
        distance=np.where(has_ended, np.linalg.norm(seen, axis=-1), 0).astype(np.float32),
        direction=direction.astype(np.float32),
        attenuation=attenuation.astype(np.float32),
        flow=np.where(has_flow[..., None], flow, 0).astype(np.float32),
        has_flow=has_flow,
    )


NormalKind = Literal["shading", "geometric"]
Axes = Literal["world", "camera"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewQuantities:
    """The quantities of one view, each computed on first access and then cached.

    Where a pixel's ray hits nothing, numbers are 0 unless documented otherwise, and `background` is True.
    """

    view: View

    # Which surfaces

    @functools.cached_property
    def layers(self) -> Layers:
        """The surfaces along each ray, nearest first, of the true geometry."""
        return self.view.layers()

    @functools.cached_property
    def surfaces(self) -> Surfaces:
        """Meshes and materials of the scene."""
        return surfaces_of(self.view.dataset)

    @property
    def object_id(self) -> UInt8[np.ndarray, "h w"]:
        """The object that the ray hits first: 1 + its place in `dataset.objects`; 0 where it hits none."""
        return self.layers.object_id[0]

    @functools.cached_property
    def opaque_object_id(self) -> UInt8[np.ndarray, "h w"]:
        """The first opaque object along the straight ray, as if glass did not bend light; 0 if there is none."""
        return self._at_opaque(self.layers.object_id)

    @property
    def background(self) -> Bool[np.ndarray, "h w"]:
        """True where the ray hits no object: the sky, or a light, is seen directly."""
        return self.object_id == 0

    @functools.cached_property
    def glass(self) -> Bool[np.ndarray, "h w"]:
        """True where the ray hits glass first; imported masks where the dataset has some, as `view.mask("glass")`."""
        return self.view.mask("glass")

    @checked
    def object_mask(self, name: str, *, amodal: bool = False) -> Bool[np.ndarray, "h w"]:
        """True where the ray hits the object of this name first; amodal: at all, traced with Mitsuba."""
        number = self.view.dataset.object_id(name)
        if not amodal or not is_there(mesh := self.surfaces.meshes[number - 1]):
            return self.object_id == number
        alone = self._first_hits(dataclasses.replace(self.surfaces, meshes=(mesh,)), "amodal masks")
        return (alone.shape[0] >= 0).reshape(self.object_id.shape)

    # Where they are

    @property
    def depth_along_ray(self) -> Float32[np.ndarray, "h w"]:
        """Metres from the camera's centre to the first surface, glass or not; relative error 8e-6."""
        return self.layers.depth[0]

    @property
    def depth_along_axis(self) -> Float32[np.ndarray, "h w"]:
        """Depth of the first surface along the camera's viewing axis (z-depth), in metres."""
        return self._along_axis(self.depth_along_ray)

    @functools.cached_property
    def opaque_depth_along_ray(self) -> Float32[np.ndarray, "h w"]:
        """Metres from the camera's centre to the first opaque surface along the straight ray, through all glass."""
        return self._at_opaque(self.layers.depth)

    @property
    def opaque_depth_along_axis(self) -> Float32[np.ndarray, "h w"]:
        """Depth of the first opaque surface along the camera's viewing axis, in metres."""
        return self._along_axis(self.opaque_depth_along_ray)

    @checked
    def disparity(self, baseline: float, surface: Literal["first", "opaque"] = "first") -> Float32[np.ndarray, "h w"]:
        """Pixels by which a second camera, `baseline` metres to the right, sees a surface further left; 0 without one.

        Args:
            surface: first, glass or not; opaque: the first opaque one on the straight ray, as if glass bent no light.
        """
        depth = self.depth_along_axis if surface == "first" else self.opaque_depth_along_axis
        return np.divide(self.view.camera.focal * baseline, depth, out=np.zeros_like(depth), where=depth > 0)

    @functools.cached_property
    def position(self) -> Float32[np.ndarray, "h w 3"]:
        """Position of the first surface in metres, in world axes."""
        return self._position(self.depth_along_ray)

    @functools.cached_property
    def opaque_position(self) -> Float32[np.ndarray, "h w 3"]:
        """Position of the first opaque surface along the straight ray, in metres, in world axes."""
        return self._position(self.opaque_depth_along_ray)

    @checked
    def normal(self, kind: NormalKind = "shading", axes: Axes = "world") -> Float32[np.ndarray, "h w 3"]:
        """Unit normal of the first surface, on the side from which the ray comes. Traces rays: needs Mitsuba.

        Args:
            kind: shading: interpolated between the mesh's vertices, as the path tracer does; geometric: that of the
                flat face. Both are flipped by the visible side of the face, so at grazing angles a shading normal may
                point slightly away from the camera.
            axes: world, or camera (+x right, +y up, +z towards the viewer).
        """
        hits = self._first_hits(self.surfaces, "normals")
        normals = np.zeros((*self.object_id.shape, 3))
        for place, mesh in enumerate(mesh for mesh in self.surfaces.meshes if is_there(mesh)):
            of_mesh = hits.shape[0] == place
            mask = of_mesh.reshape(self.object_id.shape)
            face, (b1, b2) = mesh.faces[hits.prim[0, of_mesh]], hits.barycentric[0, of_mesh].astype(np.float64).T
            found = across = normals_of(mesh.vertices[face])
            if kind == "shading":
                found = np.einsum("kh,hkc->hc", [1 - b1 - b2, b1, b2], mesh.normals[face].astype(np.float64))
            side = np.where((across * self._rays[1][mask]).sum(axis=-1, keepdims=True) < 0, 1.0, -1.0)
            normals[mask] = side * found / np.linalg.norm(found, axis=-1, keepdims=True)
        normals = normals.astype(np.float32)
        return normals if axes == "world" else (normals @ self.view.camera.world_from_camera[:3, :3]).astype(np.float32)

    # What they are made of

    @functools.cached_property
    def albedo(self) -> Float32[np.ndarray, "h w 3"]:
        """Linear reflectance (Rec. 709) of the first surface: the base under a coat, or metal at normal incidence.

        NaN on glass and where the ray hits nothing. Patterns are exact; the path tracer looks them up in textures.
        """
        albedo = np.full((*self.object_id.shape, 3), np.nan, np.float32)
        for object_id in np.unique(self.object_id[self.object_id > 0]).tolist():
            mask = self.object_id == object_id
            uv = self.layers.uv[0][mask] / 65535
            albedo[mask] = self.surfaces.albedo(object_id, uv, self.position[mask].astype(np.float64))
        return albedo

    @property
    def ior(self) -> Float32[np.ndarray, "h w"]:
        """Index of refraction of the first surface if it is glass or liquid; 0 on opaque surfaces."""
        return self.surfaces.ior[self.object_id]

    @functools.cached_property
    def glass_thickness(self) -> Float32[np.ndarray, "h w"]:
        """Length of the straight ray inside solid glass or liquid before it hits something opaque, in metres.

        Thin panes have no thickness. A solid inside another counts once. Only peeled layers count.
        """
        ids, depth = self.layers.object_id, self.layers.depth
        place = np.zeros(len(self.surfaces.is_solid), np.int64)
        solids = [index for index in np.unique(ids) if self.surfaces.is_solid[index]]
        place[solids] = 1 + np.arange(len(solids))
        is_inside = np.zeros((1 + len(solids), *ids.shape[1:]), bool)  # Row 0 is for objects that are not solid.
        in_front = np.ones(ids.shape[1:], bool)
        thickness = np.zeros(ids.shape[1:])
        rows, columns = np.indices(ids.shape[1:])
        for layer in range(len(ids)):
            if layer:
                is_segment = in_front & is_inside[1:].any(axis=0) & (ids[layer] > 0)
                thickness += np.where(is_segment, depth[layer].astype(np.float64) - depth[layer - 1], 0)
            is_inside[place[ids[layer]], rows, columns] ^= True
            in_front &= self.surfaces.is_glass[ids[layer]]
        return thickness.astype(np.float32)

    @functools.cached_property
    def light_ends(self) -> LightEnds:
        """Refractive flow, attenuation, and the end of each pixel's refracted path. Traces rays: needs Mitsuba."""
        with naming_parts("light_ends"):
            use_mitsuba()
        return find_light_ends(self.view.camera, self.surfaces.tracer, self.surfaces.is_glass)

    # Parts

    @functools.cached_property
    def _rays(self) -> tuple[np.ndarray, np.ndarray]:
        return self.view.camera.rays()

    def _first_hits(self, surfaces: Surfaces, what: str) -> "Hits":
        """The first of some surfaces that each ray meets; `what` asks for them, should Mitsuba be missing."""
        with naming_parts(what):
            use_mitsuba()
        origin, directions = self._rays
        return surfaces.peeler.trace(origin, directions.reshape(-1, 3), 1)

    def _at_opaque(self, values: np.ndarray) -> np.ndarray:
        """The values of layers at the first opaque one; 0 where there is none."""
        ids = self.layers.object_id
        is_opaque = (ids > 0) & ~self.surfaces.is_glass[ids]
        found = np.take_along_axis(values, is_opaque.argmax(axis=0)[None], axis=0)[0]
        return np.where(is_opaque.any(axis=0), found, np.zeros((), values.dtype))

    def _along_axis(self, depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        cosine = self._rays[1].astype(np.float64) @ -self.view.camera.world_from_camera[:3, 2]
        return (depth * cosine).astype(np.float32)

    def _position(self, depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
        origin, directions = self._rays
        places = origin.astype(np.float64) + depth[..., None].astype(np.float64) * directions
        return np.where(depth[..., None] > 0, places, 0).astype(np.float32)


@checked
def quantities(view: View) -> ViewQuantities:
    """The per-pixel quantities of a view besides its colour."""
    return ViewQuantities(view=view)
