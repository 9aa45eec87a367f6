"""Tests that broken and hostile files are refused in one line, soon, and without a look outside their folder; and that
odd opacity leaves just the surface that the file means.
"""

import dataclasses
import os
import re
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.foreign import CARD, add, glass_entry, obj_of, png, use_of, xml_of
from support.gltf import BOX, GltfBuilder, clear, glass
from support.hostile import png as png_of
from support.soon import soon

from datagen.data.ply import write_ply
from datagen.disk.errors import HyalineError
from datagen.scene.finding import ImportChoices
from hyaline_import.importing import Imported, import_scene
from hyaline_import.remarks import Remarks
from hyaline_import.source import READERS

HUGE = 2**36
Change = Callable[[dict], object]


def refusal(path: Path, read: Callable[[Path], object] | None = None) -> str:
    """Why a file is not read."""
    read = read or (lambda path: import_scene(path, ImportChoices()))
    with soon(2.5), pytest.raises(HyalineError) as refused:
        read(path)
    text = str(refused.value)
    assert "\n" not in text and "root:" not in text and " at 0x" not in text and len(text) < 1000 and ": " in text
    return text


# glTF: one value of a file that is read is another


def valid() -> GltfBuilder:
    """Two nodes, a mesh, a material with an image."""
    builder = GltfBuilder()
    pbr = clear(baseColorTexture=use_of(builder, b"picture", {}))  # type: ignore[arg-type]
    mesh = builder.mesh(material=builder.material(pbrMetallicRoughness=pbr, extensions=glass()), has_uv=True)
    builder.node(children=[builder.node(is_root=False, mesh=mesh)])
    return builder


def put(path: str, value: object) -> Change:
    """Sets one value in the JSON, by its keys."""

    def change(content: dict) -> None:
        *keys, last = (int(key) if key.isdigit() else key for key in path.split("."))
        for key in keys:
            content = content[key]
        content[last] = value

    return change


def many_places(content: dict) -> None:
    content["nodes"] += [{"mesh": 0}] * 25_000
    content["scenes"][0]["nodes"] = list(range(2, 25_002))


PRIMITIVE, MATERIAL = "meshes.0.primitives.0", "materials.0"
SPARSE = {"count": 1, "indices": {"bufferView": 0, "componentType": 5123}, "values": {"bufferView": 0}}


CHANGES: dict[str, Change] = {
    "no asset": lambda content: content.pop("asset"),
    "a count of 2**36": put("accessors.0.count", HUGE),
    "one element too many": lambda content: content["accessors"][1].update(count=len(BOX.vertices) + 1),
    "a huge accessor without bytes": put("accessors.1", {"componentType": 5126, "count": HUGE, "type": "VEC3"}),
    "a sparse accessor": put("accessors.0.sparse", SPARSE),
    "a skin on the only mesh": put("nodes.0.skin", 0),
    "indices that are floats": put("accessors.3.componentType", 5126),
    "a view longer than its buffer": put("bufferViews.1.byteLength", 10**9),
    "a stride of 3": put("bufferViews.1.byteStride", 3),
    "a buffer shorter than promised": put("buffers.0.byteLength", 10**9),
    "a mesh without primitives": put("meshes.0.primitives", []),
    "a primitive without positions": put(f"{PRIMITIVE}.attributes", {}),
    "indices beyond the vertices": put("accessors.0.count", 8),
    "nothing but points": put(f"{PRIMITIVE}.mode", 0),
    "a mesh that is not there": put("nodes.0.mesh", 8),
    "nodes in a circle": put("nodes.0.children", [1]),
    "a child of two nodes": put("nodes.1.children", [0, 0]),
    "a rotation of length 0": put("nodes.1.rotation", [0, 0, 0, 0]),
    "a scale that overflows": put("nodes.1.scale", [1e300, 1e300, 1e300]),
    "more nodes than can be": put("nodes", [{}] * 100_001),
    "a mesh at very many places": many_places,
    "an alpha mode of its own": put(f"{MATERIAL}.alphaMode", "GLOW"),
    "an index of refraction of 0.5": put(f"{MATERIAL}.extensions.KHR_materials_ior", {"ior": 0.5}),
    "an image outside of the folder": put("images.0", {"uri": "../../etc/passwd"}),
    "an image of a pipe": put("images.0", {"uri": "pipe"}),
    "an image of bad base64": put("images.0", {"uri": "data:image/png;base64,@@@"}),
    "meshopt": put("bufferViews.1.extensions", {"EXT_meshopt_compression": {}}),
    "an unknown extension that is required": put("extensionsRequired", ["VENDOR_secret"]),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_gltf_with_one_wrong_value_is_refused(name: str, tmp_path: Path) -> None:
    builder, path = valid(), tmp_path / "a.glb"
    content = builder.whole()
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    path.write_bytes(builder.glb(content))
    assert len(READERS.find("glb")(path, Remarks()).objects) == 1, "without the change it is read"
    CHANGES[name](content)
    path.write_bytes(builder.glb(content))
    refusal(path)


def test_a_glb_that_is_cut_off_anywhere_or_whose_header_lies_is_refused(tmp_path: Path) -> None:
    data, path = valid().glb(), tmp_path / "a.glb"
    size = struct.unpack_from("<I", data, 12)[0]
    edges = {0, 1, 4, 8, 11, 12, 16, 19, 20, 20 + size - 1, 20 + size, 20 + size + 4, 20 + size + 8}
    spoilt = [data[:end] for end in sorted(edges | set(range(0, len(data) - 1, 511)))]
    lies = ((0, 0x46546C68), (4, 1), (4, 2**31), (8, 2**32 - 1), (8, 12), (12, 2**32 - 1), (12, 0), (16, 7))
    spoilt += [data[:at] + struct.pack("<I", value) + data[at + 4 :] for at, value in lies]
    for changed in spoilt:
        path.write_bytes(changed)
        refusal(path)


def test_a_name_that_leads_out_of_a_gltfs_folder_is_refused_and_not_read(tmp_path: Path) -> None:
    builder = add(GltfBuilder(), "box")
    secret, path = tmp_path / "secret.bin", tmp_path / "in" / "a.gltf"
    secret.write_bytes(bytes(builder.binary))
    path.parent.mkdir()
    (path.parent / "link.bin").symlink_to(secret)
    outside = ["../secret.bin", "%2e%2e/secret.bin", str(secret), f"file://{secret}", "http://localhost/secret.bin"]
    for uri in (*outside, "link.bin", "C:/secret.bin", "..\\secret.bin"):
        path.write_bytes(builder.gltf(uri))
        assert re.search("expected a file in|is a link out of its folder", refusal(path)), uri


# Whole files

HEAD = b'{"asset": {"version": "2.0"}'
FACE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
LIST = PLY + b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
POINTS = b"0 0 0\n1 0 0\n0 1 0\n"
STRIPS = PLY + b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n" + POINTS + b"3 0 1 2\n"
CUBE = '<shape type="cube" id="cube"/>'
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")


def stl(count: int, triangles: int) -> bytes:
    return b"x" * 80 + struct.pack("<I", count) + b"\0" * (50 * triangles)


WHOLE: dict[str, tuple[str, bytes | str]] = {
    "no bytes": ("a.gltf", b""),
    "very deep": ("a.gltf", HEAD + b', "a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"),
    "a number of 5,000 digits": ("a.gltf", HEAD + b', "scene": ' + b"9" * 5000 + b"}"),
    "bytes that are no text": ("a.gltf", HEAD + b', "a": "\xff\xfe"}'),
    "an OBJ without faces": ("a.obj", FACE),
    "a face of index 0": ("a.obj", FACE + "f 0 1 2\n"),
    "a face beyond the vertices": ("a.obj", FACE + "f 1 2 4\n"),
    "a face of 20,000 corners": ("a.obj", FACE + "f " + "1 2 " * 10_000 + "\n"),
    "a vertex of nan": ("a.obj", "v nan 0 0\n" + FACE + "f 1 2 3\n"),
    "a library that is a folder": ("a.obj", "mtllib folder\n" + FACE + "f 1 2 3\n"),
    "a library that is a link out": ("a.obj", "mtllib link.xml\n" + FACE + "f 1 2 3\n"),
    "an STL of 2**32 - 1 triangles": ("a.stl", stl(2**32 - 1, 1)),
    "an STL of nan": ("a.stl", stl(1, 0) + b"\xff" * 50),
    "an STL whose second solid is cut off": ("a.stl", "solid a\nendsolid a\nsolid b\nfacet normal 0 0 1\nouter loop\n"),
    "a PLY of points": ("a.ply", PLY + b"end_header\n" + POINTS),
    "a PLY beyond its vertices": ("a.ply", LIST + POINTS + b"3 0 1 7\n"),
    "a PLY of a list without end": ("a.ply", LIST + POINTS + b"inf 0 1 2\n"),
    "a PLY of too many bytes": ("a.ply", write_ply(BOX) + b"\n"),
    "a PLY of 10**12 vertices": ("a.ply", write_ply(BOX).replace(b"vertex 56", b"vertex 1000000000000")),
    "64 KB of newlines": ("a.ply", b"ply" + b"\n" * 70_000),
    "no scene of Mitsuba": ("a.xml", b'<shape version="3.0.0" type="cube"/>'),
    "an unknown encoding": ("a.xml", b'<?xml version="1.0" encoding="klingon"?><scene version="3.0.0"/>'),
    "a document type": (
        "a.xml",
        b'<!DOCTYPE scene [<!ENTITY x SYSTEM "/etc/passwd">]><scene version="3.0.0">&x;</scene>',
    ),
}


def shape(kind: str, name: str) -> str:
    return f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>'


def cube(inner: str) -> str:
    return f'<shape type="cube">{inner}</shape>'


def textured(texture: str) -> str:
    return cube(f'<bsdf type="diffuse">{texture}</bsdf>')


def image(name: str) -> str:
    return textured(f'<texture name="reflectance" type="bitmap"><string name="filename" value="{name}"/></texture>')


SCENES: dict[str, str] = {
    "nothing to see": "",
    "an include": '<include filename="other.xml"/>' + CUBE,
    "a path for plugins": '<path value="."/>' + CUBE,
    "a shape by a path": '<shape type="../evil"/>',
    "a material of its own": cube('<bsdf type="evil"/>'),
    "a PLY from the root": shape("ply", "/etc/passwd"),
    "a PLY through a link": shape("ply", "link.xml"),
    "a PLY of a pipe": shape("ply", "pipe"),
    "a PLY that is none": shape("ply", "a.xml"),
    "an image from above": image("../other.png"),
    "a flat transform": cube('<transform name="to_world"><scale value="0"/></transform>'),
    "a matrix of three numbers": cube('<transform name="to_world"><matrix value="1 2 3"/></transform>'),
    "a radius below 0": '<shape type="sphere"><float name="radius" value="-1"/></shape>',
    "an unknown glass": cube('<bsdf type="dielectric"><string name="int_ior" value="kryptonite"/></bsdf>'),
    "an interface to a denser medium": cube('<bsdf type="dielectric"><float name="ext_ior" value="1.6"/></bsdf>'),
    "a scattering medium": cube('<bsdf type="dielectric"/><medium name="interior" type="homogeneous"/>'),
    "a reference to nothing": cube('<ref id="gone"/>'),
    "a parameter that is not there": '<shape type="sphere"><float name="radius" value="$r"/></shape>',
    "tags without end": "<scene>" * 5000,
    "very many tags": '<float name="x" value="1"/>' * 200_001,
}


@pytest.mark.parametrize("name", [*WHOLE, *SCENES])
def test_a_hostile_file_is_refused_in_one_line_and_nothing_outside_is_told(name: str, tmp_path: Path) -> None:
    root = tmp_path / "in"
    (root / "folder").mkdir(parents=True)
    for other in ("other.xml", "other.ply", "other.png"):
        (tmp_path / other).write_text(f'<scene version="3.0.0">{CUBE}</scene>')
    (root / "link.xml").symlink_to(tmp_path / "other.xml")
    os.mkfifo(root / "pipe")
    if name in SCENES:
        refusal(xml_of(root, SCENES[name]))
        return
    file, data = WHOLE[name]
    (root / file).write_bytes(data.encode() if isinstance(data, str) else data)
    refusal(root / file)


# Serialized meshes


def packed(*parts: bytes, vertices: int = 3, faces: int = 1) -> bytes:
    body = struct.pack("<I", 0x1000) + b"thing\0" + struct.pack("<QQ", vertices, faces) + b"".join(parts)
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body)


def serialized(mesh: bytes) -> bytes:
    return mesh + struct.pack("<QI", 0, 1)


CORNERS, BODY = np.array([0, 1, 2], "<u4").tobytes(), TRIANGLE.tobytes()
SERIALIZED = {
    "no mesh": b"PK\x03\x04 no mesh at all",
    "2**32 - 1 meshes": serialized(packed(BODY, CORNERS))[:-4] + b"\xff" * 4,
    "2**40 triangles": serialized(packed(BODY, CORNERS, faces=1 << 40)),
    "2**40 vertices": serialized(packed(BODY, CORNERS, vertices=1 << 40)),
    "a vertex that is not there": serialized(packed(BODY, np.array([0, 1, 3], "<u4").tobytes())),
    "nan": serialized(packed((TRIANGLE * np.nan).tobytes(), CORNERS)),
    "no zlib": serialized(b"\x1c\x04\x04\x00not zlib at all"),
}


@pytest.mark.parametrize("name", SERIALIZED)
def test_broken_serialized_files_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "b").write_bytes(SERIALIZED[name])
    assert "/b: " in refusal(xml_of(tmp_path, shape("serialized", "b")))


# Opacity

SIDE = 0.2
UV = (CARD.vertices[:, :2] / SIDE).astype(np.float32)


def image_of(alpha: int | np.ndarray, size: int = 4) -> bytes:
    """A PNG of one green whose alpha is given."""
    pixels = np.full((size, size, 4), 99, np.uint8)
    pixels[..., 3] = alpha
    return png(pixels)


MOST = image_of(np.where(np.arange(8) < 6, 255, 0), 8)
"""Three quarters of it are opaque, from the left."""
MASK, BLEND = {"alphaMode": "MASK"}, {"alphaMode": "BLEND"}


def imported(path: Path) -> Imported:
    """The scene of a file; soon, and without a warning of a number that fits nowhere."""
    with soon(), warnings.catch_warnings():
        warnings.simplefilter("error")
        return import_scene(path, ImportChoices(ground="never"))


def leaf_of(
    folder: Path,
    *,
    image: bytes | None = MOST,
    uv: np.ndarray = UV,
    alpha: float = 1.0,
    is_solid: bool = False,
    number: str = "0.5",
    **entry: object,
) -> Path:
    """A card, or a solid glass box, cut out as told, beside a glass box; `number` stands for `alphaCutoff`."""
    builder = add(GltfBuilder(), "vase", BOX, glass_entry(), scale=[0.1] * 3, translation=[0.1, 0.1, 0.2])
    pbr: dict = {**clear(roughnessFactor=1.0), "baseColorFactor": [1, 1, 1, alpha]}
    if image is not None:
        pbr["baseColorTexture"] = use_of(builder, image)
    mesh = BOX if is_solid else dataclasses.replace(CARD, uv=uv)
    entry |= {"pbrMetallicRoughness": pbr, "extensions": glass() if is_solid else {}, "alphaCutoff": 0.123}
    add(builder, "leaf", mesh, entry)
    (folder / "a.gltf").write_bytes(builder.gltf().replace(b"0.123", number.encode()))
    return folder / "a.gltf"


PANE = "ThinDielectric"
AWAY = "is cut away by its opacity, or most of it; left out"
LEAVES: dict[str, tuple[dict, str, str]] = {
    "a mask": (MASK, "Diffuse", "% of it; drawn whole"),
    "a cutoff below 0": ({**MASK, "number": "-1"}, "Diffuse", ""),
    "a mask of a factor alone": ({**MASK, "image": None, "alpha": 0.2}, "", AWAY),
    "one transparent pixel": ({**MASK, "image": image_of(0, 1)}, "", AWAY),
    "blending": (BLEND, "Diffuse", "% of it; drawn whole"),
    "blending of an image of one alpha": ({**BLEND, "image": image_of(76)}, PANE, "alpha 0.3; drawn as a thin pane"),
    "blending that is nearly opaque": ({**BLEND, "image": None, "alpha": 0.95}, "Diffuse", "drawn opaque"),
    "blending of nothing": ({**BLEND, "image": None, "alpha": 0.0}, "", AWAY),
    "uv in one opaque place": ({**MASK, "uv": 0 * UV}, "Diffuse", ""),
    "uv in one transparent place": ({**MASK, "uv": 0 * UV + np.float32(0.8)}, "", AWAY),
    "blending of glass": ({**BLEND, "alpha": 0.0, "is_solid": True}, "RoughDielectric", "drawn as glass alone"),
}


@pytest.mark.parametrize("name", LEAVES)
def test_opacity_of_gltf_leaves_what_it_means(name: str, tmp_path: Path) -> None:
    odd, kind, told = LEAVES[name]
    done = imported(leaf_of(tmp_path, **odd))
    assert [type(item.material).__name__ for item in done.scene.objects if item.name == "leaf"] == [kind] * bool(kind)
    lines = [line.what for line in done.remarks if line.where == "leaf"]
    assert any(told in line for line in lines) if told else not lines


REFUSED_LEAVES: dict[str, tuple[dict, str]] = {
    "a cutoff of nan": ({"number": "NaN"}, "not a JSON file"),
    "an image of 900 million pixels": ({"image": png_of(30_000, 30_000)}, "not an image that can be read"),
    "an image that is cut off": ({"image": MOST[:60]}, "not an image that can be read"),
    "uv that are no numbers": ({"uv": np.full_like(UV, np.nan)}, "not finite"),
    "uv of 1e30": ({"uv": 1e30 * UV}, r"needs uv in or near \[0, 1\]"),
}


@pytest.mark.parametrize("name", REFUSED_LEAVES)
def test_opacity_of_gltf_that_cannot_be_is_refused(name: str, tmp_path: Path) -> None:
    wrong, message = REFUSED_LEAVES[name]
    assert re.search(message, refusal(leaf_of(tmp_path, **{**MASK, **wrong}), imported))


MTL: dict[str, tuple[str, str]] = {
    "an image of brightness": ("map_d grey.png", "% of it; drawn whole"),
    "an image of alpha": ("map_d alpha.png", "% of it; drawn whole"),
    "an image from the root": ("map_d /etc/passwd", "has the image '/etc/passwd', which is not in its folder"),
    "nothing left": ("map_d black.png", "a.obj: nothing in it is drawn"),
    "opacity of nan": ("d nan", "d: is 'nan'; expected 1 finite numbers"),
}


@pytest.mark.parametrize("name", MTL)
def test_opacity_of_an_mtl_is_refused_or_means_what_it_says(name: str, tmp_path: Path) -> None:
    (tmp_path / "alpha.png").write_bytes(MOST)
    (tmp_path / "grey.png").write_bytes(png(np.where(np.arange(8) < 6, 255, 0)[None].repeat(8, 0)))
    (tmp_path / "black.png").write_bytes(png_of(1, 1))
    text, expected = MTL[name]
    path = obj_of(tmp_path, text, dataclasses.replace(CARD, uv=UV), scale=1.0)
    if name in ("nothing left", "opacity of nan"):
        assert expected in refusal(path, imported)
    else:
        assert any(expected in line.what for line in imported(path).remarks)
