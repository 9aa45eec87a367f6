"""Tests that a foreign file becomes a scene: its size, its ground and cameras, its folder, and what is said of it."""

import dataclasses
import io
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.commands import call
from support.gltf import BOX, GltfBuilder, clear, glass, glass_of
from support.rigs import config

from datagen.data.config import square
from datagen.data.dataset import open_dataset
from datagen.data.meshes import Mesh, check_closed, face_areas, face_corners, signed_volume, windings
from datagen.disk.errors import HyalineError
from datagen.disk.storage import load_sealed
from datagen.render.mitsuba_scene import radiance_of_environment
from datagen.scene.contact import touching_share
from datagen.scene.description import Scene, SceneObject
from datagen.scene.folder import load_scene, scene_files
from datagen.scene.import_choices import ImportChoices
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Plastic, RoughDielectric, ThinDielectric
from datagen.scene.modelling import ball, lathe, sheet
from datagen.scene.rig import make_cameras
from datagen.scene.shading_normals import edge_tilt_deg
from datagen.scene.staging import LIGHT
from datagen.scene.surfaces import mesh_of
from datagen.scene.textures import ImageTexture, SolidTexture
from hyaline_import.importing import Imported, import_scene
from hyaline_import.lights import glowing


def scene_with_glass() -> GltfBuilder:
    """A mirrored glass box beside a textured one, 30 cm large, y up."""
    picture = io.BytesIO()
    Image.new("RGB", (8, 8), (200, 100, 50)).save(picture, format="JPEG")
    builder = GltfBuilder()
    image = builder.add("images", {"bufferView": builder.view(picture.getvalue()), "mimeType": "image/jpeg"})
    use = {"index": builder.add("textures", {"source": image})}
    clear_glass = builder.material("Glass", pbrMetallicRoughness=clear(), extensions=glass())
    photo = builder.material("Photo", pbrMetallicRoughness=clear(roughnessFactor=1.0, baseColorTexture=use))
    uv = np.stack([BOX.vertices[:, 0] + 0.5, BOX.vertices[:, 1] + 0.5], axis=-1).astype(np.float32)
    textured = dataclasses.replace(BOX, uv=uv)
    builder.node(mesh=builder.mesh(material=clear_glass), name="vase", scale=[-0.1, 0.2, 0.1])
    builder.node(
        mesh=builder.mesh(textured, material=photo, has_uv=True),
        name="box",
        scale=[0.1, 0.1, 0.1],
        translation=[0.2, 0.03, 0],
    )
    return builder


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Imported:
    return import_scene(scene_with_glass().written(tmp_path_factory.mktemp("files")), ImportChoices())


def of_name(scene: Scene, name: str) -> SceneObject:
    return next(item for item in scene.objects if item.name == name)


def extent(item: SceneObject) -> np.ndarray:
    return np.ptp(item.mesh.vertices, axis=0)


def test_what_points_up_in_the_file_points_up_in_the_scene_and_stands_on_the_ground(imported: Imported) -> None:
    scene = imported.scene
    assert [item.name for item in scene.objects] == ["vase", "box", "ground"]
    np.testing.assert_allclose(extent(of_name(scene, "vase")), [0.1, 0.04, 0.12], atol=1e-6)
    lowest = min(item.mesh.vertices[:, 2].min() for item in scene.objects[:2])
    assert lowest == pytest.approx(0, abs=1e-7)
    gap = lowest - of_name(scene, "ground").mesh.vertices[:, 2].max()
    assert 3e-4 <= gap <= 1e-3
    middle = np.concatenate([item.mesh.vertices[:, :2] for item in scene.objects[:2]])
    np.testing.assert_allclose(middle.min(axis=0) + middle.max(axis=0), 0, atol=1e-6)


def test_glass_is_solid_closed_and_of_the_volume_that_it_had(imported: Imported) -> None:
    vase = of_name(imported.scene, "vase")
    assert vase.material == Dielectric(ior=1.5)
    check_closed(vase.mesh, where="vase")
    assert signed_volume(vase.mesh) == pytest.approx(0.1 * 0.2 * 0.1 * signed_volume(BOX), rel=1e-4)


def test_an_image_comes_along_as_a_png(imported: Imported) -> None:
    material = of_name(imported.scene, "box").material
    assert isinstance(material, Diffuse) and isinstance(material.color, ImageTexture)
    with Image.open(io.BytesIO(imported.scene.baked[material.color.path])) as picture:
        assert picture.format == "PNG"
        # (200, 100, 50), and the light that a surface of roughness 1 mirrors: 0.019.
        np.testing.assert_allclose(np.asarray(picture.convert("RGB"))[64, 64], [200, 104, 62], atol=2)


@pytest.mark.parametrize("resolution", [32, 128])
def test_a_period_of_the_grounds_pattern_is_four_texels(imported: Imported, resolution: int) -> None:
    from datagen.scene.remarks import Remarks
    from datagen.scene.staging import make_ground

    ground = make_ground(imported.scene.objects[:2], resolution=square(resolution), remarks=Remarks())
    assert isinstance(ground.material, Diffuse) and isinstance(ground.material.color, SolidTexture)
    # An object's texture is half as wide as the picture.
    assert extent(ground)[0] / ground.material.color.scale == pytest.approx(resolution / 2 / 4, rel=1e-5)


def test_cameras_of_all_splits_are_above_the_ground_and_see_the_glass_whole(imported: Imported) -> None:
    vase = of_name(imported.scene, "vase").mesh.vertices
    for split, cameras in make_cameras(imported.scene.cameras, config(views=32)).items():
        for view in range(len(cameras)):
            camera = cameras[view]
            position = camera.world_from_camera[:3, 3]
            assert position[2] > 0
            p_camera = (vase - position) @ camera.world_from_camera[:3, :3]
            if split == "interpolating":
                shares = np.abs(p_camera[:, :2] / p_camera[:, 2:]) / np.tan(camera.fov_x / 2)
                assert shares.max() <= 1, "in the picture"
                assert shares.max() > 0.4, "and not far away"


def test_a_backdrop_keeps_the_cameras_on_its_front_side(tmp_path: Path) -> None:
    builder = scene_with_glass()
    wall = builder.material("Wall", pbrMetallicRoughness=clear(roughnessFactor=1.0))
    builder.node(mesh=builder.mesh(material=wall), scale=[2, 3, 0.01], translation=[0, 0, -0.15], name="wall")
    scene = import_scene(builder.written(tmp_path), ImportChoices()).scene
    # The file's +z, where its viewer stands, is our -y.
    front = of_name(scene, "wall").mesh.vertices[:, 1].min()
    for cameras in make_cameras(scene.cameras, config(views=32)).values():
        assert (cameras.world_from_camera[:, 1, 3] < front).all()
    assert scene.cameras.azimuth_deg[1] - scene.cameras.azimuth_deg[0] > 120


def test_a_panel_behind_a_wide_row_of_glass_is_a_backdrop_too(tmp_path: Path) -> None:
    builder = GltfBuilder()
    matt = builder.material("Panel", pbrMetallicRoughness=clear(roughnessFactor=1.0))
    clear_glass = builder.material("Glass", pbrMetallicRoughness=clear(), extensions=glass())
    for place in range(5):
        builder.node(
            mesh=builder.mesh(material=clear_glass),
            scale=[0.1] * 3,
            translation=[0.3 * place, 0.5, 0],
            name=f"b{place}",
        )
    builder.node(mesh=builder.mesh(material=matt), scale=[1.6, 1.2, 0.01], translation=[0.6, 0.5, -0.08], name="panel")
    scene = import_scene(builder.written(tmp_path), ImportChoices()).scene
    front = of_name(scene, "panel").mesh.vertices[:, 1].min()
    for cameras in make_cameras(scene.cameras, config(views=32)).values():
        assert (cameras.world_from_camera[:, 1, 3] < front).all()


@pytest.mark.parametrize(
    ("scale", "up", "expected"),
    [
        (None, "auto", [0.1, 0.04, 0.12]),
        (2.0, "auto", [0.2, 0.08, 0.24]),
        (None, "z", [0.1, 0.12, 0.04]),
        (None, "x", [0.12, 0.04, 0.1]),
    ],
)
def test_scale_and_up_are_as_one_says(scale: float | None, up: str, expected: list[float], tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(), scale=[0.1, 0.2, 0.1])
    scene = import_scene(builder.written(tmp_path), ImportChoices(scale=scale, up=up)).scene  # pyright: ignore
    np.testing.assert_allclose(extent(scene.objects[0]), expected, atol=1e-6)


@pytest.mark.parametrize(("factor", "size"), [(1.0, 1.0), (20.0, 0.2), (3000.0, 3.0), (40_000.0, 0.3), (0.001, 0.3)])
def test_a_scene_too_small_or_large_for_metres_gets_another_unit_and_says_so(
    factor: float, size: float, tmp_path: Path
) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(), scale=[factor] * 3)
    done = import_scene(builder.written(tmp_path), ImportChoices())
    assert extent(done.scene.objects[0])[0] == pytest.approx(size, rel=1e-4)
    assert any("--scale" in line.what for line in done.remarks) == (factor != 1)


def test_materials_by_name_override_those_of_the_file(tmp_path: Path) -> None:
    path = scene_with_glass().written(tmp_path)
    scene = import_scene(path, ImportChoices(material=("gold", "v*=diamond"))).scene
    assert of_name(scene, "vase").material == Dielectric(ior=2.417)
    assert isinstance(of_name(scene, "box").material, Conductor)
    with pytest.raises(HyalineError, match="did you mean 'diamond'"):
        import_scene(path, ImportChoices(material=("diamnd",)))


def test_glass_that_is_inside_out_in_the_file_is_turned(tmp_path: Path) -> None:
    inverted = dataclasses.replace(BOX, faces=np.ascontiguousarray(BOX.faces[:, ::-1]), normals=-BOX.normals)
    builder = glass_of(inverted, name="bowl")
    done = import_scene(builder.written(tmp_path), ImportChoices())
    assert signed_volume(done.scene.objects[0].mesh) == pytest.approx(signed_volume(BOX), rel=1e-4)
    assert "bowl: was inside out; its faces were turned round" in done.record["notes"]


def test_glass_that_shares_a_face_with_its_stand_moves_that_face_alone(tmp_path: Path) -> None:
    builder = scene_with_glass()
    matt = builder.material(pbrMetallicRoughness=clear(roughnessFactor=1.0))
    # Its top is where the vase's bottom is: 0.2 * 0.3 below the origin.
    builder.node(mesh=builder.mesh(material=matt), name="stand", scale=[0.2, 0.1, 0.2], translation=[0, -0.09, 0])
    done = import_scene(builder.written(tmp_path), ImportChoices())
    assert any(line.where == "vase" and "which was moved 0.2 mm away from it" in line.what for line in done.remarks)
    np.testing.assert_allclose(extent(of_name(done.scene, "vase")), [0.1, 0.04, 0.12 - 2e-4], atol=5e-5)


def tumbler(segments: int) -> Mesh:
    return lathe([(0, 0), (0.035, 0), (0.037, 0.1), (0.034, 0.1), (0.032, 0.008), (0, 0.008)], segments=segments)


def drink(segments: int) -> Mesh:
    """It fills the tumbler to two thirds: its outside is the tumbler's inside."""
    radius = 0.032 + 0.002 * (0.07 - 0.008) / (0.1 - 0.008)
    return lathe([(0, 0.008), (0.032, 0.008), (radius, 0.07), (0, 0.07)], segments=segments)


@pytest.mark.parametrize(("rings", "others"), [(48, 48), (48, 36), (24, 64), (8, 24)])
def test_a_drink_that_fills_its_glass_comes_in_and_grows_into_it(rings: int, others: int, tmp_path: Path) -> None:
    builder = GltfBuilder()
    for name, mesh, ior in (("tumbler", tumbler(rings), 1.5), ("drink", drink(others), 1.33)):
        extensions = {**glass(), "KHR_materials_ior": {"ior": ior}}
        material = builder.material(name, pbrMetallicRoughness=clear(), extensions=extensions)
        builder.node(mesh=builder.mesh(mesh, material=material), name=name)
    answer = call(f"datagen import '{builder.written(tmp_path, 'full.glb')}' --up z --scale 1 --out '{tmp_path}/out'")
    assert answer.status == 0, answer.err
    assert re.search(r"drink: shares some of its surface with tumbler, which was moved 0\.[24] mm into it", answer.err)
    scene = load_scene(tmp_path / "out")
    vessel, water = (of_name(scene, name).mesh for name in ("tumbler", "drink"))
    assert touching_share(water, vessel) < 0.005
    assert not has_film(water, vessel)
    assert signed_volume(water) > signed_volume(drink(others))


def has_film(water: Mesh, vessel: Mesh) -> bool:
    """True if there is air between a drink's side and its glass."""
    radius, height = np.meshgrid(np.linspace(0.02, 0.0335, 500), np.linspace(0.02, 0.06, 20))
    up = float(vessel.vertices[:, 2].min())
    points = np.stack([radius * np.cos(0.01), radius * np.sin(0.01), height + up], axis=-1).reshape(-1, 3)
    return bool((windings(face_corners(water), points) + windings(face_corners(vessel), points) == 0).any())


def test_a_full_glass_on_a_table_keeps_its_walls_and_has_no_film_of_air(tmp_path: Path) -> None:
    builder = GltfBuilder()
    top = builder.material("Wood", pbrMetallicRoughness=clear(roughnessFactor=1.0))
    builder.node(
        mesh=builder.mesh(mesh_of_box(), material=top), name="table", scale=[1, 1, 0.1], translation=[0, 0, -0.05]
    )
    for name, mesh, ior in (("tumbler", tumbler(48), 1.5), ("drink", drink(48), 1.33)):
        extensions = {**glass(), "KHR_materials_ior": {"ior": ior}}
        material = builder.material(name, pbrMetallicRoughness=clear(), extensions=extensions)
        builder.node(mesh=builder.mesh(mesh, material=material), name=name)
    scene = import_scene(builder.written(tmp_path), ImportChoices(up="z", scale=1.0)).scene
    vessel, water, table = (of_name(scene, name).mesh for name in ("tumbler", "drink", "table"))
    assert not has_film(water, vessel)
    assert touching_share(vessel, table) == 0
    # Its bottom was lifted; nothing else of it moved.
    np.testing.assert_allclose(np.ptp(vessel.vertices, axis=0), [0.074, 0.074, 0.1 - 2e-4], atol=1e-6)


def test_liquids_that_lie_on_each_other_in_a_glass_come_in(tmp_path: Path) -> None:
    builder = GltfBuilder()
    radius = [0.032 + 0.002 * (z - 0.008) / (0.1 - 0.008) for z in (0.04, 0.07)]
    syrup = lathe([(0, 0.008), (0.032, 0.008), (radius[0], 0.04), (0, 0.04)], segments=48)
    juice = lathe([(0, 0.04), (radius[0], 0.04), (radius[1], 0.07), (0, 0.07)], segments=48)
    for name, mesh, ior in (("tumbler", tumbler(48), 1.5), ("syrup", syrup, 1.4), ("juice", juice, 1.35)):
        extensions = {**glass(), "KHR_materials_ior": {"ior": ior}}
        material = builder.material(name, pbrMetallicRoughness=clear(), extensions=extensions)
        builder.node(mesh=builder.mesh(mesh, material=material), name=name)
    scene = import_scene(builder.written(tmp_path), ImportChoices(up="z", scale=1.0)).scene
    syrup, juice, vessel = (of_name(scene, name).mesh for name in ("syrup", "juice", "tumbler"))
    liquids = np.concatenate([face_corners(syrup), face_corners(juice)])
    height = np.linspace(0.01, 0.069, 200) + vessel.vertices[:, 2].min()
    for radius in (0.001, 0.03205):  # Through both of them, and where they touch the glass.
        points = np.stack([np.full(200, radius), np.full(200, 1e-4), height], axis=-1)
        assert (windings(liquids, points) + windings(face_corners(vessel), points) > 0).all()


def test_more_full_glasses_than_may_overlap_come_in_with_a_gap_around_their_drinks(tmp_path: Path) -> None:
    builder = GltfBuilder()
    materials = [
        builder.material(name, pbrMetallicRoughness=clear(), extensions={**glass(), "KHR_materials_ior": {"ior": ior}})
        for name, ior in (("Glass", 1.5), ("Water", 1.33))
    ]
    meshes = [
        builder.mesh(mesh, material=material)
        for mesh, material in zip((tumbler(12), drink(12)), materials, strict=True)
    ]
    for index, kind in itertools.product(range(17), range(2)):
        builder.node(mesh=meshes[kind], name=f"{('tumbler', 'drink')[kind]}{index}", translation=[0.1 * index, 0, 0])
    scene = import_scene(builder.written(tmp_path), ImportChoices(up="z", scale=1.0, ground="never")).scene
    assert len(scene.objects) == 34
    water, vessel = (of_name(scene, name).mesh for name in ("drink0", "tumbler0"))
    assert (windings(face_corners(vessel), water.vertices) == 0).all()


def test_a_label_on_a_bottle_moves_off_it(tmp_path: Path) -> None:
    bottle = lathe([(0, 0), (0.03, 0), (0.03, 0.1), (0, 0.1)], segments=24)
    corners = bottle.vertices[bottle.faces]
    is_front = (np.ptp(corners[..., 2], axis=1) > 0.05) & (corners[..., 0].mean(axis=1) > 0)
    builder = glass_of(bottle, name="bottle")
    paper = builder.material("Paper", pbrMetallicRoughness=clear(roughnessFactor=1.0))
    sheet_of_it = dataclasses.replace(bottle, faces=bottle.faces[is_front])
    builder.node(mesh=builder.mesh(sheet_of_it, material=paper), name="label")
    scene = import_scene(builder.written(tmp_path), ImportChoices(up="z", scale=1.0)).scene
    label, body = (face_corners(of_name(scene, name).mesh) for name in ("label", "bottle"))
    assert (windings(body, label.mean(axis=1)) == 0).all()


def test_a_plate_of_glass_on_four_legs_comes_in_and_the_legs_become_shorter(tmp_path: Path) -> None:
    builder = GltfBuilder()
    clear_glass = builder.material("Glass", pbrMetallicRoughness=clear(), extensions=glass())
    wood = builder.material(pbrMetallicRoughness=clear(roughnessFactor=1.0))
    cube = mesh_of_box()
    builder.node(mesh=builder.mesh(cube, material=clear_glass), name="plate", scale=[0.3, 0.3, 0.01])
    for index, (x, y) in enumerate(itertools.product((-0.1, 0.1), repeat=2)):
        leg = builder.mesh(cube, material=wood)
        builder.node(mesh=leg, name=f"leg{index}", scale=[0.02, 0.02, 0.2], translation=[x, y, -0.105])
    answer = call(f"datagen import '{builder.written(tmp_path, 'a.glb')}' --up z --scale 1 --out '{tmp_path}/out'")
    assert answer.status == 0, answer.err
    scene = load_scene(tmp_path / "out")
    for index in range(4):
        leg = of_name(scene, f"leg{index}").mesh
        np.testing.assert_allclose(np.ptp(leg.vertices, axis=0), [0.02, 0.02, 0.1998], atol=1e-6)


def mesh_of_box() -> Mesh:
    """A unit cube with sharp edges."""
    box = trimesh.creation.box()
    return mesh_of(np.asarray(box.vertices), np.asarray(box.faces), None, None, where="cube")


@pytest.mark.parametrize("is_same_material", [True, False])
def test_a_shell_that_faces_inwards_inside_a_body_of_its_material_is_its_cavity(
    is_same_material: bool, tmp_path: Path
) -> None:
    builder = GltfBuilder()
    outer = builder.material("Glass", pbrMetallicRoughness=clear(), extensions=glass())
    inner = outer if is_same_material else builder.material("Gas", pbrMetallicRoughness=clear(), extensions=glass())
    shell = ball(0.04)
    inwards = dataclasses.replace(shell, faces=np.ascontiguousarray(shell.faces[:, ::-1]), normals=-shell.normals)
    builder.node(mesh=builder.mesh(ball(0.05), material=outer), name="bauble")
    builder.node(mesh=builder.mesh(inwards, material=inner), name="inside")
    answer = call(f"datagen import '{builder.written(tmp_path, 'a.glb')}' --scale 1 --out '{tmp_path}/out'")
    assert answer.status == 0, answer.err
    scene = load_scene(tmp_path / "out")
    whole, hollow = signed_volume(ball(0.05)), signed_volume(ball(0.05)) - signed_volume(shell)
    volume = hollow if is_same_material else whole
    assert signed_volume(of_name(scene, "bauble").mesh) == pytest.approx(volume, rel=1e-3)
    assert any(item.name == "inside" for item in scene.objects) is not is_same_material


@pytest.mark.parametrize("has_image", [True, False])
def test_metal_of_the_specular_glossiness_model_has_its_specular_colour(has_image: bool, tmp_path: Path) -> None:
    builder = GltfBuilder()
    gloss: dict = {"diffuseFactor": [0, 0, 0, 1], "specularFactor": [0.8, 0.6, 0.4], "glossinessFactor": 0.9}
    if has_image:
        picture = io.BytesIO()
        Image.new("RGBA", (8, 8), (231, 203, 170, 255)).save(picture, format="PNG")  # 0.8, 0.6 and 0.4 in sRGB.
        image = builder.add("images", {"bufferView": builder.view(picture.getvalue()), "mimeType": "image/png"})
        gloss |= {"specularFactor": [1, 1, 1]}
        gloss["specularGlossinessTexture"] = {"index": builder.add("textures", {"source": image})}
    steel = builder.material("Steel", extensions={"KHR_materials_pbrSpecularGlossiness": gloss})
    builder.node(mesh=builder.mesh(BOX, material=steel, has_uv=True), name="ball", scale=[0.1] * 3)
    done = import_scene(builder.written(tmp_path), ImportChoices())
    metal = of_name(done.scene, "ball").material
    assert isinstance(metal, Conductor) and metal.color == pytest.approx((0.8, 0.6, 0.4), abs=0.01)


def room_with_glass(lamp: dict | None) -> GltfBuilder:
    """A closed room that faces inwards, with a glass ball in it, and a panel below its ceiling."""
    builder, walls = GltfBuilder(), mesh_of_box()
    inwards = dataclasses.replace(walls, faces=np.ascontiguousarray(walls.faces[:, ::-1]), normals=-walls.normals)
    wall = builder.material("Wall", pbrMetallicRoughness=clear(roughnessFactor=1.0))
    clear_glass = builder.material("Glass", pbrMetallicRoughness=clear(), extensions=glass())
    builder.node(mesh=builder.mesh(inwards, material=wall), name="room", scale=[3, 3, 2.5], translation=[0, 0, 1.25])
    builder.node(mesh=builder.mesh(ball(0.2), material=clear_glass), name="ball", translation=[0, 0, 0.8])
    if lamp is not None:
        panel = builder.mesh(walls, material=builder.material("Lamp", **lamp))
        builder.node(mesh=panel, name="lamp", scale=[0.6, 0.6, 0.02], translation=[0, 0, 2.4])
    return builder


GLOWS = {"emissiveFactor": [1, 1, 1], "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}}}
FEW = "--preset tiny --resolution 16 --views 2 --test-views 1 --spp 64 --test-spp 64 --up z --scale 1"


@pytest.mark.parametrize("lamp", [None, {"emissiveFactor": [0.1, 0.1, 0.1]}])
def test_a_build_of_a_room_without_light_says_so_before_it_renders(lamp: dict | None, tmp_path: Path) -> None:
    path = room_with_glass(lamp).written(tmp_path, "room.glb")
    answer = call(f"datagen build '{path}' {FEW} --out '{tmp_path}/data'")
    assert answer.status == 1
    assert "scene room: no light reaches the train cameras, which are inside closed opaque walls" in answer.error
    assert not list((tmp_path / "data").rglob("*.png"))


def test_a_panel_that_emits_light_lights_its_room(tmp_path: Path) -> None:
    path = room_with_glass(GLOWS).written(tmp_path, "room.glb")
    answer = call(f"datagen build '{path}' {FEW} --out '{tmp_path}/data'")
    assert answer.status == 0, answer.err
    assert "lamp: emits light; drawn as the sides of a box around it" in answer.err
    dataset = open_dataset(tmp_path / "data")
    lights = load_scene(tmp_path / "data" / "scene").lights
    assert [np.cross(light.edge_u, light.edge_v)[2] for light in lights] == pytest.approx([-0.36, 0.36])
    assert dataset.view("train", 0).image.mean() > 40


@pytest.mark.parametrize("shape", [ball(0.1), lathe([(0, -0.3), (0.02, -0.3), (0.02, 0.3), (0, 0.3)]), mesh_of_box()])
def test_a_lamp_of_any_shape_keeps_its_power(shape: Mesh) -> None:
    power = sum(
        np.linalg.norm(np.cross(light.edge_u, light.edge_v)) * np.array(light.radiance)
        for light in glowing(shape, (3.0, 2.0, 1.0))
    )
    assert power == pytest.approx(face_areas(shape).sum() * np.array([3.0, 2.0, 1.0]), rel=1e-5)


def test_an_open_lamp_shines_to_where_its_faces_look() -> None:
    (light,) = glowing(sheet((0, 0, 0), (0.4, 0, 0), (0, 0.2, 0)), (1.0, 1.0, 1.0))
    assert np.cross(light.edge_u, light.edge_v) == pytest.approx([0, 0, 0.08], abs=1e-6)


def test_more_objects_than_a_scene_has_are_merged_when_asked(tmp_path: Path) -> None:
    builder = GltfBuilder()
    matt = builder.material("Tile", pbrMetallicRoughness=clear(roughnessFactor=1.0))
    box = builder.mesh(material=matt)
    for index in range(300):
        builder.node(mesh=box, translation=[index % 20, 0, index // 20], scale=[0.1, 0.1, 0.1])
    path = builder.written(tmp_path)
    with pytest.raises(HyalineError, match=r"has 300 objects.*pass --merge"):
        import_scene(path, ImportChoices(scale=0.01))
    scene = import_scene(path, ImportChoices(scale=0.01, merge=True)).scene
    assert [item.name for item in scene.objects] == ["Tile", "ground"]
    assert len(scene.objects[0].mesh.faces) == 300 * len(BOX.faces)


def test_the_command_writes_a_folder_that_holds_the_scene_and_a_line_for_each_approximation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    builder = scene_with_glass()
    builder.content["materials"][0]["normalTexture"] = {"index": 0}
    builder.written(tmp_path, "my things.glb")
    answer = call("datagen import 'my things.glb'")
    assert (answer.status, answer.out) == (0, "scenes/my_things\n"), answer.err
    assert "Glass: has a normal map, which is left out" in answer.err
    assert answer.err.splitlines()[-1] == "next: datagen build scenes/my_things"
    root = tmp_path / "scenes" / "my_things"
    record = load_sealed(root / "import.json")
    assert record["approximations"] == ["Glass: has a normal map, which is left out"]
    assert (record["source"], record["scale"], record["up"]) == ("my things.glb", 1.0, "y")
    written = {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    # Read as any scene, nothing is left to mend, and it is the same to the last byte.
    assert {**scene_files(load_scene(root)), "import.json": written["import.json"]} == written
    again = call("datagen import 'my things.glb'")
    assert again.status == 1 and "pass --overwrite" in again.error
    assert call("datagen import 'my things.glb' --overwrite --ground never").status == 0
    assert not (root / "meshes" / "ground.ply").exists()
    strict = call("datagen import 'my things.glb' --strict --out other")
    assert strict.status == 1 and "leave out --strict" in strict.error
    assert not (tmp_path / "other").exists()


def leaf_png() -> bytes:
    """A brown picture of which a disk over a quarter of the side is opaque, in a corner."""
    y, x = np.mgrid[:64, :64]
    alpha = np.where(np.hypot(x - 15.5, y - 15.5) < 16, 255, 0).astype(np.uint8)
    data = io.BytesIO()
    Image.merge("RGBA", [Image.new("L", (64, 64), value) for value in (120, 80, 40)] + [Image.fromarray(alpha)]).save(
        data, format="PNG"
    )
    return data.getvalue()


CARD = sheet((0, 0, 0), (0.2, 0, 0), (0, 0.2, 0), cells=(2, 2))
DISK = np.pi * (0.2 * 16 / 64) ** 2


@pytest.mark.parametrize(
    ("entry", "area", "is_approximation"),
    [
        ({"alphaMode": "MASK"}, DISK, False),
        ({"alphaMode": "BLEND"}, DISK, False),
        ({"alphaMode": "OPAQUE"}, 0.04, None),
        ({"alphaMode": "MASK", "alphaCutoff": 0.0}, 0.04, None),
    ],
)
def test_a_surface_is_cut_as_its_alpha_mode_asks(
    entry: dict, area: float, is_approximation: bool | None, tmp_path: Path
) -> None:
    builder = scene_with_glass()
    image = builder.add("images", {"bufferView": builder.view(leaf_png()), "mimeType": "image/png"})
    use = {"index": builder.add("textures", {"source": image})}
    leaf = builder.material("Leaf", pbrMetallicRoughness=clear(roughnessFactor=1.0, baseColorTexture=use), **entry)
    uv = (CARD.vertices[:, :2] / 0.2).astype(np.float32)
    builder.node(mesh=builder.mesh(dataclasses.replace(CARD, uv=uv), material=leaf, has_uv=True), name="leaf")
    found = import_scene(builder.written(tmp_path), ImportChoices())
    mesh = next(item for item in found.scene.objects if item.name == "leaf").mesh
    assert face_areas(mesh).sum() == pytest.approx(area, rel=0.01)
    # glTF's first row is where its v is 0, far from +y; y points up there, and z here.
    if is_approximation is not None:
        assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(0.1, abs=0.002)
    told = [line.is_approximation for line in found.remarks if line.where == "leaf" and "is cut out" in line.what]
    assert told == ([] if is_approximation is None else [is_approximation])


def test_an_opacity_map_of_an_mtl_file_and_a_mask_of_mitsuba_cut_alike(tmp_path: Path) -> None:
    (tmp_path / "leaf.png").write_bytes(leaf_png())
    (tmp_path / "m.mtl").write_text("newmtl leaf\nKd 0.2 0.5 0.1\nmap_d leaf.png\n")
    corners = "v 0 0 0\nv 0.2 0 0\nv 0.2 0.2 0\nv 0 0.2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(f"mtllib m.mtl\n{corners}usemtl leaf\nf 1/1 2/2 3/3 4/4\n")
    mask = (
        '<bsdf type="mask"><texture type="bitmap" name="opacity"><string name="filename" value="leaf.png"/></texture>'
    )
    size = '<transform name="to_world"><scale value="0.1"/></transform>'
    shape = f'<shape type="rectangle" id="leaf">{size}{mask}<bsdf type="diffuse"/></bsdf></shape>'
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{shape}<emitter type="constant"/></scene>')
    for name in ("a.obj", "a.xml"):
        scene = import_scene(tmp_path / name, ImportChoices(ground="never")).scene
        assert face_areas(scene.objects[0].mesh).sum() == pytest.approx(DISK, rel=0.01), name


def test_the_light_of_files_without_any_has_highlights_and_dark_outlines_for_glass_on_every_side() -> None:
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 3)), np.radians(np.arange(0, 80, 3)))
    across = np.cos(elevation)
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], axis=-1)
    radiance = radiance_of_environment(LIGHT, directions).mean(axis=-1)
    usual = np.median(radiance)
    for start in range(0, 120, 10):
        third = radiance[:, (start + np.arange(40)) % 120]  # 120 degrees.
        assert third.max() > 4 * usual
        assert third.min() < 0.25 * usual
    # A perfectly white sheet that lies below it is about as bright as white on a screen.
    directions = np.random.default_rng(0).normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    light = radiance_of_environment(LIGHT, directions)
    sheet_radiance = 4 * (light.mean(axis=-1) * np.maximum(directions[:, 2], 0)).mean()
    assert 0.8 < sheet_radiance < 1.3


def image_use(builder: GltfBuilder, pixels: np.ndarray) -> dict:
    """A texture of these (h, w, 3) values."""
    data = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(data, format="PNG")
    image = builder.add("images", {"bufferView": builder.view(data.getvalue()), "mimeType": "image/png"})
    return {"index": builder.add("textures", {"source": image})}


def halves(left: tuple[int, int, int], right: tuple[int, int, int]) -> np.ndarray:
    """An image whose halves along u have these colours."""
    return np.tile(np.repeat(np.array([left, right]), 4, axis=0)[None], (8, 1, 1))


@pytest.mark.parametrize(
    ("pixels", "expected", "line"),
    [
        (halves((0, 0, 0), (0, 0, 0)), Dielectric(ior=1.5), "stuff: from its image: metalness 0.00 and roughness 0.00"),
        (
            halves((0, 153, 0), (255, 153, 255)),  # The mesh lies in the left half.
            RoughDielectric(ior=1.5, roughness=0.6**2),
            "stuff: from its image: metalness 0.00 and roughness 0.60",
        ),
    ],
)
def test_glass_with_an_image_of_metalness_is_the_glass_that_the_image_says(
    pixels: np.ndarray, expected: Dielectric, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    builder = GltfBuilder()
    # Exporters leave the factors out, which then are 1.
    pbr = {"metallicRoughnessTexture": image_use(builder, pixels)}
    material = builder.material(pbrMetallicRoughness=pbr, extensions=glass())
    uv = np.full((len(BOX.vertices), 2), (0.2, 0.5), np.float32)
    mesh = builder.mesh(dataclasses.replace(BOX, uv=uv), material=material, has_uv=True)
    builder.node(mesh=mesh, name="stuff", scale=[0.1] * 3)
    builder.written(tmp_path, "a.glb")
    answer = call("datagen import a.glb --strict")
    assert answer.status == 0 and line in answer.err, answer.err
    assert of_name(load_scene(tmp_path / "scenes" / "a"), "stuff").material == expected


def test_an_image_that_makes_a_part_of_a_surface_metal_is_averaged_and_told(tmp_path: Path) -> None:
    builder = GltfBuilder()
    use = image_use(builder, halves((0, 51, 0), (0, 255, 255)))
    for name, extent, texture in (
        ("most", (0.25, 1.0), use),
        ("some", (0.0, 0.55), use),
        # Its own lies otherwise than the colour's, in whose uv the mesh is: all of it counts.
        ("apart", (0.0, 0.1), {**use, "extensions": {"KHR_texture_transform": {"scale": [0.5, 1.0]}}}),
    ):
        pbr = {"metallicRoughnessTexture": texture, "baseColorTexture": use}
        material = builder.material(name, pbrMetallicRoughness=pbr)
        uv = (CARD.vertices[:, :2] / 0.2 * (extent[1] - extent[0], 1) + (extent[0], 0)).astype(np.float32)
        mesh = builder.mesh(dataclasses.replace(CARD, uv=uv), material=material, has_uv=True)
        builder.node(mesh=mesh, name=name)
    found = import_scene(builder.written(tmp_path), ImportChoices())
    kinds = {item.name: type(item.material) for item in found.scene.objects}
    assert kinds == {"most": Conductor, "some": Plastic, "apart": Conductor, "ground": Diffuse}
    told = {line.where: line.what for line in found.remarks if "varies" in line.what and line.is_approximation}
    assert told["apart"].endswith("drawn with the mean: metalness 0.50 and roughness 0.60")
    assert set(told) == {"most", "some", "apart"}


def test_an_image_of_transmission_and_one_of_glossiness_count_too(tmp_path: Path) -> None:
    builder = GltfBuilder()
    black, half = (image_use(builder, np.full((4, 4, 4), (0, 0, 0, value))) for value in (255, 128))
    opaque = {"KHR_materials_transmission": {"transmissionFactor": 1.0, "transmissionTexture": black}}
    frame = builder.material("frame", pbrMetallicRoughness=clear(roughnessFactor=1.0), extensions=opaque)
    shiny = {
        "KHR_materials_pbrSpecularGlossiness": {"specularGlossinessTexture": half, "diffuseFactor": [0.5, 0.5, 0.5, 1]}
    }
    glossy = builder.material("glossy", extensions=shiny)
    for place, material in enumerate((frame, glossy)):
        builder.node(mesh=builder.mesh(material=material), name=f"box{place}", translation=[place * 2, 0, 0])
    scene = import_scene(builder.written(tmp_path), ImportChoices(scale=0.1)).scene
    assert isinstance(of_name(scene, "box0").material, Diffuse)
    material = of_name(scene, "box1").material
    assert isinstance(material, Plastic) and material.roughness == 0.25


def test_metal_without_its_image_is_no_metal_unless_a_factor_says_so(tmp_path: Path) -> None:
    builder = GltfBuilder()
    use = {"index": builder.add("textures", {"extensions": {"KHR_texture_basisu": {"source": 0}}})}
    for factor in ({}, {"metallicFactor": 1.0}):
        pbr = {"metallicRoughnessTexture": use, "roughnessFactor": 0.2, **factor}
        builder.node(mesh=builder.mesh(material=builder.material(pbrMetallicRoughness=pbr)), scale=[0.1] * 3)
    scene = import_scene(builder.written(tmp_path), ImportChoices(ground="never")).scene
    assert [type(item.material) for item in scene.objects] == [Plastic, Conductor]


def test_a_table_of_blended_metal_is_seen_through_and_a_file_without_glass_says_how_to_get_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, mode in (("blended", "BLEND"), ("opaque", "OPAQUE")):
        builder = GltfBuilder()
        pbr = {"baseColorFactor": [0, 0, 0, 0.25]}
        material = builder.material(pbrMetallicRoughness=pbr, alphaMode=mode)
        builder.node(mesh=builder.mesh(material=material), name="top", scale=[0.1] * 3)
        builder.written(tmp_path, f"{name}.glb")
    answer = call("datagen import blended.glb")
    assert answer.status == 0 and "1 of them glass" in answer.err
    assert of_name(load_scene(tmp_path / "scenes/blended"), "top").material == ThinDielectric(
        ior=1.0, tint=(0.75, 0.75, 0.75)
    )
    answer = call("datagen import opaque.glb")
    line = "scene opaque: 2 objects, none of them glass; mark it with --material glass, or --material 'OBJECT=glass'"
    assert answer.status == 0 and line in answer.err


@pytest.mark.parametrize(
    ("lines", "expected", "told"),
    [
        # As Blender 4.5 writes Principled BSDFs with its PBR extensions: Tf is the weight of transmission.
        ("Kd 1 1 1\nNi 1.45\nd 1\nillum 2\nPr 0\nPm 0\nTf 1 1 1", Dielectric(ior=1.45), ""),
        ("Kd 1 1 1\nNi 1.5\nd 1\nillum 2\nPr 0.2\nPm 0\nTf 1 1 1", RoughDielectric(ior=1.5, roughness=0.2**2), ""),
        ("Kd 1 1 1\nNi 1.5\nd 1\nillum 2\nPr 1\nPm 0", Diffuse(color=(1, 1, 1)), "none of them glass"),
        # As 3ds Max writes what is opaque.
        (
            "Kd 0.8 0.8 0.8\nNs 0\nNi 1.5\nd 1\nTr 0\nTf 1 1 1\nillum 2",
            Diffuse(color=(0.8, 0.8, 0.8)),
            "none of them glass",
        ),
        ("Kd 0.8 0.8 0.8\nNi 1.5\nd 1\nillum 4\nTf 1 1 1", Dielectric(ior=1.5), ""),
    ],
)
def test_an_obj_of_blenders_with_a_weight_of_transmission_is_glass(
    lines: str, expected: Dielectric | Diffuse, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.mtl").write_text(f"newmtl m\n{lines}\n")
    corners = "\n".join(f"v {' '.join(map(str, vertex))}" for vertex in 0.1 * BOX.vertices)
    faces = "\n".join(f"f {' '.join(map(str, face + 1))}" for face in BOX.faces)
    (tmp_path / "a.obj").write_text(f"mtllib m.mtl\n{corners}\no box\nusemtl m\n{faces}\n")
    answer = call("datagen import a.obj --strict")
    assert answer.status == 0 and told in answer.err, answer.err
    assert of_name(load_scene(tmp_path / "scenes/a"), "box").material == expected


def test_white_texels_that_no_base_below_a_coat_shows_are_drawn_matt_though_the_mean_could_be(tmp_path: Path) -> None:
    builder = GltfBuilder()
    for name, colors in (("checker", ((0, 0, 0), (255, 255, 255))), ("grey", ((188, 188, 188), (188, 188, 188)))):
        pbr = clear(roughnessFactor=0.5, baseColorTexture=image_use(builder, halves(*colors)))
        mesh = builder.mesh(CARD, material=builder.material(name, pbrMetallicRoughness=pbr), has_uv=True)
        builder.node(mesh=mesh, name=name)
    scene = import_scene(builder.written(tmp_path), ImportChoices(ground="never")).scene
    assert [type(item.material) for item in scene.objects] == [Diffuse, Plastic]


def solid_of(name: str, size: float, height: float, **more: object) -> tuple[str, float, float, dict]:
    return name, size, height, more


@pytest.mark.parametrize(
    ("solids", "expected", "notes"),
    [
        # Names say nothing: ice wins over whiskey, listed before it or behind.
        (
            (solid_of("Whiskey", 0.1, 0.0), solid_of("Cube", 0.04, 0.02)),
            (0, 1),
            ("Whiskey: overlaps Cube, which wins",),
        ),
        ((solid_of("Water", 0.04, 0.04), solid_of("Block", 0.1, 0.0)), (1, 0), ("Block: overlaps Water, which wins",)),
        (
            (solid_of("a", 0.1, 0.0), solid_of("b", 0.06, 0.0), solid_of("c", 0.02, 0.0)),
            (0, 1, 2),
            ("a: overlaps b, which wins", "a: overlaps c, which wins", "b: overlaps c, which wins"),
        ),
        ((solid_of("a", 0.04, 0.0), solid_of("b", 0.1, 0.1)), (0, 0), ()),
        (
            (solid_of("a", 0.1, 0.0, priority=3), solid_of("b", 0.04, 0.0)),
            (3, 0),
            ("b: overlaps a, which wins",),
        ),
    ],
)
def test_of_solids_that_overlap_the_inner_one_wins_unless_the_file_gives_priorities(
    solids: tuple, expected: tuple[int, ...], notes: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    builder = GltfBuilder()
    for index, (name, size, height, extras) in enumerate(solids):
        extensions = {**glass(), "KHR_materials_ior": {"ior": 1.3 + 0.1 * index}}
        material = builder.material(name, pbrMetallicRoughness=clear(), extensions=extensions, extras=extras)
        builder.node(mesh=builder.mesh(material=material), name=name, scale=[size] * 3, translation=[0, height, 0])
    builder.written(tmp_path, "a.glb")
    answer = call("datagen import a.glb --scale 1 --strict")
    assert answer.status == 0, answer.err
    record = json.loads((tmp_path / "scenes/a/import.json").read_text())
    told = [line for line in record["notes"] if "overlaps" in line]
    assert told == [f"{line}: it fills the space that they share" for line in notes]
    assert len(notes) == 0 or notes[0] in answer.err
    scene = load_scene(tmp_path / "scenes/a")
    found = [of_name(scene, solid[0]).material for solid in solids]
    assert [glass.priority for glass in found if isinstance(glass, Dielectric)] == list(expected)


def test_a_material_for_an_object_that_is_not_there_names_those_that_are(tmp_path: Path) -> None:
    path, out = scene_with_glass().written(tmp_path), tmp_path / "out"
    answer = call(f"datagen import {path} --out {out} --material vose=water")
    assert answer.status == 1 and not out.exists()
    assert answer.error == (
        "error: --material: no object is called 'vose'; did you mean 'vase'? the objects are vase, box"
    )
    answer = call(f"datagen import {path} --out {out} --material nothing=water")
    assert answer.error == "error: --material: no object is called 'nothing'; the objects are vase, box"


@pytest.mark.parametrize("command", ["import", "build --scene"])
@pytest.mark.parametrize("name", ["vase.fbx", "vase.blend", "vase.FBX", "vase.xyz"])
def test_a_format_that_is_not_read_says_how_to_export(command: str, name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"something")
    answer = call(f"datagen {command} {tmp_path / name}")
    assert answer.status == 1 and len(answer.err.strip().splitlines()) == 1
    assert ".glb" in answer.error and "open it in Blender" in answer.error and "glTF 2.0" in answer.error


def smooth_cylinder() -> Mesh:
    """A cylinder whose rims are shaded as if they were round."""
    return lathe([(0, 0), (0.04, 0), (0.04, 0.09), (0, 0.09)], segments=48, crease_deg=180)


def test_smooth_normals_over_edges_are_told_and_crease_shades_them_as_edges(tmp_path: Path) -> None:
    builder = glass_of(smooth_cylinder(), name="tumbler")
    path, out = builder.written(tmp_path), tmp_path / "out"
    answer = call(f"datagen import {path} --out {out}")
    (line,) = [line for line in answer.err.splitlines() if line.startswith("tumbler: ")]
    assert "its normals lie up to 67 degrees off its faces" in line and "--crease 30" in line
    assert edge_tilt_deg(of_name(load_scene(out), "tumbler").mesh) > 40
    answer = call(f"datagen import {path} --out {out} --overwrite --crease 30")
    assert answer.status == 0 and "tumbler: " not in answer.err
    tumbler = of_name(load_scene(out), "tumbler").mesh
    corners = face_corners(tumbler).astype(np.float64)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    cosine = np.einsum("fc,fkc->fk", flat, tumbler.normals[tumbler.faces])
    assert np.degrees(np.arccos(cosine.min())) < 5
    assert call(f"datagen import {path} --out {out} --crease 181").error.startswith("error: --crease: is 181; expected")


@pytest.mark.parametrize("mesh", [BOX, ball(0.05, subdivisions=1)], ids=["bevelled box", "coarse ball"])
def test_normals_of_round_surfaces_and_bevels_are_no_matter(mesh: Mesh, tmp_path: Path) -> None:
    builder = glass_of(mesh, name="thing")
    assert "--crease" not in call(f"datagen import {builder.written(tmp_path)} --out {tmp_path / 'out'}").err


def test_build_takes_what_import_takes(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.node(mesh=builder.mesh(dataclasses.replace(BOX, faces=np.delete(BOX.faces, 3, axis=0))), name="vase")
    builder.node(mesh=builder.mesh(), translation=[2, 0, 0], name="foot")
    path, out = builder.written(tmp_path), tmp_path / "data"
    tiny = "--resolution 16 --views 1 --test-views 1 --spp 2 --test-spp 2"
    words = "--material glass --material foot=gold --repair --crease 30 --scale 0.1 --ground never"
    assert call(f"datagen build --scene {path} --out {out} {tiny} {words}").status == 0
    found = load_scene(out / "scene", is_checked=True)
    assert [type(item.material) for item in found.objects] == [Dielectric, Conductor]
    assert found.objects[0].mesh.vertices[:, 2].max() == pytest.approx(0.06, abs=1e-6)
    assert call(f"datagen import {path} --out {tmp_path / 'same'} --resolution 16 {words}").status == 0
    assert scene_files(load_scene(tmp_path / "same")) == scene_files(found)
    again = call(f"datagen build --scene {path} --out {out} {tiny} {words}")
    assert again.status == 0, "the same command finds the dataset as it left it"
    other = call(f"datagen build --scene {path} --out {out} {tiny} --material water --repair")
    assert other.status == 1 and "--overwrite" in other.error


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("--scene glass_table --material gold", "--material: goes with a file that is imported, such as vase.glb"),
        ("--scene {folder} --repair", "--repair: goes with a file that is imported"),
    ],
)
def test_flags_of_an_import_without_one_are_refused(line: str, told: str, tmp_path: Path) -> None:
    path = scene_with_glass().written(tmp_path)
    call(f"datagen import {path} --out {tmp_path / 'scene'}")
    answer = call(f"datagen build --out {tmp_path / 'data'} " + line.format(folder=tmp_path / "scene"))
    assert answer.status == 1 and told in answer.error
