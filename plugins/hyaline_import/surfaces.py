"""A foreign surface as a mesh of ours: in metres, joined along its seams, wound outward, mended, with normals."""

import dataclasses
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.data.meshes import (
    MIN_AREA,
    Mesh,
    face_areas,
    mesh_from,
    open_edges,
    signed_volume,
    vertex_normals,
    welded,
)
from datagen.data.queries import parts_inside_out
from datagen.disk.errors import HyalineError
from datagen.scene.modelling import CREASE_DEG
from datagen.scene.shading_normals import (
    MAX_OPPOSING,
    is_without_normal,
    opposing_share,
    unit,
    with_new_normals,
)
from hyaline_import.remarks import Remarks

WELD = 1e-5
"""Distance, as a share of a surface's size, below which vertices may be merged."""
MAX_CHANGE = 0.05
"""The most that mending or reducing may change a solid's volume; beyond it, it is another shape."""


def mesh_of(
    positions: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    normals: Float[np.ndarray, "vertex 3"] | None,
    uv: Float[np.ndarray, "vertex 2"] | None,
    *,
    crease_deg: float = CREASE_DEG,
    where: str,
) -> Mesh:
    """A mesh of these arrays without collapsed faces; without normals it is shaded smoothly but for creases."""
    vertices = positions.astype(np.float32)
    corners = vertices[faces]
    is_flat = (corners == np.roll(corners, 1, axis=1)).all(axis=-1).any(axis=-1)
    faces = faces[~is_flat]
    if not len(faces):
        raise HyalineError(f"{where}: has no face with an area; expected a surface")
    mesh = mesh_from(vertices, faces, np.zeros_like(vertices) if normals is None else unit(normals), uv)
    return mesh if normals is not None else with_new_normals(mesh, crease_deg=crease_deg)


def made_sound(mesh: Mesh, remarks: Remarks, *, where: str) -> Mesh:
    """The mesh with its seams joined and its faces outward, as far as that is known; a line for each change."""
    if open_edges(mesh):
        joined, distance = seams_joined(mesh)
        if open_edges(joined) < open_edges(mesh):
            remarks.note(where, f"vertices up to {1000 * distance:.2g} mm apart were joined")
            mesh = joined
    if open_edges(mesh):
        turned, count = _wound_alike(mesh)
        if count and open_edges(turned) < open_edges(mesh):
            remarks.note(where, f"{count:,} of its {len(mesh.faces):,} faces were turned round to look as the others")
            mesh = turned
    if not open_edges(mesh):
        mesh = _outward(mesh, remarks, where=where)
    return mesh


def seams_joined(mesh: Mesh) -> tuple[Mesh, float]:
    """The mesh with vertices that are very near each other in one place, and how far apart they were at most."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    positions, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    reach = WELD * float(np.ptp(positions, axis=0).max())
    pairs = KDTree(positions).query_pairs(reach, output_type="ndarray")
    if not len(pairs):
        return mesh, 0.0
    distance = float(np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=-1).max())
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(positions),) * 2)
    _, group = connected_components(graph, directed=False)
    _, first = np.unique(group, return_index=True)
    vertices = positions[first[group]][index.reshape(-1)]
    corners = vertices[mesh.faces]
    is_flat = (corners == np.roll(corners, 1, axis=1)).all(axis=-1).any(axis=-1)
    if is_flat.all():
        return mesh, 0.0
    faces = np.ascontiguousarray(mesh.faces[~is_flat])
    return dataclasses.replace(mesh, vertices=vertices, faces=faces), distance


def _wound_alike(mesh: Mesh) -> tuple[Mesh, int]:
    """The mesh with neighbours wound alike where an edge has two faces, and how many were turned."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    _, faces = welded(mesh)
    start = faces.reshape(-1).astype(np.int64)
    end = np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    _, first, counts = np.unique(key[order], return_index=True, return_counts=True)
    pair = first[counts == 2]
    one, other = order[pair], order[pair + 1]
    # Two faces that run along their edge in one direction look to different sides.
    differs = start[one] == start[other]
    # Each face is there twice, as it is and turned, and linked to those of its neighbours that look as it does.
    count = len(faces)
    near = np.concatenate([one // 3, one // 3 + count])
    far = np.concatenate([other // 3 + count * differs, other // 3 + count * ~differs])
    graph = coo_array((np.ones(len(near), np.int8), (near, far)), shape=(2 * count,) * 2)
    _, group = connected_components(graph, directed=False)
    part, is_turned = np.minimum(group[:count], group[count:]), group[:count] > group[count:]
    # Of each part, the fewer faces are turned.
    is_turned ^= (np.bincount(part, is_turned) > np.bincount(part) / 2)[part]
    return _turned(mesh, is_turned), int(is_turned.sum())


def _turned(mesh: Mesh, is_turned: np.ndarray) -> Mesh:
    faces = np.where(is_turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    return dataclasses.replace(mesh, faces=np.ascontiguousarray(faces))


def _outward(mesh: Mesh, remarks: Remarks, *, where: str) -> Mesh:
    """The closed mesh with each part outward, but for cavities."""
    if signed_volume(mesh) < 0:
        mesh = _turned(mesh, np.ones(len(mesh.faces), bool))
        remarks.note(where, "its faces pointed inwards; flipped")
    part, volumes, inside_out = parts_inside_out(mesh)
    if not inside_out:
        return mesh
    remarks.note(where, f"{len(inside_out)} of its {len(volumes)} parts have faces that pointed inwards; flipped")
    return _turned(mesh, np.isin(part, inside_out))


# Closing holes


def closed(mesh: Mesh, remarks: Remarks, *, where: str) -> Mesh:
    """The mesh with its holes closed by lids and new normals; unchanged if it has none.

    A lid is triangles around the hole's middle, or one triangle.
    """
    if not open_edges(mesh):
        return mesh
    positions, faces = welded(mesh)
    loops = _loops(faces)
    place = np.unique(mesh.vertices, axis=0, return_index=True)[1]
    vertices, uv, lids = [mesh.vertices], [mesh.uv], [mesh.faces]
    for loop in loops:
        middle = positions[loop].mean(axis=0)
        # The faces at the hole run along its rim forwards, the lid's backwards. A crack along an edge has its middle on
        # its rim, where a second point would be welded to the first.
        at = int(np.linalg.norm(positions[loop] - middle, axis=-1).argmin())
        rim = place[np.roll(loop, -at)]
        if len(loop) == 3 or (positions[loop[at]] == middle).all():
            lids.append(np.stack([rim[2:], rim[1:-1], np.full(len(rim) - 2, rim[0])], axis=-1))
            continue
        center = len(mesh.vertices) + len(vertices) - 1
        lids.append(np.stack([np.roll(rim, -1), rim, np.full(len(rim), center)], axis=-1))
        vertices.append(middle[None])
        uv.append(mesh.uv[place[loop]].mean(axis=0, keepdims=True))
    normals = np.concatenate([mesh.normals, np.zeros((len(vertices) - 1, 3), np.float32)])
    whole = mesh_from(np.concatenate(vertices), np.concatenate(lids), normals, np.concatenate(uv))
    if count := open_edges(whole):
        raise HyalineError(
            f"{where}: {count} edges stay open, where faces cross or more than two meet; close it in a modeller, "
            f"or draw it as thin glass with --material '{where}=thin-glass'"
        )
    before, after = signed_volume(mesh), signed_volume(whole)
    change = abs(after - before) / max(abs(after), 1e-30)
    what = f"{len(loops)} holes closed: its volume was {1e6 * abs(before):.4g} cm^3, and is {1e6 * abs(after):.4g} cm^3"
    if change > MAX_CHANGE:
        raise HyalineError(
            f"{where}: {what}, {100 * change:.1f} % off; expected at most {100 * MAX_CHANGE:g} %, model its walls"
        )
    remarks.approximate(where, what)
    return with_new_normals(whole, crease_deg=CREASE_DEG)


def _loops(faces: np.ndarray) -> list[np.ndarray]:
    """The rims of holes as points in order, each once around; where rims touch in a point, each on its own."""
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    edges = set(zip(start.tolist(), end.tolist(), strict=True))
    following: dict[int, list[int]] = {}
    for a, b in sorted(edges):
        if (b, a) not in edges:
            following.setdefault(a, []).append(b)
    loops, walk = [], []
    while following:
        walk = walk or [next(iter(following))]
        if not following.get(walk[-1]):  # A rim that ends stays open, which the count of open edges reports.
            following.pop(walk.pop(), None)
            continue
        point = following[walk[-1]].pop()
        if point in walk:
            at = walk.index(point)
            loops.append(np.array(walk[at:]))
            walk = walk[: at + 1]
        else:
            walk.append(point)
    return [loop for loop in loops if len(loop) > 2]


# Mending, where that needs no decision

SHORT_EDGE = 2e-7
"""Length in metres below which an edge may be collapsed; a face without area has such an edge, or a smaller height."""


def mend_surface(mesh: Mesh, remarks: Remarks, *, is_solid: bool, where: str) -> Mesh:
    """A mesh without harmful faces and vertices, and with usable shading normals; a note for each change.

    Args:
        is_solid: whether its faces bound a solid: then only faces with the same orientation are duplicates.
    """
    if not open_edges(mesh) and (slivers := int(_without_area(mesh).sum())):
        collapsed = _without_slivers(mesh)
        if collapsed is not None:
            mesh = collapsed
            remarks.note(where, f"{slivers} of its faces have no area; they were collapsed")
    for what, useless in (("have no area", _without_area), ("are there twice", partial(_twice, is_solid=is_solid))):
        left_out = useless(mesh)
        if left_out.any() and not left_out.all():
            mesh = dataclasses.replace(mesh, faces=np.ascontiguousarray(mesh.faces[~left_out]))
            remarks.note(where, f"{int(left_out.sum())} of its faces {what}; they were left out")
    if unused := len(mesh.vertices) - len(np.unique(mesh.faces)):
        mesh = part_of(mesh, np.ones(len(mesh.faces), bool))
        remarks.note(where, f"{unused} of its vertices belong to no face; they were left out")
    return mesh if _without_area(mesh).any() else _mended_normals(mesh, remarks, where=where)


def _mended_normals(mesh: Mesh, remarks: Remarks, *, where: str) -> Mesh:
    """The mesh with usable shading normals; hard edges are guessed if all of them are computed again."""
    bad = is_without_normal(mesh)
    known = dataclasses.replace(mesh, normals=np.where(bad[:, None], 0, mesh.normals).astype(np.float32))
    shares = {
        "pointed to the back of their faces": opposing_share(known),
        "were 0 or not finite": float(bad[mesh.faces].mean()),
    }
    for what, share in shares.items():
        if share > MAX_OPPOSING:
            remarks.note(where, f"{100 * share:.1f} % of its vertex normals {what}; normals were computed again")
            return with_new_normals(mesh, crease_deg=CREASE_DEG)
    if not bad.any():
        return mesh
    remarks.note(where, f"{bad.sum()} of its vertex normals were 0 or not finite; these were computed again")
    normals = np.where(bad[:, None], vertex_normals(mesh.vertices, mesh.faces), mesh.normals)
    return dataclasses.replace(mesh, normals=normals.astype(np.float32))


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
    for each in (solid, solid.simplify(SHORT_EDGE)):
        out = each.to_mesh()
        positions, normals, uv, _ = np.split(np.asarray(out.vert_properties, np.float32), [3, 6, 8], axis=1)
        found = mesh_from(positions, np.asarray(out.tri_verts), normals, uv)
        if not open_edges(found) and not _without_area(found).any():
            return found
    return None


def _twice(mesh: Mesh, *, is_solid: bool) -> Bool[np.ndarray, " face"]:
    """Faces with the same three positions as an earlier one."""
    _, faces = welded(mesh)
    turned = np.stack([np.roll(faces, -shift, axis=1) for shift in range(3)])
    same = turned[faces.argmin(axis=1), np.arange(len(faces))] if is_solid else np.sort(faces, axis=1)
    _, first = np.unique(same, axis=0, return_index=True)
    twice = np.ones(len(faces), bool)
    twice[first] = False
    return twice


def part_of(mesh: Mesh, is_kept: np.ndarray) -> Mesh:
    """Some faces of a mesh, with the vertices that they use."""
    used, faces = np.unique(mesh.faces[is_kept], return_inverse=True)
    return mesh_from(mesh.vertices[used], faces.reshape(-1, 3), mesh.normals[used], mesh.uv[used])
