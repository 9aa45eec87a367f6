"""Closing the holes of glass: each gets a lid of triangles around its middle, or one triangle."""

import numpy as np

from datagen.data.meshes import Mesh, open_edges, signed_volume, welded
from datagen.disk.errors import HyalineError
from datagen.scene.importers.remarks import Remarks
from datagen.scene.modelling import CREASE_DEG
from datagen.scene.shading_normals import shaded_anew

MAX_CHANGE = 0.05
"""Share of its volume by which a solid may change when its holes are closed: else its shape was something else."""


def closed(mesh: Mesh, remarks: Remarks, *, where: str) -> Mesh:
    """The mesh with its holes closed, shaded anew; the same one where it has none.

    Raises:
        HyalineError: it stays open, as where three faces meet at an edge, or its volume changes too much.
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
    whole = Mesh(
        vertices=np.concatenate(vertices).astype(np.float32),
        faces=np.concatenate(lids).astype(np.int32),
        normals=np.concatenate([mesh.normals, np.zeros((len(vertices) - 1, 3), np.float32)]),
        uv=np.concatenate(uv).astype(np.float32),
    )
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
    return shaded_anew(whole, crease_deg=CREASE_DEG)


def _loops(faces: np.ndarray) -> list[np.ndarray]:
    """The rims of holes as points in order, each once around."""
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    edges = set(zip(start.tolist(), end.tolist(), strict=True))
    following: dict[int, list[int]] = {}
    for a, b in sorted(edges):
        if (b, a) not in edges:
            following.setdefault(a, []).append(b)
    loops = []
    while following:
        first = next(iter(following))
        walk, places = [first], {first: 0}
        while True:
            choices = following.get(walk[-1])
            if not choices:  # The rim ends: whoever counts open edges afterwards tells.
                following.pop(walk[-1], None)
                break
            point = choices.pop()
            if not choices:
                del following[walk[-1]]
            if point in places:
                # Where rims touch in a point, each is closed on its own.
                at = places[point]
                loops.append(np.array(walk[at:]))
                for gone in walk[at + 1 :]:
                    del places[gone]
                walk = walk[: at + 1]
                if len(walk) == 1:
                    break
                continue
            places[point] = len(walk)
            walk.append(point)
    return [loop for loop in loops if len(loop) > 2]
