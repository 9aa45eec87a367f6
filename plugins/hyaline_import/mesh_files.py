"""A file of another program as one mesh, for scenes that are described in Python."""

from pathlib import Path

import numpy as np

from datagen.machine.confined import allow_triangles, confined
from datagen.scene.remarks import Remarks
from hyaline_import.foreign_files import READERS, check_ending, ending_of


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices, faces and uv of all objects in a file as one mesh, read in a process of its own."""
    check_ending(path)
    with confined(write_arrays, path.absolute(), where=str(path)) as folder, np.load(folder / "mesh.npz") as found:
        return found["vertices"], found["faces"], found.get("uv")


def write_arrays(folder: Path, path: Path) -> None:
    """Reads a mesh file, in the process that `confined` starts."""
    parts = READERS.find(ending_of(path))(path, Remarks()).objects
    allow_triangles(sum(len(part.faces) for part in parts))
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    arrays = {
        "vertices": np.concatenate([part.positions for part in parts]),
        "faces": np.concatenate([part.faces + start for part, start in zip(parts, starts)]),
    }
    if all(part.uv is not None for part in parts):
        arrays["uv"] = np.concatenate([part.uv for part in parts])
    np.savez(folder / "mesh.npz", allow_pickle=False, **arrays)
