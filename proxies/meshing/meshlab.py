"""pymeshlab's filters for proxies, run in a child process.

pymeshlab kills its process on some inputs (a hull of collinear points) and never returns from others, so it runs in a
child with a time limit, on validated arrays: `python -m proxies.meshing.meshlab IN.npz OUT.npz TASK`.
"""

# pymeshlab fills its namespace when it is imported; pyright sees none of it.
# pyright: reportAttributeAccessIssue=false

import functools
import sys
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, Int64

from datagen.machine.processes import ChildError, arrays_from_child
from datagen.terminal.distribution import install_command

TIMEOUT_S = 120.0
"""Time limit of the child for the objects of one dataset."""

WRAP_TIMEOUT_S = 60.0
"""Additional time limit for each wrapped object; a few seconds are usual."""

Task = Literal["probe", "hulls", "distances", "wraps"]


class MeshlabError(Exception):
    """pymeshlab failed; the caller continues without it."""


@functools.cache
def meshlab_problem() -> str | None:
    """The reason why pymeshlab cannot be used here and how to fix that, in one line; None if it works."""
    try:
        _run("probe", {})
    except MeshlabError as error:
        message = str(error)
        installed = f"`{install_command('proxies')}` and `apt install libgl1`"
        fix = "`apt install libgl1`" if "libGL" in message else installed
        return f"pymeshlab cannot be used ({message}); fix it with {fix}"
    return None


def convex_hulls(
    clouds: list[Float64[np.ndarray, "_ 3"]],
) -> list[tuple[Float64[np.ndarray, "_ 3"], Int64[np.ndarray, "_ 3"]]]:
    """Vertices and outward faces of the convex hull of each cloud of points, which must not be flat.

    Raises:
        MeshlabError: the child died, took too long, or returned no surface.
    """
    answers = _run("hulls", {f"{index}.points": points for index, points in enumerate(clouds)})
    hulls = []
    for index in range(len(clouds)):
        vertices, faces = answers[f"{index}.vertices"], answers[f"{index}.faces"].astype(np.int64)
        if len(faces) < 4 or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
            raise MeshlabError(f"its hull number {index} has {len(vertices)} vertices and {len(faces)} faces")
        hulls.append((vertices, faces))
    return hulls


def surface_distances(
    pairs: list[tuple[Float64[np.ndarray, "_ 3"], Float64[np.ndarray, "_ 3"], Int64[np.ndarray, "_ 3"]]],
) -> list[Float[np.ndarray, "_"]]:
    """For each (points, vertices, faces): the distance of every point to the surface.

    Raises:
        MeshlabError: the child died, took too long, or returned something else.
    """
    arrays = {}
    for index, (points, vertices, faces) in enumerate(pairs):
        arrays |= {f"{index}.points": points, f"{index}.vertices": vertices, f"{index}.faces": faces}
    answers = _run("distances", arrays)
    distances = [answers[f"{index}.distances"] for index in range(len(pairs))]
    for index, (values, (points, _, _)) in enumerate(zip(distances, pairs, strict=True)):
        if values.shape != (len(points),) or not np.isfinite(values).all():
            raise MeshlabError(f"its distances number {index} are not {len(points)} finite numbers")
    return distances


def alpha_wraps(
    surfaces: list[tuple[Float64[np.ndarray, "_ 3"], Int64[np.ndarray, "_ 3"]]],
    *,
    alpha: float,
    offsets: list[float],
    targets: tuple[int, ...] = (),
) -> list[list[tuple[Float64[np.ndarray, "_ 3"], Int64[np.ndarray, "_ 3"]]]]:
    """For each (vertices, faces), possibly open or a soup: closed outward surfaces; the last one encloses it.

    Args:
        alpha: diameter of the ball that carves the space around a surface, in units of the vertices.
        offsets: distance of each wrap from its surface, in the same units.
        targets: face counts to decimate the wrap to; each gives a surface before the wrap itself, enclosing or not.

    Raises:
        MeshlabError: the child died, took too long, or returned no surface.

    Source: Portaneri et al. 2022, Alpha wrapping with an offset.
    """
    arrays = {}
    for index, ((vertices, faces), offset) in enumerate(zip(surfaces, offsets, strict=True)):
        arrays |= {f"{index}.points": vertices, f"{index}.faces": faces}
        arrays |= {f"{index}.sizes": np.array([alpha, offset]), f"{index}.targets": np.array(targets, np.int64)}
    answers = _run("wraps", arrays, timeout_s=TIMEOUT_S + WRAP_TIMEOUT_S * len(surfaces))
    wraps = []
    for index in range(len(surfaces)):
        wraps.append([])
        for step in range(len(targets) + 1):
            vertices = answers[f"{index}.{step}.vertices"]
            faces = answers[f"{index}.{step}.faces"].astype(np.int64)
            if len(faces) < 4 or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
                raise MeshlabError(f"its wrap number {index} has {len(vertices)} vertices and {len(faces)} faces")
            wraps[-1].append((vertices, faces))
    return wraps


def _run(task: Task, arrays: dict[str, np.ndarray], *, timeout_s: float = TIMEOUT_S) -> dict[str, np.ndarray]:
    try:
        return arrays_from_child("proxies.meshing.meshlab", arrays, timeout_s=timeout_s, words=(task,))
    except ChildError as error:
        raise MeshlabError(str(error)) from None


# In the child


def _child(source: Path, target: Path, task: str) -> None:
    import pymeshlab

    with np.load(source) as data:
        arrays = dict(data)
    count = len({name.split(".")[0] for name in arrays})
    answers: dict[str, np.ndarray] = {}
    for index in range(count):
        if task == "wraps":
            answers |= _wrapped(arrays, index)
            continue
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=arrays[f"{index}.points"]))
        if task == "hulls":
            meshes.generate_convex_hull()
            hull = meshes.current_mesh()
            answers |= {f"{index}.vertices": hull.vertex_matrix(), f"{index}.faces": hull.face_matrix()}
        else:
            meshes.add_mesh(
                pymeshlab.Mesh(vertex_matrix=arrays[f"{index}.vertices"], face_matrix=arrays[f"{index}.faces"])
            )
            # No limit: points farther than `maxdist` would get it as their distance.
            meshes.compute_scalar_by_distance_from_another_mesh_per_vertex(
                measuremesh=0, refmesh=1, signeddist=False, maxdist=pymeshlab.PureValue(1e9)
            )
            answers[f"{index}.distances"] = meshes.mesh(0).vertex_scalar_array()
    np.savez(target, allow_pickle=False, **answers)


def _wrapped(arrays: dict[str, np.ndarray], index: int) -> dict[str, np.ndarray]:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=arrays[f"{index}.points"], face_matrix=arrays[f"{index}.faces"]))
    alpha, offset = (pymeshlab.PureValue(float(size)) for size in arrays[f"{index}.sizes"])
    meshes.generate_alpha_wrap(alpha=alpha, offset=offset)
    wrap = meshes.current_mesh_id()
    answers = {}
    # The wrap comes last; each coarser one is made from the wrap, not from another coarse one.
    for step, target in enumerate([*arrays[f"{index}.targets"].tolist(), None]):
        meshes.set_current_mesh(wrap)
        if target is not None:
            meshes.generate_copy_of_current_mesh()
            meshes.meshing_decimation_quadric_edge_collapse(
                targetfacenum=target, preservetopology=True, preservenormal=True
            )
        answers[f"{index}.{step}.vertices"] = meshes.current_mesh().vertex_matrix()
        answers[f"{index}.{step}.faces"] = meshes.current_mesh().face_matrix()
    return answers


if __name__ == "__main__":
    _child(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
