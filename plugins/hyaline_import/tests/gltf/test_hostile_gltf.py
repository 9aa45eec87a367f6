"""Tests that broken and hostile glTF files are refused in one line, soon, and without a look outside their folder."""

import copy
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.gltf import GltfBuilder, clear, glass
from support.soon import soon

from datagen.disk.errors import HyalineError
from datagen.scene.remarks import Remarks
from hyaline_import.gltf.scene import read_gltf

Change = Callable[[dict], object]


def valid() -> GltfBuilder:
    """A file that is read: two nodes, a mesh, a material with an image, a sparse accessor."""
    builder = GltfBuilder()
    image = builder.add("images", {"bufferView": builder.view(b"picture"), "mimeType": "image/png"})
    texture = builder.add("textures", {"source": image, "sampler": builder.add("samplers", {})})
    pbr = clear(baseColorTexture={"index": texture})
    mesh = builder.mesh(material=builder.material(pbrMetallicRoughness=pbr, extensions=glass()), has_uv=True)
    child = builder.node(is_root=False, mesh=mesh)
    builder.node(children=[child])
    position = builder.content["accessors"][0]
    position["sparse"] = {
        "count": 1,
        "indices": {"bufferView": builder.view(np.array([3], "<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": builder.view(np.zeros(3, "<f4").tobytes())},
    }
    return builder


def put(*path: object, value: object) -> Change:
    """Sets one value in the JSON."""

    def change(content: dict) -> None:
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = value

    return change


def drop(*path: object) -> Change:
    def change(content: dict) -> None:
        for key in path[:-1]:
            content = content[key]
        del content[path[-1]]

    return change


def one_too_many(content: dict) -> None:
    content["accessors"][1]["count"] += 1


def second_buffer(content: dict) -> None:
    content["buffers"].append({"byteLength": 4})
    content["bufferViews"][1]["buffer"] = 1


def many_parents(content: dict) -> None:
    content["nodes"] += [{"children": [0]} for _ in range(9)]
    content["scenes"][0]["nodes"] = list(range(2, 11))


def many_places(content: dict) -> None:
    content["nodes"] += [{"mesh": 0}] * 50_000
    content["scenes"][0]["nodes"] = list(range(2, 50_002))


def instancing(attributes: dict) -> dict:
    return {"EXT_mesh_gpu_instancing": {"attributes": attributes}}


def endless_instances(content: dict) -> None:
    content["nodes"][0]["extensions"] = instancing({"TRANSLATION": len(content["accessors"])})
    content["accessors"].append({"componentType": 5126, "count": HUGE, "type": "VEC3"})


PRIMITIVE = ("meshes", 0, "primitives", 0)
SPARSE = ("accessors", 0, "sparse")
HUGE = 2**36

CHANGES: dict[str, Change] = {
    "no asset": drop("asset"),
    "version 1": put("asset", "version", value="1.0"),
    "version of a number": put("asset", "version", value=2),
    "accessors are no list": put("accessors", value={}),
    "an accessor is no object": put("accessors", 0, value=7),
    "a count of 2**36": put("accessors", 0, "count", value=HUGE),
    "a count below 0": put("accessors", 0, "count", value=-3),
    "a count of 0": put("accessors", 0, "count", value=0),
    "a count that is a string": put("accessors", 0, "count", value="24"),
    "a count with a fraction": put("accessors", 0, "count", value=2.5),
    "a count that is true": put("accessors", 0, "count", value=True),
    "one element too many": one_too_many,
    "no count": drop("accessors", 0, "count"),
    "a huge accessor without bytes": put("accessors", 1, value={"componentType": 5126, "count": HUGE, "type": "VEC3"}),
    "an offset behind the view": put("accessors", 1, "byteOffset", value=10**6),
    "an offset below 0": put("accessors", 1, "byteOffset", value=-4),
    "an unknown component type": put("accessors", 1, "componentType", value=5130),
    "indices that are floats": put("accessors", 3, "componentType", value=5126),
    "positions that are pairs": put("accessors", 0, "type", value="VEC2"),
    "an unknown type": put("accessors", 0, "type", value="VEC9"),
    "a view that is not there": put("accessors", 1, "bufferView", value=99),
    "a view of index -1": put("accessors", 1, "bufferView", value=-1),
    "a view longer than its buffer": put("bufferViews", 1, "byteLength", value=10**9),
    "a view that begins behind its buffer": put("bufferViews", 1, "byteOffset", value=10**9),
    "a view that begins below 0": put("bufferViews", 1, "byteOffset", value=-8),
    "a view without bytes": put("bufferViews", 1, "byteLength", value=0),
    "a stride of 3": put("bufferViews", 1, "byteStride", value=3),
    "a stride of 10**9": put("bufferViews", 1, "byteStride", value=10**9),
    "a view of a buffer that is not there": put("bufferViews", 1, "buffer", value=4),
    "a buffer shorter than promised": put("buffers", 0, "byteLength", value=10**9),
    "a second buffer without bytes": second_buffer,
    "a sparse count beyond the accessor": put(*SPARSE, "count", value=10**6),
    "a sparse index beyond the accessor": put(*SPARSE, "indices", "bufferView", value=2),
    "sparse indices of floats": put(*SPARSE, "indices", "componentType", value=5126),
    "sparse values that are cut off": put(*SPARSE, "values", "byteOffset", value=4),
    "a mesh without primitives": put("meshes", 0, "primitives", value=[]),
    "a primitive without positions": put(*PRIMITIVE, "attributes", value={}),
    "indices that are not there": put(*PRIMITIVE, "indices", value=50),
    "indices beyond the vertices": put("accessors", 0, "count", value=8),
    "a mode of 9": put(*PRIMITIVE, "mode", value=9),
    "nothing but points": put(*PRIMITIVE, "mode", value=0),
    "a material that is not there": put(*PRIMITIVE, "material", value=3),
    "a mesh that is not there": put("nodes", 0, "mesh", value=8),
    "a node that is its own child": put("nodes", 0, "children", value=[0]),
    "nodes in a circle": put("nodes", 0, "children", value=[1]),
    "a child of two nodes": put("nodes", 1, "children", value=[0, 0]),
    "a child that is not there": put("nodes", 1, "children", value=[7]),
    "children that are no list": put("nodes", 1, "children", value=3),
    "a scene that is not there": put("scene", value=2),
    "a matrix of 15 numbers": put("nodes", 1, "matrix", value=[1.0] * 15),
    "a scale of 0": put("nodes", 1, "scale", value=[0, 0, 0]),
    "a rotation of length 0": put("nodes", 1, "rotation", value=[0, 0, 0, 0]),
    "a scale that overflows": put("nodes", 1, "scale", value=[1e300, 1e300, 1e300]),
    "a node below many": many_parents,
    "instances without end": endless_instances,
    "instances of no attribute": put("nodes", 0, "extensions", value=instancing({})),
    "more nodes than can be": put("nodes", value=[{}] * 100_001),
    "a mesh at very many places": many_places,
    "an alpha mode of its own": put("materials", 0, "alphaMode", value="GLOW"),
    "an index of refraction of 0.5": put("materials", 0, "extensions", "KHR_materials_ior", value={"ior": 0.5}),
    "an attenuation distance below 0": put(
        "materials", 0, "extensions", "KHR_materials_volume", value={"attenuationDistance": -1}
    ),
    "colours of two numbers": put("materials", 0, "pbrMetallicRoughness", "baseColorFactor", value=[1, 1]),
    "a texture that is not there": put("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "index", value=9),
    "an image that is not there": put("textures", 0, "source", value=5),
    "an image outside of the folder": put("images", 0, value={"uri": "../../etc/passwd"}),
    "an image of a folder": put("images", 0, value={"uri": "folder"}),
    "an image of a pipe": put("images", 0, value={"uri": "pipe"}),
    "an image of bad base64": put("images", 0, value={"uri": "data:image/png;base64,@@@"}),
    "extensions that are no object": put("materials", 0, "extensions", value=[1]),
    "an extension that is null": put("materials", 0, "extensions", "KHR_materials_volume", value=None),
    "Draco bytes that are none": put(
        *PRIMITIVE, "extensions", value={"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    ),
    "meshopt": put("bufferViews", 1, "extensions", value={"EXT_meshopt_compression": {}}),
    "an unknown extension that is required": put("extensionsRequired", value=["VENDOR_secret"]),
}


def refusal(path: Path) -> str:
    with soon(), pytest.raises(HyalineError) as refused:
        read_gltf(path, Remarks())
    text = str(refused.value)
    assert "\n" not in text and len(text) < 1000 and text.count(": ") >= 1
    return text


def glb_of(content: dict, binary: bytes) -> bytes:
    builder = GltfBuilder()
    builder.content, builder.binary = content, bytearray(binary)
    data = builder.glb()
    if "buffers" not in content:
        return data
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("name", CHANGES)
def test_a_file_with_one_wrong_value_is_refused(name: str, tmp_path: Path) -> None:
    builder = valid()
    content = {**copy.deepcopy(builder.content), "buffers": [{"byteLength": len(builder.binary)}]}
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "a.glb"
    path.write_bytes(glb_of(content, bytes(builder.binary)))
    assert len(read_gltf(path, Remarks()).objects) == 1, "without the change it is read"
    CHANGES[name](content)
    path.write_bytes(glb_of(content, bytes(builder.binary)))
    refusal(path)


def test_a_glb_that_is_cut_off_anywhere_is_refused(tmp_path: Path) -> None:
    data = valid().glb()
    size = struct.unpack_from("<I", data, 12)[0]
    edges = {0, 1, 4, 8, 11, 12, 16, 19, 20, 20 + size - 1, 20 + size, 20 + size + 4, 20 + size + 8}
    path = tmp_path / "a.glb"
    for end in sorted(edges | set(range(0, len(data) - 1, 511))):
        path.write_bytes(data[:end])
        refusal(path)


def test_headers_that_lie_are_refused(tmp_path: Path) -> None:
    data, path = valid().glb(), tmp_path / "a.glb"
    for at, value in ((0, 0x46546C68), (4, 1), (4, 2**31), (8, 2**32 - 1), (8, 12), (12, 2**32 - 1), (12, 0), (16, 7)):
        path.write_bytes(data[:at] + struct.pack("<I", value) + data[at + 4 :])
        refusal(path)


TEXTS = {
    "nothing": b"",
    "no JSON": b"solid cube",
    "a list": b"[]",
    "half a JSON": b'{"asset": {"version": "2.0"}',
    "very deep": b'{"asset": {"version": "2.0"}, "a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "a number that is none": b'{"asset": {"version": "2.0"}, "scene": NaN}',
    "a number of 5,000 digits": b'{"asset": {"version": "2.0"}, "scene": ' + b"9" * 5000 + b"}",
    "a key twice": b'{"asset": {"version": "2.0"}, "asset": {}}',
    "no scene": b'{"asset": {"version": "2.0"}}',
    "bytes that are no text": b'{"asset": {"version": "2.0"}, "a": "\xff\xfe"}',
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_that_is_no_gltf_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    path.write_bytes(TEXTS[name])
    refusal(path)
