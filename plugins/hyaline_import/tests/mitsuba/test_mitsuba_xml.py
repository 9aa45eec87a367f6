"""Tests that Mitsuba scenes are parsed and never loaded, and mean what they mean there."""

import math
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.foreign import volume, xml_of
from support.gltf import BOX

from benchmarks.sky import radiance_of_map
from datagen.data.images import encode_float_exr
from datagen.data.meshes import face_corners, signed_volume
from datagen.data.ply import write_ply
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import EnvironmentMap, SoftEnvironment
from datagen.scene.finding import ImportChoices
from datagen.scene.images import linear_pixels, look_up, read_map
from datagen.scene.materials import Color, Conductor, Dielectric, Plastic, RoughDielectric
from hyaline_import.foreign import ForeignMaterial, ForeignScene
from hyaline_import.importing import import_scene
from hyaline_import.mitsuba.scene import read_mitsuba
from hyaline_import.remarks import Remarks

use_mitsuba()
import mitsuba as mi  # noqa: E402

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0,-3,1.5" target="0,0,0.5" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="64"/></film></sensor>"""
BALL = '<shape type="sphere" id="ball"><bsdf type="dielectric"/></shape>'
CUBE = '<shape type="cube" id="cube"/>'


def read(folder: Path, body: str, remarks: Remarks | None = None) -> ForeignScene:
    return read_mitsuba(xml_of(folder, body), remarks or Remarks())


def material_of(folder: Path, bsdf: str, remarks: Remarks | None = None) -> ForeignMaterial:
    material = read(folder, f'<shape type="cube">{bsdf}</shape>', remarks).objects[0].material
    assert isinstance(material, ForeignMaterial)
    return material


def test_shapes_have_the_places_and_volumes_that_their_transforms_say(tmp_path: Path) -> None:
    (tmp_path / "box.ply").write_bytes(write_ply(BOX))
    (tmp_path / "tri.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    move = '<transform name="to_world"><scale x="-2" y="1" z="1"/><translate x="5"/></transform>'
    scene = read(
        tmp_path,
        f'<shape type="cube">{move}</shape>'
        '<shape type="sphere"><float name="radius" value="0.5"/><point name="center" x="0" y="0" z="3"/></shape>'
        f'<shape type="ply"><string name="filename" value="box.ply"/>{move}</shape>'
        '<shape type="obj"><string name="filename" value="tri.obj"/></shape>'
        '<shape type="cube"><boolean name="flip_normals" value="true"/></shape>',
    )
    cube, ball, ply, obj, flipped = scene.objects
    assert [volume(item) for item in (cube, ply, flipped)] == pytest.approx([16, 2 * signed_volume(BOX), -8], rel=1e-5)
    assert volume(ball) == pytest.approx(math.pi / 6, rel=2e-3)
    np.testing.assert_allclose([cube.positions.min(0), cube.positions.max(0)], [[3, -1, -1], [7, 1, 1]])
    np.testing.assert_allclose(ball.positions.mean(0), [0, 0, 3], atol=1e-6)
    # Mitsuba turns the v of OBJ files round, and its images: as it is in the file, v points up.
    assert obj.uv is not None and ply.uv is not None
    np.testing.assert_allclose(obj.uv[obj.faces[0]], [[0, 0], [1, 0], [0, 1]])
    np.testing.assert_allclose(ply.uv, np.stack([BOX.uv[:, 0], 1 - BOX.uv[:, 1]], -1), atol=1e-7)


OLD = """<scene version="0.6.0">
<bsdf type="dielectric" id="Glass"><float name="intIOR" value="1.9"/><float name="extIOR" value="1"/></bsdf>
<shape type="cube"><transform name="toWorld"><scale value="2"/><translate x="0.3"/></transform><ref id="Glass"/></shape>
<shape type="sphere"><boolean name="flipNormals" value="true"/><float name="radius" value="0.5"/></shape>
<sensor type="perspective"><float name="fov" value="30"/>
<transform name="toWorld"><lookat origin="0,-3,1.5" target="0,0,0.5" up="0,0,1"/></transform></sensor></scene>"""


def test_a_scene_of_mitsuba_before_2_is_what_mitsuba_makes_of_it(tmp_path: Path) -> None:
    path = tmp_path / "old.xml"
    path.write_text(OLD)
    scene, theirs = read_mitsuba(path, Remarks()), mi.load_file(str(path), parallel=False)
    assert isinstance(theirs, mi.Scene)
    cube, ball = scene.objects
    assert isinstance(cube.material, ForeignMaterial) and cube.material.ior == pytest.approx(1.9)
    assert volume(ball) < 0
    boxes = sorted((shape.bbox() for shape in theirs.shapes()), key=lambda box: -box.volume())
    for item, box in zip((cube, ball), boxes, strict=True):
        np.testing.assert_allclose([item.positions.min(0), item.positions.max(0)], [box.min, box.max], atol=2e-3)
    assert scene.up == "z"


def test_glass_is_relative_to_what_is_around_it_and_absorbs_by_its_medium(tmp_path: Path) -> None:
    medium = (
        '<medium name="interior" type="homogeneous"><rgb name="sigma_t" value="0.1,0.2,0.3"/>'
        '<float name="scale" value="20"/><float name="albedo" value="0"/></medium>'
    )
    bsdf = '<bsdf type="dielectric"><string name="int_ior" value="water"/></bsdf>'
    path = xml_of(tmp_path, f'<shape type="sphere" id="drop">{bsdf}{medium}</shape>')
    material = import_scene(path, ImportChoices(scale=0.1)).scene.objects[0].material
    assert isinstance(material, Dielectric)
    assert material.ior == pytest.approx(1.3330 / 1.000277)
    # Per metre: ten times as much as per unit of a tenth.
    np.testing.assert_allclose(material.absorption, [20, 40, 60], rtol=1e-6)


FACETS = '<string name="distribution" value="ggx"/><float name="alpha" value="0.2"/>'
INDICES = '<float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/>'


@pytest.mark.parametrize(
    ("bsdf", "expected"),
    [
        (f'<bsdf type="dielectric">{INDICES}</bsdf>', Dielectric(ior=1.5)),
        (f'<bsdf type="roughdielectric">{INDICES}{FACETS}</bsdf>', RoughDielectric(ior=1.5, roughness=0.2)),
        (
            f'<bsdf type="dielectric">{INDICES}<rgb name="specular_transmittance" value="0.5 1 0.25"/></bsdf>',
            Dielectric(ior=1.5, tint=(0.5, 1.0, 0.25)),
        ),
        (f'<bsdf type="twosided"><bsdf type="roughplastic">{INDICES}{FACETS}<boolean name="nonlinear" value="true"/>'
         '<rgb name="diffuse_reflectance" value="0.1,0.2,0.3"/></bsdf></bsdf>',
         Plastic(color=(0.1, 0.2, 0.3), ior=1.5, roughness=0.2)),
        (f'<bsdf type="roughconductor">{FACETS}<string name="material" value="none"/>'
         '<rgb name="specular_reflectance" value="0.9,0.5,0.25"/></bsdf>',
         Conductor(color=(0.9, 0.5, 0.25), roughness=0.2)),
    ],
)  # fmt: skip
def test_bsdfs_that_we_have_are_taken_one_to_one(bsdf: str, expected: object, tmp_path: Path) -> None:
    done = import_scene(xml_of(tmp_path, f'<shape type="cube">{bsdf}</shape>'), ImportChoices())
    found = done.scene.objects[0].material
    assert type(found) is type(expected)
    for key, value in vars(expected).items():
        np.testing.assert_allclose(getattr(found, key), value, rtol=1e-6)
    assert done.record["approximations"] == []


@pytest.mark.parametrize(
    ("inner", "expected"),
    [
        ("", (1, 1, 1)),  # Mitsuba 3.9 prints eta = 0, k = 1 for it: everything is mirrored.
        ('<rgb name="k" value="0.5,1,2"/>', (1, 1, 1)),
        ('<rgb name="eta" value="1,2,3"/>', (1 / 5, 2 / 10, 5 / 17)),
        ('<rgb name="eta" value="0.2,1,3"/><rgb name="k" value="3,0,2"/>', (9.64 / 10.44, 0.0, 8 / 20)),
    ],
)
def test_a_conductor_mirrors_as_fresnel_says_straight_on(inner: str, expected: Color, tmp_path: Path) -> None:
    for plugin in ("conductor", "roughconductor"):
        entry = material_of(tmp_path, f'<bsdf type="{plugin}">{inner}</bsdf>')
        np.testing.assert_allclose(entry.base_color, expected, rtol=1e-6)


def test_a_spectrum_with_one_value_is_the_colour_that_mitsuba_makes_of_it(tmp_path: Path) -> None:
    paint = '<bsdf type="diffuse" id="paint"><spectrum name="reflectance" value="0.3"/></bsdf>'
    emitter = '<emitter type="area"><spectrum name="radiance" value="5"/></emitter>'
    cubes = '<shape type="cube"><ref id="paint"/></shape>' * 2
    scene = read(tmp_path, f'{paint}{cubes}<shape type="rectangle">{emitter}</shape>')
    theirs = mi.traverse(mi.load_file(str(tmp_path / "a.xml")).emitters()[0])["radiance.value"]
    np.testing.assert_allclose(scene.lights[0].radiance, np.array(theirs).reshape(3), rtol=1e-5)
    colors = [item.material.base_color for item in scene.objects if isinstance(item.material, ForeignMaterial)]
    np.testing.assert_allclose(colors, np.full((2, 3), 0.3), rtol=1e-6)


WRAPPED = (
    '<shape type="rectangle"><bsdf type="diffuse"><texture name="reflectance" type="bitmap">'
    '<string name="filename" value="a.png"/>{}</texture></bsdf></shape>'
)
MOVED = '<transform name="to_uv"><scale x="3" y="2"/><translate x="-0.7" y="0.4"/></transform>'


def test_an_image_repeats_beyond_its_edges_as_mitsuba_has_it(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    (item,) = read(tmp_path, WRAPPED.format(MOVED)).objects
    assert isinstance(item.material, ForeignMaterial) and item.material.image is not None and item.uv is not None
    x, y = np.random.default_rng(1).uniform(-1, 1, (2, 50)).astype(np.float32)
    # The uv of a flat shape are linear in the place.
    plane = np.linalg.lstsq(item.positions + np.array([0, 0, 1]), item.uv, rcond=None)[0]
    image = linear_pixels(item.material.image.data, where="a.png")
    (ours,) = look_up(image, (np.stack([x, y, np.ones(50)], axis=-1) @ plane)[None], repeats=True)
    loaded = mi.load_file(str(tmp_path / "a.xml"))
    si = loaded.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1), mi.Vector3f(0, 0, -1)))
    np.testing.assert_allclose(ours, np.array(si.bsdf().eval_diffuse_reflectance(si)).T, atol=2e-3)


def test_normals_that_a_file_lacks_are_those_that_mitsuba_computes(tmp_path: Path) -> None:
    """Smooth over sharp edges, or flat where the file asks for it."""
    gem = trimesh.creation.icosphere(subdivisions=1).apply_scale((1, 1.5, 0.2))
    gem.export(tmp_path / "gem.ply", vertex_normal=False)
    center = gem.triangles_center.T.astype(np.float32)
    normal = gem.face_normals.T.astype(np.float32)
    for is_flat in ("true", "false"):
        name = '<string name="filename" value="gem.ply"/>'
        body = f'{SENSOR}<shape type="ply">{name}<boolean name="face_normals" value="{is_flat}"/></shape>'
        mesh = import_scene(xml_of(tmp_path, body), ImportChoices()).scene.objects[0].mesh
        np.testing.assert_allclose(face_corners(mesh).mean(axis=1), center.T, atol=1e-5)
        ours = mesh.normals[mesh.faces].mean(axis=1)
        ours /= np.linalg.norm(ours, axis=-1, keepdims=True)
        origin = mi.Point3f(*(center + 0.1 * normal))
        si = mi.load_file(str(tmp_path / "a.xml")).ray_intersect(mi.Ray3f(origin, mi.Vector3f(*-normal)))
        np.testing.assert_allclose(ours, np.array(si.sh_frame.n).T, atol=1e-3)


def test_lights_are_where_the_file_puts_them(tmp_path: Path) -> None:
    lamp = (
        '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="180"/><translate z="4"/></transform>'
        '<emitter type="area"><rgb name="radiance" value="6,5,4"/></emitter></shape>'
    )
    sky = '<emitter type="constant"><rgb name="radiance" value="0.5,0.6,0.7"/></emitter>'
    mirrored = lamp.replace('<rotate x="1" angle="180"/>', '<scale x="-1"/>')
    scene = import_scene(xml_of(tmp_path, f"{SENSOR}{BALL}{lamp}{mirrored}{sky}"), ImportChoices()).scene
    assert [item.name for item in scene.objects] == ["ball"], "no ground is added, and lamps are no objects"
    light, other = scene.lights
    normals = [np.cross(each.edge_u, each.edge_v) / 4 for each in (light, other)]
    np.testing.assert_allclose(normals, [[0, 0, -1], [0, 0, 1]], atol=1e-12)
    # Mitsuba 3.9 answers what rounding leaves of a turn, 2e-16, with radiance that is no number.
    assert all(value == 0 or abs(value) > 1e-6 for value in (*light.edge_u, *light.edge_v))
    assert isinstance(scene.environment, SoftEnvironment)
    np.testing.assert_allclose([light.radiance, scene.environment.zenith], [[6, 5, 4], [0.5, 0.6, 0.7]], rtol=1e-6)


# Serialized meshes

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
SHAPE = """<shape type="serialized"><string name="filename" value="a.serialized"/>
<integer name="shape_index" value="{}"/></shape>"""


def packed(flags: int, *arrays: np.ndarray, version: int) -> bytes:
    name = b"thing\0" if version == 4 else b""
    counts = struct.pack("<QQ", len(arrays[0]), len(arrays[-1]))
    body = struct.pack("<I", flags) + name + counts + b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)
    return struct.pack("<HH", 0x041C, version) + zlib.compress(body)


@pytest.mark.parametrize("version", [3, 4])
def test_each_mesh_of_a_serialized_file_lies_as_mitsuba_has_it(version: int, tmp_path: Path) -> None:
    faces = np.array([[0, 1, 2]], "<u4")
    uv = np.array([[0, 0], [1, 0], [0, 1]], "<f8")
    box = BOX.vertices.astype("<f4"), BOX.normals.astype("<f4"), BOX.uv.astype("<f4"), BOX.faces.astype("<u4")
    up, black = np.tile(np.array([0, 0, 1], "<f4"), (3, 1)), np.zeros((3, 3), "<f4")
    meshes = [
        packed(0x1003, *box, version=version),
        packed(0x2002, (2 * TRIANGLE).astype("<f8"), uv, faces, version=version),
        packed(0x1009, TRIANGLE, up, black, faces, version=version),
    ]
    offsets = np.cumsum([0, *map(len, meshes)])[:-1].astype("<u8" if version == 4 else "<u4")
    data = b"".join(meshes) + offsets.tobytes() + struct.pack("<I", len(meshes))
    (tmp_path / "a.serialized").write_bytes(data)
    for index in range(3):
        (item,) = read(tmp_path, SHAPE.format(index)).objects
        theirs = mi.traverse(mi.load_file(str(tmp_path / "a.xml")).shapes()[0])
        positions = np.array(theirs["vertex_positions"]).reshape(-1, 3)
        np.testing.assert_allclose(item.positions, positions, atol=1e-7)
        assert (item.faces == np.array(theirs["faces"]).reshape(-1, 3)).all()
        assert (item.uv is None) == (index == 2)
        if item.uv is not None:
            down = np.array(theirs["vertex_texcoords"]).reshape(-1, 2)[:, 1]
            np.testing.assert_allclose(item.uv[:, 1], 1 - down, atol=1e-7)


# Maps of the environment


def write_map(path: Path) -> np.ndarray:
    """A map with a different radiance in every direction, smooth enough to compare."""
    row, column = np.mgrid[:32, :64] / 32
    values = np.stack([1 + np.cos(np.pi * column), 1 + np.sin(np.pi * column), 1.5 + np.cos(np.pi * row)], axis=-1)
    path.write_bytes(encode_float_exr({name: values[..., c].astype(np.float32) for c, name in enumerate("RGB")}))
    return values


@pytest.mark.parametrize(
    "turn",
    [
        "",
        '<rotate y="1" angle="70"/>',
        '<rotate x="1" angle="90"/>',
        '<rotate x="1" angle="90"/><rotate z="1" angle="-40"/>',
    ],
)
def test_a_map_of_the_environment_shines_from_where_mitsuba_has_it(tmp_path: Path, turn: str) -> None:
    write_map(tmp_path / "sky.exr")
    envmap = (
        '<emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="2"/>'
        f'<transform name="to_world">{turn}</transform></emitter>'
    )
    up = "z" if 'x="1"' in turn else "y"
    imported = import_scene(xml_of(tmp_path, CUBE + envmap), ImportChoices(up=up))
    sky = imported.scene.environment
    assert isinstance(sky, EnvironmentMap) and not any("tilted" in line for line in imported.told())
    world = mi.load_file(str(tmp_path / "a.xml"))
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    theirs = directions if up == "z" else directions @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(*(-theirs).T)
    found = np.array(world.environment().eval(si)).T
    radiance = read_map(imported.scene.baked[sky.path], where="sky")
    ours = sky.scale * radiance_of_map(radiance, directions, sky.rotation_deg)
    assert np.abs(ours - found).max() < 0.05 * ours.max()


def test_an_obj_of_several_materials_takes_the_bsdf_of_each_name(tmp_path: Path) -> None:
    triangle = "v {0} 0 0\nv {0} 1 0\nv {0} 0 1\nusemtl {1}\nf -3 -2 -1\n"
    names = ("wood", "clear", "brass", "unknown")
    obj = "".join(triangle.format(place, name) for place, name in enumerate(names))
    (tmp_path / "things.obj").write_text(f"mtllib lost.mtl\n{obj}")
    bsdfs = '<bsdf type="dielectric" name="clear"/><ref id="matt" name="wood"/><bsdf type="conductor" id="brass"/>'
    shape = f'<shape type="obj"><string name="filename" value="things.obj"/>{bsdfs}</shape>'
    remarks = Remarks()
    scene = read(tmp_path, f'<bsdf type="diffuse" id="matt"/>{shape}', remarks)
    materials = [item.material for item in scene.objects]
    assert all(isinstance(material, ForeignMaterial) for material in materials)
    kinds = [
        (material.transmission, material.metallic) for material in materials if isinstance(material, ForeignMaterial)
    ]
    assert kinds == [(0, 0), (1, 0), (0, 1), (1, 0)]  # A material without a BSDF of its own takes the first.
    assert not any("is not there" in line.what for line in remarks.lines)


def test_glass_whose_roughness_is_an_image_has_its_mean(tmp_path: Path) -> None:
    Image.fromarray(np.array([[51, 153]], np.uint8)).save(tmp_path / "alpha.png")
    image = '<texture type="bitmap" name="alpha"><string name="filename" value="alpha.png"/></texture>'
    remarks = Remarks()
    material = material_of(tmp_path, f'<bsdf type="roughdielectric">{image}</bsdf>', remarks)
    assert material.roughness == pytest.approx(math.sqrt(0.4))
    assert any("drawn with its mean, alpha 0.40" in line.what for line in remarks.lines)
