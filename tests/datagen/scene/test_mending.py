"""Tests what is mended of a scene that a user brings: that it is said, and that what comes out is right."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.synthetic import synthetic_scene

from datagen.data.meshes import Mesh, face_areas, mesh_from, points_on
from datagen.data.ply import write_ply
from datagen.data.queries import check_closed
from datagen.disk.errors import HyalineError
from datagen.scene.atlas import coverage
from datagen.scene.description import Scene, SceneObject, image_bytes
from datagen.scene.folder import load_scene, save_scene, scene_files
from datagen.scene.images import linear_pixels
from datagen.scene.materials import Diffuse, ImageTexture
from datagen.scene.modelling import ball, merged, moved
from datagen.scene.shading_normals import opposing_share


def with_uv(mesh: Mesh) -> Mesh:
    """The mesh with an atlas of two charts, seen from above and from below."""
    corners = mesh.vertices[mesh.faces]
    is_upper = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0
    low, size = mesh.vertices.min(axis=0), np.ptp(mesh.vertices, axis=0)
    xy = ((corners - low) / size)[..., :2] * [0.49, 1]
    xy[is_upper, :, 0] += 0.5
    faces, normals = np.arange(3 * len(corners)).reshape(-1, 3), mesh.normals[mesh.faces].reshape(-1, 3)
    return mesh_from(corners.reshape(-1, 3), faces, normals, xy.reshape(-1, 2))


BALL = with_uv(ball(0.3, subdivisions=2))
GLASS = {"type": "Dielectric", "ior": 1.5}
GREY = {"type": "Diffuse", "color": [0.5, 0.5, 0.5]}
PHOTO = {"type": "Diffuse", "color": {"type": "ImageTexture", "path": "photo.png"}}


def scene_folder(folder: Path, mesh: Mesh | bytes, material: object = GREY) -> Path:
    """A floor at z = 0 and, above it, the mesh as object `thing`."""
    save_scene(synthetic_scene(), folder)
    data = json.loads((folder / "scene.json").read_text())
    data["objects"][0] = {"name": "thing", "mesh": "meshes/thing.ply", "material": material}
    (folder / "scene.json").write_text(json.dumps(data))
    Image.fromarray(photo()).save(folder / "photo.png")
    if isinstance(mesh, Mesh):
        mesh = write_ply(dataclasses.replace(mesh, vertices=mesh.vertices + np.float32([0, 0, 1])))
    (folder / "meshes" / "thing.ply").write_bytes(mesh)
    return folder


def with_other_uv(mesh: Mesh, change: object) -> Mesh:
    return dataclasses.replace(mesh, uv=change(mesh.uv).astype(np.float32))


@pytest.mark.parametrize(
    ("change", "material", "remark"),
    [
        (np.zeros_like, GLASS, "its uv cover 0 % of the atlas"),
        (
            lambda uv: np.stack([uv[:, 0] % 0.5, uv[:, 1]], axis=-1),
            GREY,
            "its uv overlap on 100.0 % of their texels",
        ),
    ],
)
def test_what_can_be_mended_is_and_a_line_names_the_object(
    change: object, material: object, remark: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = load_scene(scene_folder(tmp_path / "mine", with_other_uv(BALL, change), material))
    said = capsys.readouterr().err
    assert said.startswith(f"scene synthetic: object thing: {remark}; it was unwrapped again")
    assert said.count("\n") == 1
    found = scene.objects[0].mesh
    check_closed(found, where="thing")
    assert len(found.faces) == len(BALL.faces)
    assert opposing_share(found) == 0
    # The corners of a ball's faces look away from its middle.
    outward = found.vertices - np.float32([0, 0, 1])
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    assert np.einsum("vc,vc->v", outward, found.normals).min() > 0.98
    assert coverage(found, 256).max() == 1
    assert (coverage(found, 256) > 0).mean() > 0.2
    # What was mended is not mended again.
    save_scene(scene, tmp_path / "copy")
    assert scene_files(load_scene(tmp_path / "copy")) == scene_files(scene)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("mesh", "material", "message"),
    [
        (
            trimesh.creation.box().apply_translation((0, 0, 1)).export(file_type="ply"),
            PHOTO,
            r"object thing: has no uv for photo\.png; export its mesh with uv",
        ),
        (
            with_other_uv(BALL, np.zeros_like),
            PHOTO,
            r"object thing: its uv cover 0 % of the atlas; photo\.png needs uv in or near \[0, 1\], export its mesh",
        ),
    ],
)
def test_what_cannot_be_mended_is_refused_by_name(
    mesh: Mesh | bytes, material: object, message: str, tmp_path: Path
) -> None:
    with pytest.raises(HyalineError, match=message):
        load_scene(scene_folder(tmp_path, mesh, material))


def photo() -> np.ndarray:
    """Soft blotches in all colours."""
    y, x = np.mgrid[:64, :64] / 64 * 2 * np.pi
    waves = [np.sin(x + 2 * y), np.cos(2 * x) * np.sin(y), np.sin(3 * x) * np.cos(y)]
    return np.rint(127.5 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)


def colours_at(scene: Scene, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """What the image of object 0 shows at places on its faces, from the nearest texel; the image repeats."""
    item = scene.objects[0]
    image = item.material.images().get("color")
    assert image is not None
    pixels = linear_pixels(image_bytes(scene, image), where=image.path)
    uv = np.einsum("pk,pkc->pc", weights, item.mesh.uv[item.mesh.faces[face]])
    height, width = pixels.shape[:2]
    return pixels[
        np.floor((1 - uv[:, 1]) * height).astype(int) % height, np.floor(uv[:, 0] * width).astype(int) % width
    ]


@pytest.mark.parametrize(
    "change", [lambda uv: np.stack([uv[:, 0] % 0.5, uv[:, 1]], axis=-1), lambda uv: 9 * uv], ids=["mirrored", "tiled"]
)
def test_an_image_whose_uv_overlap_is_baked_into_an_atlas_and_looks_the_same(
    change: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = with_other_uv(BALL, change)
    scene = load_scene(scene_folder(tmp_path / "mine", mesh, PHOTO))
    said = capsys.readouterr().err
    assert "it was unwrapped again, and photo.png baked into its new uv" in said
    assert scene.objects[0].mesh.uv.max() <= 1
    assert coverage(scene.objects[0].mesh, 256).max() == 1
    save_scene(scene, tmp_path / "copy")
    assert sorted(path.name for path in (tmp_path / "copy").rglob("*.png")) == ["thing_color.png"]

    pictured = SceneObject(name="thing", mesh=mesh, material=Diffuse(color=ImageTexture(path="photo.png")))
    before = dataclasses.replace(scene, folder=tmp_path / "mine", baked={}, objects=(pictured,))
    rng = np.random.default_rng(2)
    face = rng.integers(len(BALL.faces), size=3000)
    weights = rng.dirichlet([1, 1, 1], size=3000)
    error = np.abs(colours_at(before, face, weights) - colours_at(load_scene(tmp_path / "copy"), face, weights))
    assert error.mean() < 0.03
    assert np.quantile(error, 0.95) < 0.1


def test_points_are_spread_by_area_and_lie_on_their_faces() -> None:
    mesh = merged([moved(ball(0.1, subdivisions=2), (1, 0, 0)), ball(0.2, subdivisions=2)])
    part = np.repeat([0, 1], 320)
    found = points_on(mesh, 4000, part=part, count_a_part=10)
    assert len(found.face) == 4020
    assert np.bincount(part[found.face[4000:]]).tolist() == [10, 10]
    shares = np.bincount(part[found.face[:4000]], minlength=2) / 4000
    areas = np.bincount(part, face_areas(mesh))
    np.testing.assert_allclose(shares, areas / areas.sum(), atol=0.03)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[found.face]].astype(np.float64), 1, 0)
    normals = np.cross(b - a, c - a)
    assert np.abs(np.einsum("pc,pc->p", found.position - a, normals)).max() < 1e-9
