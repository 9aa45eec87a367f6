"""Tests mesh files in scenes that are described in Python."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.checked import unchecked

import hyaline as hy


def described(mesh: "str | Path | trimesh.Trimesh") -> np.ndarray:
    """The corners of a scene's only mesh, sorted."""
    item = hy.Object("ball", mesh, hy.Dielectric())
    found = (
        hy.Scene(objects=[item], cameras=hy.Hemisphere(views=4, test_views=1), name="ball").described().objects[0].mesh
    )
    return np.sort(found.vertices[found.faces].reshape(-1, 9), axis=0)


@pytest.mark.parametrize("ending", ["ply", "glb", "obj"])
def test_a_mesh_from_a_file_is_the_same_as_from_trimesh(ending: str, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2)
    ball.export(tmp_path / f"ball.{ending}")
    assert np.allclose(described(tmp_path / f"ball.{ending}"), described(ball), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "said"), [("nothing.glb", "nothing.glb"), ("cut.ply", "truncated|cut"), ("ball.blend", "can be imported")]
)
def test_a_file_that_holds_no_mesh_is_refused_in_one_line(name: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "cut.ply").write_bytes(trimesh.creation.icosphere(2).export(file_type="ply")[:900])
    with unchecked(), pytest.raises(hy.HyalineError, match=said) as caught:
        described(tmp_path / name)
    assert "\n" not in str(caught.value)
