"""Tests that a glTF file is read as viewers read it: arrays, nodes, instances, images."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from support.commands import call
from support.gltf import BOX, GltfBuilder, clear

from datagen.data.images import png_bytes
from datagen.data.meshes import face_corners, signed_volume, welded
from datagen.disk.errors import HyalineError
from datagen.scene.folder import load_scene
from datagen.scene.images import bilinear, linear_pixels, look_up
from datagen.scene.import_choices import ImportChoices
from datagen.scene.modelling import ball
from datagen.scene.remarks import Remarks
from datagen.scene.surfaces import mesh_of
from hyaline_import.foreign import ForeignMaterial, ForeignObject, ForeignScene
from hyaline_import.gltf.scene import read_gltf
from hyaline_import.importing import import_scene

CORNERS = BOX.vertices[BOX.faces]


def read(builder: GltfBuilder, folder: Path) -> ForeignScene:
    return read_gltf(builder.written(folder), Remarks())


def corners(item: ForeignObject) -> np.ndarray:
    return item.positions[item.faces]


def volume(item: ForeignObject) -> float:
    return signed_volume(mesh_of(item.positions, item.faces, item.normals, None, where="x"))


def test_a_glb_and_a_gltf_with_bytes_inside_or_beside_it_hold_the_same(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(), name="box")
    (tmp_path / "inside.gltf").write_bytes(builder.gltf())
    (tmp_path / "beside.gltf").write_bytes(builder.gltf("some%20data.bin"))
    (tmp_path / "some data.bin").write_bytes(bytes(builder.binary))
    found = [read(builder, tmp_path)]
    found += [read_gltf(tmp_path / name, Remarks()) for name in ("inside.gltf", "beside.gltf")]
    for scene in found:
        assert [item.name for item in scene.objects] == ["box"]
        np.testing.assert_array_equal(corners(scene.objects[0]), CORNERS)
        np.testing.assert_array_equal(scene.objects[0].normals, BOX.normals)


def interleaved(builder: GltfBuilder) -> int:
    rows = np.concatenate([BOX.vertices, BOX.normals, np.full((len(BOX.vertices), 2), 9, np.float32)], axis=1)
    view = builder.view(rows.astype("<f4").tobytes(), byteStride=32)
    entry = {"bufferView": view, "componentType": 5126, "count": len(rows), "type": "VEC3"}
    return builder.accessor(entry)


def sparse(builder: GltfBuilder) -> int:
    wrong = BOX.vertices.copy()
    wrong[[3, 7]] = 99
    index = builder.array(wrong)
    builder.content["accessors"][index]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": builder.view(np.array([3, 7], "<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": builder.view(BOX.vertices[[3, 7]].astype("<f4").tobytes())},
    }
    return index


def sparse_of_nothing(builder: GltfBuilder) -> int:
    """Zeros without a buffer view, all of them replaced."""
    count = len(BOX.vertices)
    places = {"bufferView": builder.view(np.arange(count).astype("<u4").tobytes()), "componentType": 5125}
    values = {"bufferView": builder.view(BOX.vertices.astype("<f4").tobytes())}
    entry = {"componentType": 5126, "count": count, "type": "VEC3"}
    return builder.accessor({**entry, "sparse": {"count": count, "indices": places, "values": values}})


def with_offset(builder: GltfBuilder) -> int:
    view = builder.view(b"\1" * 24 + BOX.vertices.astype("<f4").tobytes())
    entry = {"bufferView": view, "byteOffset": 24, "componentType": 5126, "count": len(BOX.vertices), "type": "VEC3"}
    return builder.accessor(entry)


@pytest.mark.parametrize("layout", [interleaved, sparse, sparse_of_nothing, with_offset])
def test_positions_are_the_same_however_their_bytes_are_laid_out(layout: object, tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = builder.mesh()
    builder.content["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"] = layout(builder)
    builder.node(mesh=mesh)
    np.testing.assert_array_equal(corners(read(builder, tmp_path).objects[0]), CORNERS)


@pytest.mark.parametrize(("kind", "largest"), [("i1", 127), ("u1", 255), ("i2", 32767), ("u2", 65535)])
def test_normalised_integers_are_shares_of_the_largest(kind: str, largest: int, tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = builder.mesh()
    raw = np.array([[0, largest, largest // 3]] * len(BOX.vertices))
    index = builder.array(raw, kind, normalized=True)
    builder.content["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"] = index
    builder.node(mesh=mesh)
    positions = read(builder, tmp_path).objects[0].positions
    np.testing.assert_allclose(positions[0], [0, 1, (largest // 3) / largest], atol=1e-12)


def test_strips_and_fans_give_triangles_that_all_look_the_same_way(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], np.float32)
    builder = GltfBuilder()
    position = builder.array(points)
    fan = builder.array(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32))
    primitives = [{"attributes": {"POSITION": position}, "mode": 5}, {"attributes": {"POSITION": fan}, "mode": 6}]
    builder.node(mesh=builder.add("meshes", {"name": "m", "primitives": primitives}))
    strip, turned = read(builder, tmp_path).objects
    assert (strip.name, turned.name) == ("m_0", "m_1")
    for item, area in ((strip, 1.5), (turned, 1.0)):
        a, b, c = np.moveaxis(corners(item), 1, 0)
        normals = np.cross(b - a, c - a)
        assert (normals[:, 2] > 0).all()
        assert normals[:, 2].sum() / 2 == pytest.approx(area)


def test_nodes_scale_turn_and_move_and_pass_that_to_their_children(tmp_path: Path) -> None:
    builder = GltfBuilder()
    quarter = [0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4)]
    child = builder.node(is_root=False, mesh=builder.mesh(), translation=[1, 0, 0])
    builder.node(children=[child], rotation=quarter, scale=[2, 2, 2], translation=[0, 0, 5])
    item = read(builder, tmp_path).objects[0]
    p = BOX.vertices.astype(np.float64) + np.array([1, 0, 0])
    np.testing.assert_allclose(item.positions, np.stack([-2 * p[:, 1], 2 * p[:, 0], 2 * p[:, 2] + 5], -1), atol=1e-6)
    assert volume(item) == pytest.approx(8 * signed_volume(BOX), rel=1e-5)


@pytest.mark.parametrize("key", ["scale", "matrix"])
def test_a_mirroring_node_leaves_a_solid_outward(key: str, tmp_path: Path) -> None:
    builder = GltfBuilder()
    values = {"scale": [-1, 1, 1], "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 3, 0, 0, 1]}
    builder.node(mesh=builder.mesh(), **{key: values[key]})
    item = read(builder, tmp_path).objects[0]
    assert volume(item) == pytest.approx(signed_volume(BOX), rel=1e-5)
    normals = np.cross(*(corners(item)[:, k] - corners(item)[:, 0] for k in (1, 2)))
    assert (np.einsum("fc,fc->f", normals, item.normals[item.faces[:, 0]]) > 0).all()


def test_instances_of_one_node_stand_at_their_own_places(tmp_path: Path) -> None:
    builder = GltfBuilder()
    places = np.array([[0, 0, 0], [3, 0, 0], [0, 4, 0]], np.float32)
    turns = np.array([[0, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]], np.float32)
    attributes = {
        "TRANSLATION": builder.array(places),
        "ROTATION": builder.array(turns),
        "SCALE": builder.array(np.full((3, 3), 0.5)),
    }
    builder.node(
        mesh=builder.mesh(),
        name="cup",
        translation=[0, 0, 1],
        extensions={"EXT_mesh_gpu_instancing": {"attributes": attributes}},
    )
    found = read(builder, tmp_path).objects
    assert len(found) == 3
    for item, place in zip(found, places, strict=True):
        np.testing.assert_allclose(
            (item.positions.min(0) + item.positions.max(0)) / 2, place + np.array([0, 0, 1]), atol=1e-6
        )
        assert volume(item) == pytest.approx(signed_volume(BOX) / 8, rel=1e-5)


def test_a_texture_transform_moves_uv_as_its_extension_says(tmp_path: Path) -> None:
    builder = GltfBuilder()
    image = builder.add("images", {"bufferView": builder.view(b"no picture"), "mimeType": "image/png"})
    texture = builder.add("textures", {"source": image})
    transform = {"offset": [0.5, 0.25], "rotation": math.pi / 2, "scale": [2, 3]}
    use = {"index": texture, "extensions": {"KHR_texture_transform": transform}}
    material = builder.material(pbrMetallicRoughness=clear(baseColorTexture=use))
    builder.node(mesh=builder.mesh(material=material, has_uv=True))
    mesh = builder.content["meshes"][0]["primitives"][0]["attributes"]
    uv = np.random.default_rng(0).uniform(size=(len(BOX.vertices), 2)).astype(np.float32)
    mesh["TEXCOORD_0"] = builder.array(uv)
    found = read(builder, tmp_path).objects[0].uv
    # offset + rotation (scale uv), where a rotation of +90 degrees takes (u, v) to (v, -u).
    u, v = 3 * uv[:, 1] + 0.5, -2 * uv[:, 0] + 0.25
    assert found is not None
    np.testing.assert_allclose(found, np.stack([u, 1 - v], axis=-1), atol=1e-6)


def with_image(sampler: dict, pixels: np.ndarray, uv: np.ndarray) -> GltfBuilder:
    """A triangle with an image."""
    builder = GltfBuilder()
    image = builder.add("images", {"bufferView": builder.view(png_bytes(pixels)), "mimeType": "image/png"})
    texture = builder.add("textures", {"source": image, "sampler": builder.add("samplers", sampler)})
    attributes = {"POSITION": builder.array(np.eye(3)), "TEXCOORD_0": builder.array(uv)}
    material = builder.material(pbrMetallicRoughness=clear(baseColorTexture={"index": texture}))
    primitives = [{"attributes": attributes, "material": material}]
    builder.node(mesh=builder.add("meshes", {"primitives": primitives}), name="card")
    return builder


MIRRORED, CLAMPED = 33648, 33071


@pytest.mark.parametrize("keys", [("wrapS",), ("wrapT",), ("wrapS", "wrapT")])
def test_a_mirrored_image_repeats_as_its_sampler_says(keys: tuple[str, ...], tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (3, 5, 3), np.uint8)
    uv = np.array([[-2.3, 0.1], [1.8, 3.4], [0.6, -1.2]])
    (item,) = read(with_image(dict.fromkeys(keys, MIRRORED), pixels, uv), tmp_path).objects
    assert isinstance(item.material, ForeignMaterial) and item.material.image is not None and item.uv is not None
    image = linear_pixels(item.material.image.data, where="card")
    (found,) = look_up(image, item.uv[None], repeats=True)
    # Every other repeat runs backwards.
    sides = [np.abs((s + 1) % 2 - 1) if key in keys else s % 1 for key, s in zip(("wrapS", "wrapT"), uv.T)]
    wraps = "wrapS" not in keys, "wrapT" not in keys
    original = linear_pixels(png_bytes(pixels), where="card")
    np.testing.assert_allclose(found, bilinear(original, sides[0], sides[1], wraps=wraps), atol=1e-6)


@pytest.mark.parametrize(("beyond", "is_told"), [(1e-5, False), (0.5, True)])
def test_uv_beyond_an_image_that_clamps_are_told(beyond: float, is_told: bool, tmp_path: Path) -> None:
    uv = np.array([[0.5, 0.5], [1 + beyond, 0.5], [0.5, 7]])
    remarks = Remarks()
    builder = with_image({"wrapS": CLAMPED}, np.zeros((2, 2, 3), np.uint8), uv)
    (item,) = read_gltf(builder.written(tmp_path), remarks).objects
    assert item.uv is not None and item.uv[1, 0] == pytest.approx(1.5 if is_told else 1.0, abs=1e-9)
    expected = [("stuff", True)] if is_told else []
    assert [(line.where, line.is_approximation) for line in remarks.lines if "its uv reach" in line.what] == expected


def test_a_mesh_without_normals_is_flat(tmp_path: Path) -> None:
    gem = ball(1.0, subdivisions=1)  # Its faces meet at 18 to 22 degrees.
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(gem), scale=[-0.1, 0.2, 0.1])
    del builder.content["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
    mesh = import_scene(builder.written(tmp_path), ImportChoices(ground="never")).scene.objects[0].mesh
    corners = face_corners(mesh).astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    np.testing.assert_allclose(mesh.normals[mesh.faces], np.repeat(normals[:, None], 3, axis=1), atol=1e-3)


def test_what_its_node_scales_to_nothing_is_left_out_with_a_note(tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = builder.mesh()
    lens = {"type": "perspective", "perspective": {"yfov": 0.6, "aspectRatio": 1.5}}
    below = builder.node(is_root=False, mesh=mesh, name="below")
    seer = builder.node(is_root=False, camera=builder.add("cameras", lens))
    builder.node(scale=[0, 0, 0], children=[below, seer])
    builder.node(mesh=mesh, name="line", scale=[1, 0, 0])
    attributes = {"SCALE": builder.array(np.array([[1, 1, 1], [0, 0, 0]]))}
    builder.node(mesh=mesh, name="cup", extensions={"EXT_mesh_gpu_instancing": {"attributes": attributes}})
    remarks = Remarks()
    scene = read_gltf(builder.written(tmp_path), remarks)
    assert [item.name for item in scene.objects] == ["cup"] and not scene.cameras
    told = {line.where: line.is_approximation for line in remarks.lines}
    assert told == {"below": False, "line": False, "cup": False, "cameras[0]": True}


def test_an_extension_that_is_used_and_not_read_is_an_approximation(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(), extensions={"KHR_node_visibility": {"visible": False}})
    builder.content["extensionsUsed"] = ["KHR_materials_ior", "KHR_xmp_json_ld", "KHR_node_visibility"]
    remarks = Remarks()
    read_gltf(builder.written(tmp_path), remarks)
    (line,) = remarks.lines
    assert line.is_approximation and line.what == "uses the extension 'KHR_node_visibility', which is not read"


def test_only_the_files_own_scene_is_read(tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = builder.mesh()
    builder.node(mesh=mesh, name="seen")
    builder.node(mesh=mesh, name="unseen", is_root=False)
    assert [item.name for item in read(builder, tmp_path).objects] == ["seen"]


def test_what_a_file_requires_and_nobody_reads_is_named(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh())
    builder.content["extensionsRequired"] = ["KHR_materials_ior", "EXT_meshopt_compression"]
    with pytest.raises(HyalineError, match="requires 'EXT_meshopt_compression', which is not read"):
        read(builder, tmp_path)


def test_a_name_that_leads_out_of_the_folder_is_refused_and_not_read(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh())
    (tmp_path / "secret.bin").write_bytes(bytes(builder.binary))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link.bin").symlink_to(tmp_path / "secret.bin")
    outside = (
        "../secret.bin",
        "%2e%2e/secret.bin",
        str(tmp_path / "secret.bin"),
        f"file://{tmp_path}/secret.bin",
        "http://localhost/secret.bin",
        "link.bin",
        "C:/secret.bin",
        "..\\secret.bin",
    )
    for uri in outside:
        (tmp_path / "in" / "a.gltf").write_bytes(builder.gltf(uri))
        with pytest.raises(HyalineError, match=r"expected a file in|is a link out of its folder") as refused:
            read_gltf(tmp_path / "in" / "a.gltf", Remarks())
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("of_mesh", "of_node", "is_approximation"),
    [
        (None, None, False),
        ([0, 0], None, False),
        ([0, 0.5], None, True),
        ([0, 0.5], [0, 0], False),
        (None, [1, 0], True),
    ],
)
def test_a_shape_that_its_morph_targets_change_is_an_approximation(
    of_mesh: list | None, of_node: list | None, is_approximation: bool, tmp_path: Path
) -> None:
    builder = GltfBuilder()
    node = builder.node(mesh=builder.mesh(), name="face")
    mesh = builder.content["meshes"][0]
    mesh["primitives"][0]["targets"] = [dict(mesh["primitives"][0]["attributes"])] * 2
    for entry, weights in ((mesh, of_mesh), (builder.content["nodes"][node], of_node)):
        if weights is not None:
            entry["weights"] = weights
    remarks = Remarks()
    read_gltf(builder.written(tmp_path), remarks)
    assert [(line.where, line.is_approximation) for line in remarks.lines] == [("face", is_approximation)]


def with_draco(folder: Path, data: bytes) -> Path:
    """A file whose one mesh is these bytes, compressed by Draco."""
    builder = GltfBuilder()
    vertices = builder.accessor({"componentType": 5126, "count": 8, "type": "VEC3"})
    extension = {"KHR_draco_mesh_compression": {"bufferView": builder.view(data), "attributes": {"POSITION": 0}}}
    primitive = {"attributes": {"POSITION": vertices}, "extensions": extension}
    builder.content["meshes"].append({"primitives": [primitive]})
    builder.node(mesh=0, name="block")
    return builder.written(folder)


def test_a_mesh_that_draco_has_compressed_is_imported(tmp_path: Path) -> None:
    draco = pytest.importorskip("DracoPy")
    positions, faces = welded(BOX)
    path = with_draco(tmp_path, draco.encode(positions, faces.astype(np.uint32), quantization_bits=16))
    answer = call(f"datagen import {path} --material glass --ground never --out {tmp_path / 'out'}")
    assert answer.status == 0, answer.err
    (item,) = load_scene(tmp_path / "out").objects
    assert signed_volume(item.mesh) == pytest.approx(signed_volume(BOX), rel=1e-3)


def test_without_what_reads_draco_the_error_names_the_part_that_make_setup_installs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "DracoPy" else found(name))
    # In this process: that of the command finds what is really installed.
    with pytest.raises(HyalineError, match=r'`pip install "hyaline-glass\[generate\]"` brings what reads it'):
        read_gltf(with_draco(tmp_path, b"DRACO"), Remarks())
