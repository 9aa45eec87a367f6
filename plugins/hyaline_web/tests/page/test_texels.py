"""Tests which texels a page may leave out, and how it stores the others, and those of metals."""

import numpy as np
import pytest
import torch

from datagen.data.meshes import Mesh
from hyaline_web.page.scene import Packed, add_tints, residuals, touched_texels, zigzag
from model.nets.texture import bilinear_taps, object_layout

IMAGE = np.random.default_rng(0).random((5, 7, 3), np.float32)
TURNED = IMAGE.reshape(7, 5, 3)


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


def guess(known: np.ndarray, y: int, x: int, c: int) -> int:
    """From the neighbours of a texel that are read before it."""
    if y == 0 or x == 0:
        return int(known[y, x - 1, c] if x else known[y - 1, x, c] if y else 0)
    left, above, corner = (int(known[at][c]) for at in ((y, x - 1), (y - 1, x), (y - 1, x - 1)))
    return min(max(left + above - corner, min(left, above)), max(left, above))


@pytest.mark.parametrize("shape", [(1, 1, 2), (1, 5, 1), (6, 1, 1), (5, 9, 3), (9, 5, 2)])
def test_texels_are_read_back_from_what_their_guesses_leave_and_of_others_nothing_is_left(
    shape: tuple[int, int, int],
) -> None:
    rng = np.random.default_rng(sum(shape))
    codes = rng.integers(-8191, 8192, shape).astype(np.int32)
    counts = rng.random(shape[:2]) < 0.7
    left_over = residuals(codes, counts)
    read = np.zeros_like(codes)
    for y, x, c in np.ndindex(shape):
        read[y, x, c] = guess(read, y, x, c) + left_over[y, x, c]
    assert np.array_equal(read[counts], codes[counts])
    assert not left_over[~counts].any()
    assert zigzag(left_over).max() < 1 << 16


def test_each_image_is_stored_as_it_is() -> None:
    packed = Packed()
    assert add_tints(packed, (None, IMAGE, TURNED), "exact") == [None, [0, 7, 5], [35, 5, 7]]
    assert [(entry["name"], entry["dtype"], entry["shape"]) for entry in packed.entries] == [
        ("tints", "float32", [70, 3])
    ]
    stored = np.frombuffer(packed.parts[0], np.uint8).reshape(3, 4, 70).transpose(2, 0, 1)
    assert np.array_equal(np.ascontiguousarray(stored).view(np.float32)[..., 0], np.tile(IMAGE.reshape(-1, 3), (2, 1)))
