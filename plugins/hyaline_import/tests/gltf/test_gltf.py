"""Tests that a glTF file is read as viewers read it: arrays, nodes, instances, images."""

import math
from pathlib import Path

import numpy as np
import pytest
from support.foreign import add, use_of, volume
from support.gltf import BOX, GltfBuilder
from support.meshes import corner_cosines

from datagen.data.meshes import signed_volume
from datagen.scene.finding import ImportChoices
from datagen.scene.modelling import ball
from hyaline_import.foreign import ForeignObject, ForeignScene
from hyaline_import.gltf.scene import read_gltf
from hyaline_import.importing import import_scene
from hyaline_import.remarks import Remarks

CORNERS = BOX.vertices[BOX.faces]


def read(builder: GltfBuilder, folder: Path, remarks: Remarks | None = None) -> ForeignScene:
    return read_gltf(builder.written(folder), remarks or Remarks())


def corners(item: ForeignObject) -> np.ndarray:
    return item.positions[item.faces]


def told(remarks: Remarks) -> list[tuple[str, bool]]:
    return [(line.where, line.is_approximation) for line in remarks.lines]


def test_a_glb_and_a_gltf_with_bytes_inside_or_beside_it_hold_the_same(tmp_path: Path) -> None:
    builder = add(GltfBuilder(), "box")
    (tmp_path / "inside.gltf").write_bytes(builder.gltf())
    (tmp_path / "beside.gltf").write_bytes(builder.gltf("some%20data.bin"))
    (tmp_path / "some data.bin").write_bytes(bytes(builder.binary))
    found = [read(builder, tmp_path)]
    found += [read_gltf(tmp_path / name, Remarks()) for name in ("inside.gltf", "beside.gltf")]
    for scene in found:
        assert [item.name for item in scene.objects] == ["box"]
        np.testing.assert_array_equal(corners(scene.objects[0]), CORNERS)
        np.testing.assert_array_equal(scene.objects[0].normals, BOX.normals)


@pytest.mark.parametrize(("kind", "largest"), [("i1", 127), ("u1", 255), ("i2", 32767), ("u2", 65535)])
def test_normalised_integers_are_shares_of_the_largest(kind: str, largest: int, tmp_path: Path) -> None:
    builder = add(GltfBuilder(), "box")
    raw = np.array([[0, largest, largest // 3]] * len(BOX.vertices))
    index = builder.array(raw, kind, normalized=True)
    builder.content["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = index
    positions = read(builder, tmp_path).objects[0].positions
    np.testing.assert_allclose(positions[0], [0, 1, (largest // 3) / largest], atol=1e-12)


def test_nodes_scale_turn_and_move_and_pass_that_to_their_children(tmp_path: Path) -> None:
    builder = GltfBuilder()
    quarter = [0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4)]
    child = builder.node(is_root=False, mesh=builder.mesh(), translation=[1, 0, 0])
    builder.node(children=[child], rotation=quarter, scale=[2, 2, 2], translation=[0, 0, 5])
    builder.node(mesh=builder.mesh(), name="unseen", is_root=False)
    (item,) = read(builder, tmp_path).objects
    p = BOX.vertices.astype(np.float64) + np.array([1, 0, 0])
    np.testing.assert_allclose(item.positions, np.stack([-2 * p[:, 1], 2 * p[:, 0], 2 * p[:, 2] + 5], -1), atol=1e-6)
    assert volume(item) == pytest.approx(8 * signed_volume(BOX), rel=1e-5)


@pytest.mark.parametrize("node", [{"scale": [-1, 1, 1]}, {"matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 3, 0, 0, 1]}])
def test_a_mirroring_node_leaves_a_solid_outward(node: dict, tmp_path: Path) -> None:
    item = read(add(GltfBuilder(), "box", **node), tmp_path).objects[0]
    assert volume(item) == pytest.approx(signed_volume(BOX), rel=1e-5)
    normals = np.cross(*(corners(item)[:, k] - corners(item)[:, 0] for k in (1, 2)))
    assert (np.einsum("fc,fc->f", normals, item.normals[item.faces[:, 0]]) > 0).all()


def card(sampler: dict, pixels: np.ndarray, uv: np.ndarray, **use: object) -> GltfBuilder:
    """A triangle with an image."""
    builder = GltfBuilder()
    texture = {**use_of(builder, pixels, sampler), **use}
    attributes = {"POSITION": builder.array(np.eye(3)), "TEXCOORD_0": builder.array(uv)}
    material = builder.material(pbrMetallicRoughness={"metallicFactor": 0, "baseColorTexture": texture})
    primitives = [{"attributes": attributes, "material": material}]
    builder.node(mesh=builder.add("meshes", {"primitives": primitives}), name="card")
    return builder


def test_a_texture_transform_moves_uv_as_its_extension_says(tmp_path: Path) -> None:
    transform = {"offset": [0.5, 0.25], "rotation": math.pi / 2, "scale": [2, 3]}
    uv = np.random.default_rng(0).uniform(size=(3, 2)).astype(np.float32)
    builder = card({}, np.zeros((2, 2, 3)), uv, extensions={"KHR_texture_transform": transform})
    found = read(builder, tmp_path).objects[0].uv
    # offset + rotation (scale uv), where a rotation of +90 degrees takes (u, v) to (v, -u).
    u, v = 3 * uv[:, 1] + 0.5, -2 * uv[:, 0] + 0.25
    assert found is not None
    np.testing.assert_allclose(found, np.stack([u, 1 - v], axis=-1), atol=1e-6)


@pytest.mark.parametrize(("sampler", "is_told"), [({}, False), ({"wrapS": 33648}, True), ({"wrapT": 33071}, True)])
def test_an_image_that_the_file_mirrors_or_clamps_is_told(sampler: dict, is_told: bool, tmp_path: Path) -> None:
    remarks = Remarks()
    read(card(sampler, np.zeros((2, 2, 3)), np.eye(3)[:, :2]), tmp_path, remarks)
    assert told(remarks) == [("stuff", True)] * is_told


def test_a_mesh_without_normals_is_flat(tmp_path: Path) -> None:
    gem = ball(1.0, subdivisions=1)  # Its faces meet at 18 to 22 degrees.
    builder = add(GltfBuilder(), "gem", gem, scale=[-0.1, 0.2, 0.1])
    del builder.content["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
    mesh = import_scene(builder.written(tmp_path), ImportChoices(ground="never")).scene.objects[0].mesh
    np.testing.assert_allclose(corner_cosines(mesh), 1, atol=1e-6)


def test_skinned_meshes_are_left_out_and_shape_keys_are_not_read_and_both_are_told(tmp_path: Path) -> None:
    builder = GltfBuilder()
    skin = builder.add("skins", {"joints": [0]})
    builder.node(mesh=builder.mesh(BOX), name="arm", skin=skin, scale=[100, 100, 100])
    builder.node(mesh=builder.mesh(BOX), name="face", weights=[0.0, 0.5])
    builder.node(mesh=builder.mesh(BOX), name="still", weights=[0.0, 0.0])
    remarks = Remarks()
    assert [item.name for item in read(builder, tmp_path, remarks).objects] == ["face", "still"]
    assert told(remarks) == [("arm", True), ("face", True)]
