"""pymeshlab's alpha wrap, run in a child process.

pymeshlab kills its process on some inputs and never returns from others, so it runs in a child with a time limit:
`python -m proxies.meshing.meshlab IN.npz OUT.npz`.
"""

# pymeshlab fills its namespace when it is imported; pyright sees none of it.
# pyright: reportAttributeAccessIssue=false

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from datagen.disk.errors import HyalineError
from datagen.machine.processes import ChildError, arrays_from_child
from datagen.terminal.plugins import install_command

TIMEOUT_S = 180.0
"""Time limit of one wrap; a few seconds are usual."""


def alpha_wrap(
    corners: Float64[np.ndarray, "face 3 3"], *, alpha: float, offset: float
) -> tuple[Float64[np.ndarray, "vertex 3"], Int64[np.ndarray, "_ 3"]]:
    """Vertices and faces of a closed, outward surface around triangles, which may be open or a soup.

    Args:
        alpha: diameter of the ball that carves the space around the triangles, in their units.
        offset: distance of the wrap from the triangles, in the same units.

    Source: Portaneri et al. 2022, Alpha wrapping with an offset.
    """
    try:
        wrap = arrays_from_child(
            "proxies.meshing.meshlab", {"corners": corners, "sizes": np.array([alpha, offset])}, timeout_s=TIMEOUT_S
        )
    except ChildError as error:
        remedy = "`apt install libgl1`" if "libGL" in str(error) else f"`{install_command('proxies')}`"
        raise HyalineError(f"a wrap needs pymeshlab ({error}); try {remedy}, or make `--kind hull`") from None
    vertices, faces = wrap["vertices"], wrap["faces"].astype(np.int64)
    if len(faces) < 4 or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise HyalineError(f"a wrap has {len(vertices)} vertices and {len(faces)} faces; make `--kind hull`")
    return vertices, faces


def _child(source: Path, target: Path) -> None:
    import pymeshlab

    with np.load(source) as arrays:
        corners, sizes = arrays["corners"].reshape(-1, 3), arrays["sizes"]
    meshes = pymeshlab.MeshSet()
    # Each triangle separately: pymeshlab 2025.7 drops some triangles that share an edge in the wrong direction.
    faces = np.arange(len(corners)).reshape(-1, 3)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=corners, face_matrix=faces))
    alpha, offset = (pymeshlab.PureValue(float(size)) for size in sizes)
    meshes.generate_alpha_wrap(alpha=alpha, offset=offset)
    wrap = meshes.current_mesh()
    np.savez(target, allow_pickle=False, vertices=wrap.vertex_matrix(), faces=wrap.face_matrix())


if __name__ == "__main__":
    _child(Path(sys.argv[1]), Path(sys.argv[2]))
