"""Tests that OBJ with MTL, STL and PLY files are read as the programs that write them mean them."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.checked import unchecked
from support.foreign import CARD, obj_of, refused, taken
from support.meshes import polygon_ply
from support.soon import soon

import hyaline as hy
from datagen.data.meshes import open_edges, signed_volume
from datagen.scene.materials import ThinDielectric
from hyaline_import.foreign import PLAIN, ForeignMaterial, ForeignObject, ForeignScene
from hyaline_import.pictures import stored
from hyaline_import.remarks import Remarks
from hyaline_import.source import READERS
from hyaline_import.surfaces import made_sound, mesh_of


def read(path: Path, data: bytes | str, remarks: Remarks | None = None) -> ForeignScene:
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return READERS.find(path.suffix[1:])(path, remarks or Remarks())


def solid_volume(item: ForeignObject) -> float:
    mesh = mesh_of(item.positions, item.faces, item.normals, item.uv, where="x")
    mesh = made_sound(mesh, Remarks(), where="x")
    assert open_edges(mesh) == 0
    return signed_volume(mesh)


CUBE = """
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
f 4 3 2 1 # a side
f 5 6 7 8
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f -5 -8 -4 -1
"""


L_SHAPE = ((2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0))
"""Around its first corner, triangles would leave it."""


def l_prism(kind: str) -> bytes:
    """A prism over an L, one unit high."""
    points = [(x, y, z) for z in (0, 1) for x, y in L_SHAPE]
    sides = [(i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6)]
    faces = [(6, 7, 8, 9, 10, 11), (0, 5, 4, 3, 2, 1), *sides]
    if kind == "obj":
        lines = ["v {} {} {}\n".format(*point) for point in points]
        lines += ["f " + " ".join(str(corner + 1) for corner in face) + "\n" for face in faces]
        return "".join(lines).encode()
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    counts = f"element vertex 12\n{axes}element face 8\nproperty list uchar int vertex_indices\n"
    if kind == "ascii":
        rows = [*points, *((len(face), *face) for face in faces)]
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    else:
        body = np.array(points, "<f4").tobytes()
        body += b"".join(bytes([len(face)]) + np.array(face, "<i4").tobytes() for face in faces)
    return f"ply\nformat {kind} 1.0\n{counts}end_header\n".encode() + body


@pytest.mark.parametrize("kind", ["obj", "ascii", "binary_little_endian"])
def test_a_concave_polygon_is_covered_once_by_triangles_inside_it(kind: str, tmp_path: Path) -> None:
    (item,) = read(tmp_path / f"l.{'obj' if kind == 'obj' else 'ply'}", l_prism(kind)).objects
    a, b, c = np.moveaxis(item.positions[item.faces], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2 == pytest.approx(3 + 3 + 8)
    assert len(item.faces) == 20 and solid_volume(item) == pytest.approx(3)


def test_an_obj_is_parted_by_objects_and_materials_and_keeps_uv_and_normals(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "b.mtl").write_text("newmtl clear\nillum 4\nNi 1.33\n")
    text = (
        "mtllib a.mtl b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1 1 0 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\no first\n"
        "usemtl red\nf 1/1/1 2/2/1 3/3/1\nusemtl clear\nf 1//1 2//1 4//1\no second\nusemtl red\nf 1 3 \\\n 4\n"
    )
    remarks = Remarks()
    first, clear, second = read(tmp_path / "a.obj", text, remarks).objects
    assert [item.name for item in (first, clear, second)] == ["first", "first", "second"]
    assert first.uv is not None and first.normals is not None
    np.testing.assert_array_equal(first.uv[first.faces[0]], [[0, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(first.positions[first.faces[0]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert clear.uv is None and clear.normals is not None and second.normals is None
    assert isinstance(clear.material, ForeignMaterial)
    assert (clear.material.transmission, clear.material.ior) == (1.0, 1.33)
    assert [line.what for line in remarks.lines] == ["has colours at its vertices, which are left out"]


@pytest.mark.parametrize("line", ["my lib.mtl", '"my lib.mtl"', '"./my lib.mtl"', '".\\my lib.mtl"'])
def test_names_of_libraries_and_images_may_be_in_quotes_and_as_windows_writes_them(line: str, tmp_path: Path) -> None:
    (tmp_path / "my lib.mtl").write_text('newmtl m\nKd 1 0 0\nmap_Kd "my wood.png"\n')
    Image.new("RGB", (2, 2), (9, 8, 7)).save(tmp_path / "my wood.png")
    remarks = Remarks()
    material = read(tmp_path / "a.obj", f"mtllib {line}\nusemtl m\n{CUBE}", remarks).objects[0].material
    assert isinstance(material, ForeignMaterial) and material.base_color == (1, 0, 0) and remarks.lines == []
    assert material.image is not None and material.image.data == (tmp_path / "my wood.png").read_bytes()


def material_of(folder: Path, text: str, remarks: Remarks | None = None, name: str = "m") -> ForeignMaterial:
    (folder / "m.mtl").write_text(f"newmtl {name}\n{text}\n")
    material = read(folder / "a.obj", f"mtllib m.mtl\nusemtl {name}\n{CUBE}", remarks).objects[0].material
    assert isinstance(material, ForeignMaterial)
    return material


MAYA = "illum 4\nKd 0.7 0.1 0.1\nKa 0 0 0\nTf 1.00 1.00 1.00\nNi 1.00"
MESHLAB = "Ka 0.2 0.2 0.2\nKd 1 1 1\nKs 1 1 1\nTr 1.000000\nillum 2\nNs 0.0"
BLENDER = "Ns 250\nKa 1 1 1\nKs 0.5 0.5 0.5\nKe 0 0 0\nNi 1.45\nd {}\nillum {}"
BLENDER_PBR = "Ns 250\nKs 0.5 0.5 0.5\nNi 1.45\nd 1\nillum 2\nPr 0.1\nPm 0\nPs 0\nPc 0\nTf {0} {0} {0}"
MAX = "Ns 32\nd {}\nTr {}\nTf {}\nillum 2\nKa 0.6 0.6 0.6\nKd 0.6 0.6 0.6\nKs 0.35 0.35 0.35"
RHINO = "Ka 0 0 0\nKd 1 1 1\nKs 1 1 1\nTf 0.0 0.0 0.0\nd {}\nNs 0"
PICTURE = "\nmap_Kd a.png"
CLEAR = (1.0, 1.0, 1.0)
PROGRAMS: dict[str, tuple[str, tuple[float, float, float] | None]] = {
    "Maya: a lambert": (MAYA, None),
    "Maya: a lambert with a picture": (MAYA + PICTURE, None),
    "Maya: a clear lambert": (MAYA.replace("Tf 1.00 1.00 1.00", "Tf 0.00 0.00 0.00"), None),
    "Maya: a blinn with a dissolve": (MAYA.replace("Tf 1.00 1.00 1.00", "d 0.5"), CLEAR),
    "a dissolve with a halo": (MAYA.replace("Tf 1.00 1.00 1.00", "d -halo 0.5"), CLEAR),
    "Maya: glass with an index": ("illum 4\nKd 0 0 0\nTf 0.00 0.00 0.00\nNi 1.50", CLEAR),
    "MeshLab: a scan": (MESHLAB + PICTURE, None),
    "MeshLab: a mesh without a picture": (MESHLAB, None),
    "OpenMVS: a scan": ("Ka 1 1 1\nKd 1 1 1\nKs 0 0 0\nTr 1.000000\nillum 1\nNs 1.0" + PICTURE, None),
    "Blender: opaque": (BLENDER.format(1, 2), None),
    "Blender: alpha 0.3": (BLENDER.format(0.3, 9), CLEAR),
    "Blender: alpha 0.95": (BLENDER.format(0.95, 9), CLEAR),
    "Blender: alpha 0.95 with a picture": (BLENDER.format(0.95, 9) + PICTURE, None),
    "Blender: transmission 0 by its extension": (BLENDER_PBR.format(0), None),
    "Blender: transmission 1 by its extension": (BLENDER_PBR.format(1), (0.7, 0.7, 0.7)),
    "3ds Max: opaque": (MAX.format(1, 0, "1 1 1"), None),
    "3ds Max: opaque with a picture": (MAX.format(1, 0, "1 1 1") + PICTURE, None),
    "3ds Max: transparent": (MAX.format(0.2, 0.8, "0.5 0.6 0.7"), (0.5, 0.6, 0.7)),
    "Rhino: opaque": (RHINO.format(1), None),
    "Rhino: transparent": (RHINO.format(0.2), CLEAR),
    "Cinema 4D: opaque": ("Kd 0.8 0.8 0.8\nKs 1 1 1\nNs 50\nillum 7", None),
    "by hand: illum and index": ("illum 6\nNi 1.5\nTf 0.9 0.8 0.7", (0.9, 0.8, 0.7)),
    "by hand: illum and Tr": ("illum 7\nTr 1", CLEAR),
    "by hand: dissolve": ("d 0", CLEAR),
    "by hand: illum alone": ("illum 4", None),
    "the specification: a windscreen": ("Ka 0 0 0\nKd 0 0 0\nKs 0.9 0.9 0.9\nd 0.1\nNs 200\nillum 4", CLEAR),
}
"""The material as a program writes it, and the colour of its glass; None where it is opaque."""


@pytest.mark.parametrize("case", PROGRAMS)
def test_what_programs_write_for_glass_is_glass_and_what_they_write_for_opaque_things_is_not(
    case: str, tmp_path: Path
) -> None:
    Image.new("RGB", (2, 2), (9, 8, 7)).save(tmp_path / "a.png")
    text, color = PROGRAMS[case]
    material = material_of(tmp_path, text)
    assert material.transmission == (0 if color is None else 1)
    assert material.base_color == color if color else max(material.base_color) > 0
    assert (material.image is not None) == (PICTURE in text)


@pytest.mark.parametrize(("name", "ior"), [("Window_Glass", 1.5), ("paint", None)])
@pytest.mark.parametrize(("text", "is_denied"), [("illum 4", False), ("illum 4\nNi 1", True)])
def test_illum_is_glass_where_the_name_says_so_unless_its_index_is_1(
    name: str, ior: float | None, text: str, is_denied: bool, tmp_path: Path
) -> None:
    material = material_of(tmp_path, text, name=name)
    assert (material.transmission, material.ior) == ((1, ior) if ior and not is_denied else (0, 1))


def test_glass_with_a_picture_has_its_mean_colour_and_that_is_said(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (255, 188, 0)).save(tmp_path / "a.png")
    done = taken(obj_of(tmp_path, "Kd 1 1 1\nd 0.3\nNi 1.5\nmap_Kd a.png\nmap_d a.png", CARD), "--ground never")
    pane = done["thing"].material
    assert isinstance(pane, ThinDielectric) and pane.tint == pytest.approx((1, 0.503, 0), abs=1e-3)
    assert "thing: has an image where only one colour can be; drawn in its mean colour" in done.err
    assert "m: has map_d, which is left out" in done.err


@pytest.mark.parametrize(
    ("text", "expected", "line"),
    [
        ("Ni 1.62\nd 0.3\nKd 0.2 0.2 0.2\nNs 20", {"transmission": 1.0, "ior": 1.62, "roughness": 0.0}, ""),
        # Of Phong's exponent n, alpha is sqrt(2 / (n + 2)).
        ("Kd 0.2 0.3 0.4\nNs 98\nillum 2\nd 1", {"base_color": (0.2, 0.3, 0.4), "roughness": 0.02**0.25}, ""),
        ("Pr 0.25\nPm 1", {"roughness": 0.25, "metallic": 1.0}, ""),
        ("Ni 1.0\nd 0.1", {"ior": 1.5}, "is glass with an index of refraction of 1; drawn with 1.5"),
        ("Pc 0.5", {}, "has pc, which is left out"),
    ],
)
def test_a_material_of_an_mtl_has_its_numbers_and_a_line_for_what_is_left_out(
    text: str, expected: dict, line: str, tmp_path: Path
) -> None:
    remarks = Remarks()
    material = material_of(tmp_path, text, remarks)
    for key, value in expected.items():
        assert getattr(material, key) == pytest.approx(value)
    assert [told.what for told in remarks.lines] == [line] * bool(line)


@pytest.mark.parametrize(
    ("options", "is_told"),
    [
        ("-s 2 2 1 -clamp on", True),
        ("-t 1e-1 -2 -mm 0 1", True),
        ("-s 1.000 1.000 1.000 -o 0.000 0.000 0.000", False),
        ("-blendu on -blendv on -boost 0 -mm 0 1 -t 0 -imfchan l -bm 1.0 -cc off", False),
    ],
)
def test_an_image_is_found_after_its_options_and_those_that_move_it_are_told(
    options: str, is_told: bool, tmp_path: Path
) -> None:
    Image.new("RGB", (2, 2)).save(tmp_path / "a b.png")
    remarks = Remarks()
    assert material_of(tmp_path, f"map_Kd {options} a b.png", remarks).image is not None
    assert [f"options move or scale ({options})" in line.what for line in remarks.lines] == [True] * is_told


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw", "jpeg"])
def test_a_tiff_is_read_as_a_texture(compression: str, tmp_path: Path) -> None:
    Image.new("RGB", (8, 8), (200, 100, 50)).save(tmp_path / "a.tif", compression=compression)
    material = material_of(tmp_path, "Kd 1 1 1\nmap_Kd a.tif")
    assert material.image is not None
    assert stored(material.image)[3, 3] == pytest.approx([200, 100, 50, 255], abs=2)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_a_comment_that_ends_in_a_backslash_leaves_the_next_line_as_it_is(end: str, tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_bytes(end.join(["newmtl m", " # from C:\\models\\", "Kd 1 0 0", ""]).encode("utf-8-sig"))
    text = f"# saved in C:\\models\\\nmtllib m.mtl\n# by\\\nusemtl m\n{CUBE}".replace("\n", end)
    material = read(tmp_path / "a.obj", text.encode()).objects[0].material
    assert isinstance(material, ForeignMaterial) and material.base_color == (1, 0, 0)


@pytest.mark.parametrize("name", ["gone.png", "../m.mtl", "/etc/passwd", "C:\\wood.png", "-s 1 1 1", ".", '""', ""])
def test_an_image_or_a_library_that_is_not_in_the_folder_is_left_out_and_that_is_said(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / "m.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (tmp_path / "in").mkdir()
    remarks = Remarks()
    (item,) = read(tmp_path / "in" / "a.obj", f"mtllib {name}\nusemtl m\n{CUBE}", remarks).objects
    assert item.material == PLAIN
    assert "which is not in its folder; drawn without these materials" in remarks.lines[0].what
    assert [line.what for line in remarks.lines[1:]] == ["names the material 'm', which is not there; drawn grey"]
    remarks = Remarks()
    assert material_of(tmp_path / "in", f"map_Kd {name}", remarks).image is None
    assert not name or "which is not in its folder; drawn without it" in remarks.lines[-1].what


BALL = trimesh.creation.icosphere(2, 0.5)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_an_stl_is_a_closed_solid_in_millimetres(kind: str, tmp_path: Path) -> None:
    scene = read(tmp_path / "ball.stl", BALL.export(file_type=kind))
    assert (scene.up, scene.metres) == ("z", 0.001)
    assert solid_volume(scene.objects[0]) == pytest.approx(BALL.volume, rel=1e-5)


def test_two_solids_of_an_stl_are_two_objects_by_their_names(tmp_path: Path) -> None:
    """The lower one in capitals, as some CAD programs write them."""
    upper = trimesh.creation.icosphere(2, 20).apply_translation((0, 0, 60)).export(file_type="stl_ascii")
    lower = trimesh.creation.box((40, 40, 40)).export(file_type="stl_ascii").upper()
    (tmp_path / "a.stl").write_text(f"{_named(upper, 'ball')}\n{_named(lower, 'Foot 1')}\n")
    ball, foot = taken(tmp_path / "a.stl", "--material ball=glass --ground never").scene.objects
    assert (ball.name, type(ball.material).__name__) == ("ball", "Dielectric")
    assert (foot.name, type(foot.material).__name__) == ("Foot_1", "Diffuse")
    assert signed_volume(foot.mesh) == pytest.approx(0.04**3, rel=1e-5)


def _named(stl: str, name: str) -> str:
    """A solid of this name; trimesh writes none."""
    first, _, rest = stl.partition("\n")
    return f"{first.split()[0]} {name}\n{rest}"


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_a_ply_of_several_lists_and_of_elements_that_nobody_needs_is_read(end: bytes, tmp_path: Path) -> None:
    """As MeshLab writes uv of corners, between numbers of other types, and edges after the faces."""
    text = (
        b"ply\nformat binary_big_endian 1.0\nobj_info element face 9\nelement vertex 4\nproperty uchar red\n"
        b"property double x\nproperty double y\nproperty double z\nelement face 2\nproperty short flags\n"
        b"property list uchar int vertex_indices\nproperty list ushort float texcoord\n"
        b"element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    )
    body = b"".join(struct.pack(">B3d", 7, *point) for point in ((0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)))
    body += struct.pack(">hB3iH6f", 1, 3, 0, 1, 2, 6, *range(6)) + struct.pack(">hB4iH0f", 1, 4, 0, 1, 2, 3, 0)
    (item,) = read(tmp_path / "a.ply", text.replace(b"\n", end) + body + struct.pack(">2i", 0, 1)).objects
    assert item.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]
    np.testing.assert_array_equal(item.positions[2], [2, 2, 0])


@pytest.mark.parametrize(("order", "extra"), [("little", False), ("big", False), ("little", True)])
def test_a_ply_of_triangles_quads_and_polygons_is_one_solid(order: str, extra: bool, tmp_path: Path) -> None:
    path, whole = tmp_path / "prism.ply", polygon_ply(12, order, extra)
    path.write_bytes(whole)
    mesh = taken(path, "--material glass --scale 0.1").scene.objects[0].mesh
    assert len(mesh.faces) == 24 + 10 + 12
    assert signed_volume(mesh) == pytest.approx(12 * math.sin(2 * math.pi / 12) * 0.1**3, rel=1e-5)
    for cut in (1, 60, 300):
        path.write_bytes(whole[:-cut])
        assert "prism.ply" in refused(path)


def test_a_ply_of_too_many_polygons_is_refused_before_it_takes_memory(tmp_path: Path) -> None:
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uint uchar vertex_indices\nend_header\n"
    )
    path = tmp_path / "bomb.ply"
    path.write_bytes(header.encode() + bytes(12) + np.array([30_000_000], "<u4").tobytes() + bytes(30_000_000))
    with soon(10):
        assert "holds polygons of 29,999,998 triangles; expected" in refused(path)


# In scenes that are described in Python


def described(mesh: Path | trimesh.Trimesh) -> np.ndarray:
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
