"""Imports in tests lay out texture coordinates at once; how well the real atlas does is tested in test_mending.py."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import pytest

from datagen.data.meshes import Mesh


@pytest.fixture(autouse=True)
def quick_atlas(monkeypatch: pytest.MonkeyPatch) -> None:
    """An atlas of a sphere takes seconds, unless it is in the cache."""
    monkeypatch.setattr("datagen.scene.mending.unwrap_all", cell_by_cell)


def cell_by_cell(meshes: Mapping[str, Mesh]) -> dict[str, Mesh]:
    """Each triangle in a cell of its own."""
    return {name: _cells(mesh) for name, mesh in meshes.items()}


def _cells(mesh: Mesh) -> Mesh:
    count = len(mesh.faces)
    side = math.ceil(math.sqrt(count))
    cells = np.stack([np.arange(count) % side, np.arange(count) // side], axis=-1)
    uv = (cells[:, None] + [(0.1, 0.1), (0.8, 0.1), (0.1, 0.8)]) / side
    corners = mesh.faces.reshape(-1)
    return dataclasses.replace(
        mesh,
        vertices=mesh.vertices[corners],
        normals=mesh.normals[corners],
        uv=uv.reshape(-1, 2).astype(np.float32),
        faces=np.arange(3 * count, dtype=mesh.faces.dtype).reshape(-1, 3),
    )
