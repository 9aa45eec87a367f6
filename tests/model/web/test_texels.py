"""Tests which texels a page may leave out."""

import numpy as np
import pytest
import torch

from datagen.data.meshes import Mesh, no_mesh
from model.nets.texture import bilinear_taps, object_layout
from model.web.texels import touched_texels


def random_mesh(rng: np.random.Generator, faces: int, extent: float) -> Mesh:
    """Triangles whose uv are about so wide; they lie nowhere in particular."""
    middle = rng.random((faces, 1, 2))
    uv = np.clip(middle + extent * (rng.random((faces, 3, 2)) - 0.5), 0, 1).reshape(-1, 2).astype(np.float32)
    points = np.zeros((len(uv), 3), np.float32)
    return Mesh(vertices=points, faces=np.arange(len(uv), dtype=np.int32).reshape(-1, 3), normals=points, uv=uv)


@pytest.mark.parametrize(("size", "extent"), [(7, 0.5), (40, 0.02), (40, 0.9), (129, 0.3)])
def test_every_texel_that_a_look_up_reads_counts_and_most_others_do_not(size: int, extent: float) -> None:
    rng = np.random.default_rng(size)
    mesh = random_mesh(rng, 6, extent)
    counts = touched_texels(mesh, size)
    shares = rng.dirichlet((0.7, 0.7, 0.7), size=(6, 4000)).astype(np.float32)
    uv = np.einsum("fpk,fkc->fpc", shares, mesh.uv[mesh.faces]).reshape(-1, 2).clip(0, 1)
    rows, weights = bilinear_taps(torch.from_numpy(uv), torch.ones(len(uv), dtype=torch.uint8), object_layout((size,)))
    read = np.unique(rows.numpy()[weights.numpy() > 0])
    assert counts[read].all()
    near = np.zeros((size + 4, size + 4), bool)
    for down in range(5):
        for right in range(5):
            near[read // size + down, read % size + right] = True
    assert not counts[~near[2:-2, 2:-2].ravel()].any()


def test_of_a_mesh_without_faces_no_texel_counts() -> None:
    assert not touched_texels(no_mesh(), 9).any()
