"""Repairs meshes that users bring, where that needs no decision; each repair prints one line."""

import dataclasses
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from datagen.data.meshes import MIN_AREA, Mesh, check_areas, check_numbers, face_areas, is_there, open_edges, welded
from datagen.disk.errors import HyalineError
from datagen.scene.atlas import coverage, unwrap_all
from datagen.scene.description import Scene, image_bytes
from datagen.scene.images import baked_image, linear_pixels
from datagen.scene.modelling import CREASE_DEG
from datagen.scene.shading_normals import mended_normals
from datagen.scene.textures import ImageTexture
from datagen.terminal.command import say

if TYPE_CHECKING:
    import manifold3d

COVERAGE_SIZE = 256
"""Texels per side of the raster that is checked for overlapping uv."""
MAX_SHARED = 0.005
"""Share of covered texels that several faces may share; atlases with overlapping charts have many times more."""
MIN_COVERED = 0.005
"""Share of the atlas that a surface must cover; with less, it would have only a few texels or none."""
SHORT_EDGE = 2e-7
"""Length in metres below which an edge may be collapsed; a face without area has such an edge, or a smaller height."""
MAX_UV = 1e5
"""Repeats of an image beyond which 32-bit floats cannot distinguish its texels."""


def mend_scene(scene: Scene, *, without_uv: set[str]) -> Scene:
    """The scene with meshes that can be rendered and textured; each repair prints one line.

    Args:
        without_uv: names of objects whose files have no uv: they get an atlas without a message.
    """
    objects, faults = [], {}
    for item in scene.objects:
        if not is_there(item.mesh):
            objects.append(item)
            continue
        where = f"scene {scene.name}: object {item.name}"
        check_numbers(item.mesh, where=where)
        mesh, remarks = mend_surface(item.mesh, is_solid=item.material.medium is not None)
        for remark in remarks:
            say(f"{where}: {remark}")
        objects.append(dataclasses.replace(item, mesh=mesh))
        for image in item.material.images().values():
            linear_pixels(image_bytes(scene, image), where=f"{where}: {image.path}")
            if item.name in without_uv:
                raise HyalineError(f"{where}: has no uv for {image.path}; export its mesh with uv, or give it a color")
        if (fault := "" if item.name in without_uv else atlas_fault(mesh)) is not None:
            faults[item.name] = fault
    return _with_atlases(dataclasses.replace(scene, objects=tuple(objects)), faults)


def _with_atlases(scene: Scene, faults: dict[str, str]) -> Scene:
    """The scene with a new atlas for each object in `faults`, and its image baked into it."""
    wheres = {name: f"scene {scene.name}: object {name}" for name in faults}
    for item in scene.objects:
        if item.name in faults:
            check_areas(item.mesh, where=wheres[item.name])
    meshes = unwrap_all({wheres[item.name]: item.mesh for item in scene.objects if item.name in faults})
    objects, baked = [], dict(scene.baked)
    for item in scene.objects:
        if (fault := faults.get(item.name)) is None:
            objects.append(item)
            continue
        mesh, material, what = meshes[wheres[item.name]], item.material, "unwrapped again"
        for field, image in material.images().items():
            if not item.mesh.uv.any() or not np.abs(item.mesh.uv).max() < MAX_UV:
                raise HyalineError(
                    f"{wheres[item.name]}: {fault}; {image.path} needs uv in or near [0, 1], export its mesh with them"
                )
            path, what = f"baked/{item.name}_{field}.png", f"unwrapped again, and {image.path} baked into its new uv"
            baked[path] = baked_image(linear_pixels(image_bytes(scene, image), where=image.path), item.mesh, mesh)
            material = material.with_fields({field: ImageTexture(path=path)})
        if fault:
            say(f"{wheres[item.name]}: {fault}; it was {what}")
        objects.append(dataclasses.replace(item, mesh=mesh, material=material))
    return dataclasses.replace(scene, objects=tuple(objects), baked=baked)


def mend_surface(mesh: Mesh, *, is_solid: bool) -> tuple[Mesh, list[str]]:
    """A mesh without harmful faces and vertices, and with usable shading normals.

    Args:
        is_solid: whether its faces bound a solid: then only faces with the same orientation are duplicates.

    Returns:
        The mesh (the same one if nothing was wrong), and a remark for each change.
    """
    remarks = []
    if not open_edges(mesh) and (slivers := int(_without_area(mesh).sum())):
        collapsed = _without_slivers(mesh)
        if collapsed is not None:
            mesh = collapsed
            remarks.append(f"{slivers} of its faces have no area; they were collapsed")
    for what, useless in (("have no area", _without_area), ("are there twice", partial(_twice, is_solid=is_solid))):
        left_out = useless(mesh)
        if left_out.any() and not left_out.all():
            mesh = dataclasses.replace(mesh, faces=np.ascontiguousarray(mesh.faces[~left_out]))
            remarks.append(f"{int(left_out.sum())} of its faces {what}; they were left out")
    mesh, unused = _without_unused(mesh)
    if unused:
        remarks.append(f"{unused} of its vertices belong to no face; they were left out")
    if not _without_area(mesh).any():
        mesh, remark = mended_normals(mesh, crease_deg=CREASE_DEG)
        remarks += [remark] if remark else []
    return mesh, remarks


def atlas_fault(mesh: Mesh) -> str | None:
    """Why a mesh's uv are not an atlas, which gives each surface point its own texels; None if they are one."""
    if not np.isfinite(mesh.uv).all():
        return "some of its uv are not finite"
    if mesh.uv.min() < 0 or mesh.uv.max() > 1:
        return f"its uv span {mesh.uv.min():g} to {mesh.uv.max():g}"
    counts = coverage(mesh, COVERAGE_SIZE)
    covered = int((counts > 0).sum())
    if covered < MIN_COVERED * counts.size:
        return f"its uv cover {100 * covered / counts.size:.2g} % of the atlas"
    if (shared := float((counts > 1).sum()) / covered) > MAX_SHARED:
        return f"its uv overlap on {100 * shared:.1f} % of their texels"
    return None


def _without_area(mesh: Mesh) -> Bool[np.ndarray, " face"]:
    # Faces with non-finite vertices have a NaN area: they are refused later, not removed.
    return face_areas(mesh) < MIN_AREA


def _without_slivers(mesh: Mesh) -> Mesh | None:
    """The closed mesh with faces without area collapsed, so that it stays closed; None if that fails.

    Removing them would open it: a sliver joins a long edge to the shorter edges on its other side.
    """
    import manifold3d

    _, first, place = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    one, index = first[place.reshape(-1)], np.arange(len(mesh.vertices))
    is_seam = one != index
    # Constructing a manifold removes most slivers, and leaves flat areas as they are; its `simplify` removes all.
    solid = manifold3d.Manifold(
        manifold3d.Mesh(
            vert_properties=np.ascontiguousarray(np.hstack([mesh.vertices, mesh.normals, mesh.uv]), np.float32),
            tri_verts=np.ascontiguousarray(mesh.faces, np.uint32),
            merge_from_vert=np.ascontiguousarray(index[is_seam], np.uint32),
            merge_to_vert=np.ascontiguousarray(one[is_seam], np.uint32),
            tolerance=SHORT_EDGE,
        )
    )
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        return None
    collapsed = (_mesh_of(each) for each in (solid, solid.simplify(SHORT_EDGE)))
    return next((each for each in collapsed if not open_edges(each) and not _without_area(each).any()), None)


def _mesh_of(solid: "manifold3d.Manifold") -> Mesh:
    out = solid.to_mesh()
    values = np.asarray(out.vert_properties, np.float32)
    return Mesh(
        vertices=np.ascontiguousarray(values[:, :3]),
        faces=np.asarray(out.tri_verts).astype(np.int32),
        normals=np.ascontiguousarray(values[:, 3:6]),
        uv=np.ascontiguousarray(values[:, 6:8]),
    )


def _twice(mesh: Mesh, *, is_solid: bool) -> Bool[np.ndarray, " face"]:
    """Faces with the same three positions as an earlier one."""
    _, faces = welded(mesh)
    turned = np.stack([np.roll(faces, -shift, axis=1) for shift in range(3)])
    same = turned[faces.argmin(axis=1), np.arange(len(faces))] if is_solid else np.sort(faces, axis=1)
    _, first = np.unique(same, axis=0, return_index=True)
    twice = np.ones(len(faces), bool)
    twice[first] = False
    return twice


def _without_unused(mesh: Mesh) -> tuple[Mesh, int]:
    used = np.unique(mesh.faces)
    if len(used) == len(mesh.vertices):
        return mesh, 0
    place = np.zeros(len(mesh.vertices), np.int32)
    place[used] = np.arange(len(used), dtype=np.int32)
    kept = Mesh(vertices=mesh.vertices[used], faces=place[mesh.faces], normals=mesh.normals[used], uv=mesh.uv[used])
    return kept, len(mesh.vertices) - len(used)
