"""Repairs surfaces of files, where that needs no decision; each repair prints one line."""

import dataclasses
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from datagen.data.meshes import MIN_AREA, Mesh, check_numbers, face_areas, is_there, open_edges, vertex_normals, welded
from datagen.scene.description import Scene
from datagen.scene.modelling import CREASE_DEG
from datagen.scene.shading_normals import (
    MAX_OPPOSING,
    count_without_normal,
    is_without_normal,
    opposing_share,
    with_new_normals,
)
from datagen.terminal.command import say

if TYPE_CHECKING:
    import manifold3d

SHORT_EDGE = 2e-7
"""Length in metres below which an edge may be collapsed; a face without area has such an edge, or a smaller height."""


def with_mended_surfaces(scene: Scene) -> Scene:
    """The scene with meshes that can be rendered; each repair prints one line."""
    objects = []
    for item in scene.objects:
        mesh, where = item.mesh, f"scene {scene.name}: object {item.name}"
        if is_there(mesh):
            check_numbers(mesh, where=where)
            mesh, remarks = mend_surface(mesh, is_solid=item.material.medium is not None)
            for remark in remarks:
                say(f"{where}: {remark}")
        objects.append(dataclasses.replace(item, mesh=mesh))
    return dataclasses.replace(scene, objects=tuple(objects))


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


def mended_normals(mesh: Mesh, *, crease_deg: float) -> tuple[Mesh, str | None]:
    """The mesh with usable shading normals, and a remark on what was done; the same mesh if all is well.

    Args:
        crease_deg: faces that meet at a sharper angle get a hard edge if all normals are computed again.
    """
    bad = is_without_normal(mesh)
    bad_share = float(bad[mesh.faces].mean())
    known = dataclasses.replace(mesh, normals=np.where(bad[:, None], 0, mesh.normals).astype(np.float32))
    if (opposing := opposing_share(known)) > MAX_OPPOSING:
        remark = f"{100 * opposing:.1f} % of its vertex normals pointed to the back of their faces"
        return with_new_normals(mesh, crease_deg=crease_deg), f"{remark}; normals were computed again"
    if bad_share > MAX_OPPOSING:
        remark = f"{100 * bad_share:.1f} % of its vertex normals were 0 or not finite"
        return with_new_normals(mesh, crease_deg=crease_deg), f"{remark}; normals were computed again"
    if bad_share > 0:
        normals = np.where(bad[:, None], vertex_normals(mesh.vertices, mesh.faces), mesh.normals)
        few = dataclasses.replace(mesh, normals=normals.astype(np.float32))
        count = count_without_normal(mesh)
        return few, f"{count} of its vertex normals were 0 or not finite; these were computed again"
    return mesh, None


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
