"""Fewer triangles for surfaces that have more than a scene needs: quadric edge collapse by pymeshlab, in a child.

pymeshlab ends its process on some inputs, so it gets validated arrays and a time limit, in a process of its own.
"""

# pymeshlab fills its namespace when it is imported; pyright sees none of it.
# pyright: reportAttributeAccessIssue=false

import importlib.util
import sys
from pathlib import Path

import numpy as np

from datagen.data.meshes import Mesh, open_edges, signed_volume, welded
from datagen.disk.errors import HyalineError
from datagen.machine.child_python import ChildError, arrays_from_child
from datagen.scene.importers.remarks import Remarks
from datagen.scene.modelling import CREASE_DEG
from datagen.scene.shading_normals import shaded_anew
from datagen.terminal.distribution import install_command

LEAST = 64
"""Triangles that every surface keeps."""
MAX_CHANGE = 0.05
"""Share of its volume by which a solid may change: else it is another shape."""
TIMEOUT_S, FACES_A_SECOND = 60.0, 2000.0


def check_decimation(max_triangles: int | None) -> None:
    """Refuses a number that cannot be, and a machine that cannot do it.

    Raises:
        HyalineError: naming which.
    """
    if max_triangles is None:
        return
    if max_triangles < LEAST:
        raise HyalineError(f"--max-triangles: is {max_triangles}; expected at least {LEAST}")
    if importlib.util.find_spec("pymeshlab") is None:
        raise HyalineError(f"--max-triangles: needs pymeshlab; `{install_command('proxies')}` brings it")


def decimated(mesh: Mesh, target: int, remarks: Remarks, *, where: str) -> Mesh:
    """The mesh with about `target` triangles, shaded anew; the same one where it has no more.

    Its uv are lost: they stay 0.

    Raises:
        HyalineError: what comes out is another shape, or nothing does.
    """
    target = max(target, LEAST)
    count = len(mesh.faces)
    if count <= target:
        return mesh
    positions, faces = welded(mesh)
    try:
        found = arrays_from_child(
            "datagen.scene.importers.decimating",
            {"vertices": positions.astype(np.float64), "faces": faces.astype(np.int64), "target": np.array(target)},
            timeout_s=TIMEOUT_S + count / FACES_A_SECOND,
        )
    except ChildError as error:
        raise HyalineError(f"{where}: pymeshlab cannot reduce it ({error}); reduce it in a modeller") from None
    vertices, corners = found["vertices"].astype(np.float32), found["faces"].astype(np.int32)
    if len(corners) < 4 or not np.isfinite(vertices).all() or corners.min() < 0 or corners.max() >= len(vertices):
        raise HyalineError(f"{where}: nothing is left of it with {target:,} triangles; pass more --max-triangles")
    bare = Mesh(
        vertices=vertices, faces=corners, normals=np.zeros_like(vertices), uv=np.zeros((len(vertices), 2), "f4")
    )
    what = f"reduced from {count:,} to {len(corners):,} triangles"
    if not open_edges(mesh):
        what += _compared(mesh, bare, what, where=where)
    remarks.approximate(where, what)
    return shaded_anew(bare, crease_deg=CREASE_DEG)


def _compared(before: Mesh, after: Mesh, what: str, *, where: str) -> str:
    """The volumes of a solid, in words.

    Raises:
        HyalineError: it is no longer closed, or has become another shape.
    """
    if count := open_edges(after):
        raise HyalineError(f"{where}: {what}, and {count} edges are open then; pass more --max-triangles")
    volumes = abs(signed_volume(before)), abs(signed_volume(after))
    change = abs(volumes[1] - volumes[0]) / max(volumes[0], 1e-30)
    told = f"; its volume was {1e6 * volumes[0]:.4g} cm^3, and is {1e6 * volumes[1]:.4g} cm^3"
    if change > MAX_CHANGE:
        raise HyalineError(
            f"{where}: {what}{told}, {100 * change:.1f} % off; expected at most {100 * MAX_CHANGE:g} %, pass more "
            "--max-triangles"
        )
    return told


def _child(source: Path, target: Path) -> None:
    import pymeshlab

    with np.load(source) as arrays:
        vertices, faces, count = (arrays[name] for name in ("vertices", "faces", "target"))
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=vertices, face_matrix=faces))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(count), preservetopology=True, preservenormal=True
    )
    mesh = meshes.current_mesh()
    np.savez(target, allow_pickle=False, vertices=mesh.vertex_matrix(), faces=mesh.face_matrix())


if __name__ == "__main__":
    _child(Path(sys.argv[1]), Path(sys.argv[2]))
