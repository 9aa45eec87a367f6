"""Light paths: which surfaces a pixel really shows, by refraction and reflection.

Each ray is followed as light travels, in branches. Branch 0 is refracted: through every dielectric interface by Snell's
law (total internal reflection reflects it), straight through thin panes, until it hits something opaque or leaves the
scene. Branch 1 is reflected at the first surface, if that is glass or glossy, and then followed in the same way; rough
surfaces reflect it by one facet, so that several rays together show a blurred reflection. Further branches are
reflected at later surfaces of any branch, those of the largest throughput first. Faint branches and those beyond
`max_branches` are not followed: either the renderer makes up for their light, or, where `Limits.makes_up`, they count
as if they showed what the ray's other branches show.

Glass that disperses has an index for each colour channel. `trace` follows green light, as if the others went the same
way; `trace_ends` also follows red and blue, only for rays that hit such glass.

Call `use_mitsuba` first.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from datagen.data.meshes import Mesh, is_there, r2_steps
from datagen.machine.mitsuba_variant import no_collection
from datagen.render.mitsuba_scene import load_geometry_mitsuba, shape_name, shapes_by_id, to_columns
from datagen.scene.materials import Material, check_material
from datagen.scene.media import find_media
from datagen.trace.branch_outputs import Filled, FirstVertices, Kept, PathEnds, join_ends, pack_ends
from datagen.trace.branches import follow_branches
from datagen.trace.surface_tables import LIMITS, Limits, Tints, make_tables

RECORDINGS = 64
"""Kernels that a tracer keeps, one for each number of rays and limits."""

PIECES = 8
"""Rays to be traced again in other colours are padded to a multiple of 1 / PIECES of the bundle."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedPaths:
    """The vertices of all branches of a bundle of rays, in the order in which the camera's ray reaches them.

    A branch ends on an opaque surface (its last vertex), outside the scene (`has_left`), or after `max_depth` surfaces.
    If it has more vertices than places, the last place contains its last vertex.
    """

    object_id: UInt8[np.ndarray, "branch vertex ray"]
    """Id of the object at the vertex; 0 for no vertex."""
    uv: Float32[np.ndarray, "branch vertex ray 2"]
    direction: Float32[np.ndarray, "branch vertex ray 3"]
    """Unit direction in which the ray arrives at the vertex."""
    position: Float32[np.ndarray, "branch vertex ray 3"]
    """World position in metres."""
    normal: Float32[np.ndarray, "branch vertex ray 3"]
    """Unit shading normal on the side from which the ray comes."""
    throughput: Float32[np.ndarray, "branch vertex ray 3"]
    """Share of the radiance leaving the vertex against `direction` that reaches the camera, per colour channel: the
    product of Fresnel terms, Beer and Lambert's absorption, and the change of radiance with the square of the index."""
    has_left: Bool[np.ndarray, "branch ray"]
    """Whether the branch left the scene."""
    end_direction: Float32[np.ndarray, "branch ray 3"]
    """Unit direction in which the branch left the scene; 0 if it did not."""
    end_throughput: Float32[np.ndarray, "branch ray 3"]
    """Share of the environment's radiance from there that reaches the camera; 0 if the branch did not leave."""
    uv_slope: Float32[np.ndarray, "branch vertex ray 2"]
    """Change of uv from the vertex to where the ray would hit a surface one metre below this one, to first order."""
    disperses: Bool[np.ndarray, " ray"]
    """Whether some branch of the ray hits glass that disperses."""


RED, GREEN, BLUE = range(3)
ONLY = np.eye(3, dtype=np.float32)
"""Weights of the colour channels in light of one."""


class LightPathTracer:
    """A loaded geometry with the materials of its surfaces, for tracing any number of rays."""

    def __init__(
        self, meshes: tuple[Mesh, ...], materials: tuple[Material | None, ...], tints: Tints | None = None
    ) -> None:
        """Loads meshes with their materials. A surface without material lets every ray pass straight through.

        Args:
            tints: texels of metals with a texture, in the uv of `meshes`; without them, a metal reflects all light.
        """
        import drjit as dr
        import mitsuba as mi

        for index, material in enumerate(materials):
            if material is not None:
                check_material(material, where=f"light paths: object {index + 1}")
        # Mitsuba gets only objects with a mesh; ids still count all objects.
        kept = [index for index, mesh in enumerate(meshes) if is_there(mesh)]
        self._object_id = np.array([0, *(index + 1 for index in kept)], np.uint8)
        meshes = tuple(meshes[index] for index in kept)
        kept_materials = tuple(materials[index] for index in kept)
        self._scene = load_geometry_mitsuba(meshes)
        self._place = {index: place for place, index in enumerate(kept)}
        self._meshes, self._materials = list(meshes), list(kept_materials)
        self._media = find_media(kept_materials, meshes)
        self._tints = kept_tints = tuple(None if tints is None else tints[index] for index in kept)
        self._shapes = mi.UInt32(shapes_by_id(self._scene).astype(np.uint32))
        self._tables = make_tables(self._shapes, meshes, kept_materials, self._media, kept_tints)
        self._iors = [mi.Float(np.ascontiguousarray(self._media.iors[:, channel])) for channel in range(3)]
        self._spread: dict[int, list[mi.Float]] = {}
        # Recording a kernel takes as long as tracing 8,192 rays, so it is done once per number of rays and limits.
        self._trace = dr.freeze(follow_branches, limit=RECORDINGS, warn_after=1 << 30)

    def change(self, changes: Mapping[int, tuple[Mesh, Material]]) -> None:
        """Replaces the shapes and materials of some objects, without a new kernel.

        Args:
            changes: by the object's place in the scene. Meshes have as many vertices and faces as those that they
                replace, and materials are of the same kind. Which solids lie in others must not change.
        """
        import mitsuba as mi

        parameters = mi.traverse(self._scene)
        for index, (mesh, material) in changes.items():
            place = self._place[index]
            before = self._meshes[place]
            if mesh is not before:
                assert mesh.vertices.shape == before.vertices.shape
                assert mesh.faces.shape == before.faces.shape
                name = shape_name(place)
                parameters[f"{name}.vertex_positions"] = mi.Float(np.ascontiguousarray(mesh.vertices).ravel())
                # Or Mitsuba works normals out and writes them into the arrays of the mesh that was loaded.
                parameters[f"{name}.vertex_normals"] = mi.Float(np.ascontiguousarray(mesh.normals).ravel())
            self._meshes[place], self._materials[place] = mesh, material
        parameters.update()
        # What kernels were recorded for stays, `self._media` too; what they look up changes.
        meshes, materials = tuple(self._meshes), tuple(self._materials)
        media = find_media(materials, meshes, is_nested=self._media.is_nested)
        self._tables = make_tables(self._shapes, meshes, materials, media, self._tints)
        self._iors = [mi.Float(np.ascontiguousarray(media.iors[:, channel])) for channel in range(3)]

    def trace(
        self,
        origins: Float32[np.ndarray, "ray 3"],
        directions: Float32[np.ndarray, "ray 3"],
        limits: Limits = LIMITS,
        *,
        seed: int = 0,
        facets: Float32[np.ndarray, "ray 2"] | None = None,
        channel: int = GREEN,
    ) -> TracedPaths:
        """Follows rays that start in air.

        Args:
            directions: unit vectors.
            seed: of the choice of facets on rough surfaces.
            facets: where each ray starts to choose among facets, in [0, 1)^2. None: consecutive rays share them evenly.
            channel: the colour channel whose index of refraction counts; throughput is given for all channels anyway.
        """
        count = len(directions)
        outputs = self._run(origins, directions, limits, None, seed=seed, facets=facets, channel=channel)
        ends = limits.max_branches, count
        places = limits.max_branches, limits.max_vertices, count
        shapes = {
            "object_id": places,
            **dict.fromkeys(("uv", "uv_slope"), (*places, 2)),
            **dict.fromkeys(("direction", "position", "normal", "throughput"), (*places, 3)),
            "has_left": ends,
            **dict.fromkeys(("end_direction", "end_throughput"), (*ends, 3)),
        }
        found = {name: np.array(outputs[name]).reshape(shape) for name, shape in shapes.items()}
        found["object_id"] = self._object_id[found["object_id"]]
        found["has_left"] = found["has_left"].astype(bool)
        disperses = np.array(outputs["disperses"]).astype(bool) if self._tables.disperses else np.zeros(count, bool)
        return TracedPaths(**found, disperses=disperses)

    def trace_ends(
        self,
        origins: Float32[np.ndarray, "ray 3"],
        directions: Float32[np.ndarray, "ray 3"],
        limits: Limits = LIMITS,
        *,
        stacked: tuple[int, ...] = (),
        has_details: bool = False,
        seed: int = 0,
        facets: Float32[np.ndarray, "ray 2"] | None = None,
    ) -> PathEnds:
        """The ends of all branches, each colour channel taking its own way through glass that disperses.

        Rays that hit such glass are traced again for red and blue; then each of their ends has only one colour's light.

        Args:
            stacked: number of first vertices to keep of each of the first branches, of green light.
            has_details: whether ends have a position, a mirrored direction and a slope of uv.
        """
        count = len(directions)
        limits = limits._replace(max_vertices=1)

        def run(rays: np.ndarray | slice, stacked: tuple[int, ...], facets: np.ndarray | None, channel: int) -> Filled:
            kept = Kept(stacked, has_details)
            return self._run(origins[rays], directions[rays], limits, kept, seed=seed, facets=facets, channel=channel)

        outputs = run(slice(None), stacked, facets, GREEN)
        disperses = np.array(outputs["disperses"]) if self._tables.disperses else np.zeros(0, np.uint32)
        parted = np.flatnonzero(disperses)
        if not len(parted):
            parts = [pack_ends(outputs, limits.max_branches, np.arange(count), self._object_id, None)]
        else:
            # A kernel is recorded for each number of rays, so rays are padded to one of a few numbers.
            piece = max(1, count // PIECES)
            filled = np.concatenate([parted, np.full(-len(parted) % piece, parted[0])])
            spread = (_spread_evenly(count) if facets is None else facets)[filled]
            bundles = [(outputs, np.arange(count), np.where(disperses[:, None], ONLY[GREEN], np.float32(1)))]
            for channel in (RED, BLUE):
                weight = np.tile(ONLY[channel], (len(filled), 1))
                bundles.append((run(filled, (), spread, channel), parted, weight))
            parts = [
                pack_ends(traced, limits.max_branches, rays, self._object_id, weight)
                for traced, rays, weight in bundles
            ]
        slots = count, sum(stacked)
        stack = None
        if stacked:
            stack = FirstVertices(
                object_id=self._object_id[np.array(outputs["stack_shape"])].reshape(slots),
                uv=np.array(outputs["stack_uv"]).reshape(*slots, 2),
                throughput=np.array(outputs["stack_throughput"]).reshape(slots),
                cosine=np.array(outputs["stack_cosine"]).reshape(slots),
            )
        return PathEnds(**join_ends(parts), stack=stack)

    def _run(
        self,
        origins: Float32[np.ndarray, "ray 3"],
        directions: Float32[np.ndarray, "ray 3"],
        limits: Limits,
        kept: Kept | None,
        *,
        seed: int,
        facets: Float32[np.ndarray, "ray 2"] | None,
        channel: int,
    ) -> Filled:
        """What the kernel gives, by name."""
        import drjit as dr
        import mitsuba as mi

        count = len(directions)
        if count == 0:  # Dr.Jit would end the process.
            raise ValueError("expected at least one ray")
        if facets is None and count not in self._spread:
            self._spread[count] = [mi.Float(column) for column in np.ascontiguousarray(_spread_evenly(count).T)]
        rows = self._spread[count] if facets is None else to_columns(facets)

        with no_collection():
            outputs = self._trace(
                self._scene,
                tuple(self._tables._replace(medium_ior=self._iors[channel])),
                self._media,
                mi.Point3f(*to_columns(origins)),
                mi.Vector3f(*to_columns(directions)),
                tuple(rows),
                dr.opaque(mi.UInt32, seed),
                count,
                tuple(limits),
                None if kept is None else tuple(kept),
            )
        dr.eval(outputs)
        return outputs


def _spread_evenly(count: int) -> Float32[np.ndarray, "ray 2"]:
    """Where rays choose facets: the R2 sequence."""
    return (r2_steps(count) % 1).astype(np.float32)
