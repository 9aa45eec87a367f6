"""Tests what is mended of surfaces, and that what comes out is right."""

import dataclasses

import numpy as np
import pytest

from datagen.data.meshes import Mesh, check_closed
from datagen.scene.modelling import ball
from datagen.scene.shading_normals import opposing_share
from hyaline_import.remarks import Remarks
from hyaline_import.surfaces import mend_surface

BALL = ball(0.3, subdivisions=2)
A, B, C = BALL.faces[0].tolist()
LONELY = Mesh(
    vertices=np.concatenate([BALL.vertices, np.float32([[0, 0, 90]])]),
    faces=BALL.faces,
    normals=np.concatenate([BALL.normals, np.float32([[np.nan] * 3])]),
    uv=np.concatenate([BALL.uv, np.float32([[7, 7]])]),
)


def with_faces(*more: tuple[int, int, int]) -> Mesh:
    return dataclasses.replace(BALL, faces=np.concatenate([BALL.faces, np.array(more, np.int32)]))


def with_normals(count: int, factor: float) -> Mesh:
    factors = np.where(np.arange(len(BALL.normals)) < count, factor, 1)[:, None]
    return dataclasses.replace(BALL, normals=(BALL.normals * factors).astype(np.float32))


@pytest.mark.parametrize(
    ("mesh", "is_solid", "remark"),
    [
        (with_normals(1000, -1), True, "100.0 % of its vertex normals pointed to the back of their faces"),
        (with_normals(1000, 0), True, "100.0 % of its vertex normals were 0 or not finite"),
        (with_normals(1, np.nan), True, "1 of its vertex normals were 0 or not finite; these were computed again"),
        (with_faces((A, A, A)), True, "1 of its faces have no area; they were left out"),
        (with_faces((A, A, B)), True, "1 of its faces have no area; they were left out"),
        (with_faces((B, C, A)), True, "1 of its faces are there twice; they were left out"),
        (with_faces((B, A, C)), False, "1 of its faces are there twice; they were left out"),
        (LONELY, True, "1 of its vertices belong to no face; they were left out"),
    ],
)
def test_a_surface_is_mended_and_a_line_says_what_was_wrong(mesh: Mesh, is_solid: bool, remark: str) -> None:
    remarks = Remarks()
    found = mend_surface(mesh, remarks, is_solid=is_solid, where="thing")
    assert len(remarks.lines) == 1 and remarks.lines[0].what.startswith(remark)
    check_closed(found, where="thing")
    assert len(found.faces) == len(BALL.faces)
    assert opposing_share(found) == 0
    outward = found.vertices / np.linalg.norm(found.vertices, axis=-1, keepdims=True)
    assert np.einsum("vc,vc->v", outward, found.normals).min() > 0.98
    assert mend_surface(found, remarks, is_solid=is_solid, where="thing") is found and len(remarks.lines) == 1
