"""Tests mesh files in scenes that are described in Python."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.checked import unchecked

import hyaline as hy


def described(mesh: "Path | trimesh.Trimesh") -> np.ndarray:
    """The corners of a scene's only mesh, sorted."""
    item = hy.Object("ball", mesh, hy.Dielectric())
    scene = hy.Scene(objects=[item], cameras=hy.Hemisphere(views=4, test_views=1), name="ball").described()
    found = scene.objects[0].mesh
    return np.sort(found.vertices[found.faces].reshape(-1, 9), axis=0)


def test_a_mesh_from_a_file_is_the_same_as_from_trimesh_and_a_broken_one_is_refused(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2)
    for ending in ("ply", "glb", "obj"):
        ball.export(tmp_path / f"ball.{ending}")
        assert np.allclose(described(tmp_path / f"ball.{ending}"), described(ball), atol=1e-6)
    (tmp_path / "cut.ply").write_bytes((tmp_path / "ball.ply").read_bytes()[:900])
    for name, said in (("nothing.glb", "nothing.glb"), ("cut.ply", "truncated|cut"), ("ball.blend", "can be imported")):
        with unchecked(), pytest.raises(hy.HyalineError, match=said) as caught:
            described(tmp_path / name)
        assert "\n" not in str(caught.value)
