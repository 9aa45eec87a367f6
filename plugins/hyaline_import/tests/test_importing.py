"""Tests that a foreign file becomes a scene: its size, its ground and cameras, its folder, and what is said of it."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.commands import call
from support.foreign import CARD, add, glass_entry, refused, taken, use_of
from support.gltf import BOX, GltfBuilder, clear, glass_of
from support.meshes import corner_cosines, inside_out
from support.rigs import config

from datagen.data.dataset import open_dataset
from datagen.data.meshes import Mesh, face_areas, face_corners, signed_volume
from datagen.data.queries import check_closed, windings
from datagen.disk.records import load_sealed
from datagen.scene.description import Scene, SceneObject
from datagen.scene.finding import ImportChoices
from datagen.scene.folder import load_scene, scene_files
from datagen.scene.materials import Conductor, Dielectric, Diffuse, ImageTexture, Plastic
from datagen.scene.modelling import ball, lathe
from datagen.scene.rig import make_cameras
from datagen.scene.soundness import touching_share
from hyaline_import.importing import Imported, import_scene
from hyaline_import.staging import glowing
from hyaline_import.surfaces import mesh_of


def scene_with_glass() -> GltfBuilder:
    """A mirrored glass box beside a textured one, 30 cm large, y up."""
    builder = GltfBuilder()
    photo = use_of(builder, np.full((8, 8, 3), (200, 100, 50)))
    add(builder, "vase", BOX, {"name": "Glass", **glass_entry()}, scale=[-0.1, 0.2, 0.1])
    matt = {"pbrMetallicRoughness": clear(roughnessFactor=1.0, baseColorTexture=photo)}  # type: ignore[arg-type]
    uv = np.stack([BOX.vertices[:, 0] + 0.5, BOX.vertices[:, 1] + 0.5], axis=-1).astype(np.float32)
    return add(builder, "box", dataclasses.replace(BOX, uv=uv), matt, scale=[0.1] * 3, translation=[0.2, 0.03, 0])


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Imported:
    return import_scene(scene_with_glass().written(tmp_path_factory.mktemp("files")), ImportChoices())


def of_name(scene: Scene, name: str) -> SceneObject:
    return next(item for item in scene.objects if item.name == name)


def extent(item: SceneObject) -> np.ndarray:
    return np.ptp(item.mesh.vertices, axis=0)


def test_what_points_up_in_the_file_points_up_in_the_scene_and_is_on_the_ground(imported: Imported) -> None:
    scene = imported.scene
    assert [item.name for item in scene.objects] == ["vase", "box", "ground"]
    np.testing.assert_allclose(extent(of_name(scene, "vase")), [0.1, 0.04, 0.12], atol=1e-6)
    lowest = min(item.mesh.vertices[:, 2].min() for item in scene.objects[:2])
    assert lowest == pytest.approx(0, abs=1e-7)
    assert 3e-4 <= lowest - of_name(scene, "ground").mesh.vertices[:, 2].max() <= 1e-3
    middle = np.concatenate([item.mesh.vertices[:, :2] for item in scene.objects[:2]])
    np.testing.assert_allclose(middle.min(axis=0) + middle.max(axis=0), 0, atol=1e-6)


def test_glass_is_solid_and_of_the_volume_that_it_had_and_an_image_comes_along(imported: Imported) -> None:
    vase, photo = (of_name(imported.scene, name) for name in ("vase", "box"))
    assert vase.material == Dielectric(ior=1.5)
    check_closed(vase.mesh, where="vase")
    assert signed_volume(vase.mesh) == pytest.approx(0.1 * 0.2 * 0.1 * signed_volume(BOX), rel=1e-4)
    assert isinstance(photo.material, Diffuse) and isinstance(photo.material.color, ImageTexture)
    (tmp := Path("image.png")).write_bytes(imported.scene.baked[photo.material.color.path])
    with Image.open(tmp) as picture:
        # (200, 100, 50), and the light that a surface of roughness 1 mirrors: 0.028.
        np.testing.assert_allclose(np.asarray(picture.convert("RGB"))[64, 64], [200, 109, 68], atol=2)


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
    builder = add(scene_with_glass(), "wall", scale=[2, 3, 0.01], translation=[0, 0, -0.15])
    scene = import_scene(builder.written(tmp_path), ImportChoices()).scene
    # The file's +z, where its viewer is, is our -y.
    front = of_name(scene, "wall").mesh.vertices[:, 1].min()
    for cameras in make_cameras(scene.cameras, config(views=32)).values():
        assert (cameras.world_from_camera[:, 1, 3] < front).all()
    assert scene.cameras.azimuth_deg[1] - scene.cameras.azimuth_deg[0] > 120


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
    path = add(GltfBuilder(), "box", scale=[0.1, 0.2, 0.1]).written(tmp_path)
    scene = import_scene(path, ImportChoices(scale=scale, up=up)).scene  # pyright: ignore
    np.testing.assert_allclose(extent(scene.objects[0]), expected, atol=1e-6)


def test_glass_that_is_inside_out_in_the_file_is_turned(tmp_path: Path) -> None:
    done = import_scene(glass_of(inside_out(BOX), name="bowl").written(tmp_path), ImportChoices())
    assert signed_volume(done.scene.objects[0].mesh) == pytest.approx(signed_volume(BOX), rel=1e-4)
    assert "bowl: its faces pointed inwards; flipped" in done.record["notes"]


def mesh_of_box() -> Mesh:
    """A unit cube with sharp edges."""
    box = trimesh.creation.box()
    return mesh_of(np.asarray(box.vertices), np.asarray(box.faces), None, None, where="cube")


# What touches


def test_glass_that_shares_a_face_with_its_stand_moves_that_face_alone(tmp_path: Path) -> None:
    # Its top is where the vase's bottom is: 0.2 * 0.3 below the origin.
    builder = add(scene_with_glass(), "stand", scale=[0.2, 0.1, 0.2], translation=[0, -0.09, 0])
    done = import_scene(builder.written(tmp_path), ImportChoices())
    assert any(line.where == "vase" and "which was moved 0.2 mm away from it" in line.what for line in done.remarks)
    np.testing.assert_allclose(extent(of_name(done.scene, "vase")), [0.1, 0.04, 0.12 - 2e-4], atol=5e-5)


def test_a_label_on_a_bottle_moves_off_it(tmp_path: Path) -> None:
    bottle = lathe([(0, 0), (0.03, 0), (0.03, 0.1), (0, 0.1)], segments=24)
    corners = face_corners(bottle)
    is_front = (np.ptp(corners[..., 2], axis=1) > 0.05) & (corners[..., 0].mean(axis=1) > 0)
    builder = glass_of(bottle, name="bottle")
    add(builder, "label", dataclasses.replace(bottle, faces=bottle.faces[is_front]))
    done = taken(builder.written(tmp_path), "--up z --scale 1")
    label, body = (face_corners(done[name].mesh) for name in ("label", "bottle"))
    assert (windings(body, label.mean(axis=1)) == 0).all()


# Drinks


def tumbler(segments: int = 48) -> Mesh:
    return lathe([(0, 0), (0.035, 0), (0.037, 0.1), (0.034, 0.1), (0.032, 0.008), (0, 0.008)], segments=segments)


def drink(segments: int = 48, low: float = 0.008, high: float = 0.07) -> Mesh:
    """It fills the tumbler from one height to another: its outside is the tumbler's inside."""
    radii = [0.032 + 0.002 * (z - 0.008) / (0.1 - 0.008) for z in (low, high)]
    return lathe([(0, low), (radii[0], low), (radii[1], high), (0, high)], segments=segments)


def glasses(*parts: tuple[str, Mesh, float], builder: GltfBuilder | None = None) -> GltfBuilder:
    builder = builder or GltfBuilder()
    for name, mesh, ior in parts:
        add(builder, name, mesh, glass_entry(ior))
    return builder


@pytest.mark.parametrize(("rings", "others"), [(48, 36), (8, 24)])
def test_a_drink_that_fills_its_glass_comes_in_and_grows_into_it(rings: int, others: int, tmp_path: Path) -> None:
    builder = glasses(("tumbler", tumbler(rings), 1.5), ("drink", drink(others), 1.33))
    done = taken(builder.written(tmp_path), "--up z --scale 1")
    assert re.search(r"drink: shares some of its surface with tumbler, which was moved 0\.[24] mm into it", done.err)
    vessel, water = (done[name].mesh for name in ("tumbler", "drink"))
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
    builder = add(GltfBuilder(), "table", mesh_of_box(), scale=[1, 1, 0.1], translation=[0, 0, -0.05])
    glasses(("tumbler", tumbler(), 1.5), ("drink", drink(), 1.33), builder=builder)
    done = taken(builder.written(tmp_path), "--up z --scale 1")
    vessel, water, table = (done[name].mesh for name in ("tumbler", "drink", "table"))
    assert not has_film(water, vessel)
    assert touching_share(vessel, table) == 0
    # Its bottom was lifted; nothing else of it moved.
    np.testing.assert_allclose(np.ptp(vessel.vertices, axis=0), [0.074, 0.074, 0.1 - 2e-4], atol=1e-6)


@pytest.mark.parametrize("is_same_material", [True, False])
def test_a_shell_that_faces_inwards_inside_a_body_of_its_material_is_its_cavity(
    is_same_material: bool, tmp_path: Path
) -> None:
    shell = ball(0.04)
    builder = add(GltfBuilder(), "bauble", ball(0.05), glass_entry())
    add(builder, "inside", inside_out(shell), glass_entry())
    if is_same_material:
        builder.content["meshes"][1]["primitives"][0]["material"] = 0
    done = taken(builder.written(tmp_path), "--scale 1")
    whole = signed_volume(ball(0.05))
    volume = whole - signed_volume(shell) if is_same_material else whole
    assert signed_volume(done["bauble"].mesh) == pytest.approx(volume, rel=1e-3)
    assert any(item.name == "inside" for item in done.scene.objects) is not is_same_material


@pytest.mark.parametrize(
    ("solids", "expected", "notes"),
    [
        # Names say nothing: ice wins over whiskey, listed before it or behind.
        ((("Whiskey", 0.1, 0.0), ("Cube", 0.04, 0.02)), (0, 1), ("Whiskey: overlaps Cube, which wins",)),
        ((("Water", 0.04, 0.04), ("Block", 0.1, 0.0)), (1, 0), ("Block: overlaps Water, which wins",)),
        (
            (("a", 0.1, 0.0), ("b", 0.06, 0.0), ("c", 0.02, 0.0)),
            (0, 1, 2),
            ("a: overlaps b, which wins", "a: overlaps c, which wins", "b: overlaps c, which wins"),
        ),
        ((("a", 0.04, 0.0), ("b", 0.1, 0.1)), (0, 0), ()),
    ],
)
def test_of_solids_that_overlap_the_inner_one_wins(
    solids: tuple, expected: tuple[int, ...], notes: tuple[str, ...], tmp_path: Path
) -> None:
    builder = GltfBuilder()
    for index, (name, size, height) in enumerate(solids):
        add(builder, name, BOX, glass_entry(1.3 + 0.1 * index), scale=[size] * 3, translation=[0, height, 0])
    done = taken(builder.written(tmp_path), "--scale 1")
    record = json.loads((tmp_path / "taken/import.json").read_text())
    told = [line for line in record["notes"] if "overlaps" in line]
    assert told == [f"{line}: it fills the space that they share" for line in notes]
    assert len(notes) == 0 or notes[0] in done.err
    found = [done[solid[0]].material for solid in solids]
    assert [glass.priority for glass in found if isinstance(glass, Dielectric)] == list(expected)


# Lamps


def room_with_glass(lamp: dict | None) -> GltfBuilder:
    """A closed room that faces inwards, with a glass ball in it, and a panel below its ceiling."""
    builder = add(GltfBuilder(), "room", inside_out(mesh_of_box()), scale=[3, 3, 2.5], translation=[0, 0, 1.25])
    add(builder, "ball", ball(0.2), glass_entry(), translation=[0, 0, 0.8])
    if lamp is not None:
        add(builder, "lamp", mesh_of_box(), lamp, scale=[0.6, 0.6, 0.02], translation=[0, 0, 2.4])
    return builder


GLOWS = {"emissiveFactor": [1, 1, 1], "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}}}
FEW = "--preset tiny --resolution 16 --views 2 --test-views 1 --spp 64 --test-spp 64 --up z --scale 1"


@pytest.mark.parametrize("lamp", [None, {"emissiveFactor": [0.1, 0.1, 0.1]}])
def test_a_build_of_a_room_without_light_says_so_before_it_renders(lamp: dict | None, tmp_path: Path) -> None:
    path = room_with_glass(lamp).written(tmp_path, "room.glb")
    answer = call(f"datagen build '{path}' {FEW} --out '{tmp_path}/data'")
    assert answer.status == 1
    assert "scene room: no light reaches the first training camera" in answer.error
    assert not list((tmp_path / "data").rglob("*.png"))


def test_a_panel_that_emits_light_lights_its_room(tmp_path: Path) -> None:
    path = room_with_glass(GLOWS).written(tmp_path, "room.glb")
    answer = call(f"datagen build '{path}' {FEW} --out '{tmp_path}/data'")
    assert answer.status == 0, answer.err
    assert "lamp: emits light; drawn as the sides of a box around it" in answer.err
    lights = load_scene(tmp_path / "data" / "scene").lights
    assert [np.cross(light.edge_u, light.edge_v)[2] for light in lights] == pytest.approx([-0.36, 0.36])
    assert open_dataset(tmp_path / "data").view("train", 0).image.mean() > 40


@pytest.mark.parametrize("shape", [ball(0.1), lathe([(0, -0.3), (0.02, -0.3), (0.02, 0.3), (0, 0.3)]), mesh_of_box()])
def test_a_lamp_of_any_shape_keeps_its_power(shape: Mesh) -> None:
    power = sum(
        np.linalg.norm(np.cross(light.edge_u, light.edge_v)) * np.array(light.radiance)
        for light in glowing(shape, (3.0, 2.0, 1.0))
    )
    assert power == pytest.approx(face_areas(shape).sum() * np.array([3.0, 2.0, 1.0]), rel=1e-5)


# The command


def test_more_objects_than_a_scene_has_are_merged_by_material(tmp_path: Path) -> None:
    builder = GltfBuilder()
    box = builder.mesh(material=builder.material("Tile", pbrMetallicRoughness=clear(roughnessFactor=1.0)))
    for index in range(300):
        builder.node(mesh=box, translation=[index % 20, 0, index // 20], scale=[0.1, 0.1, 0.1])
    done = import_scene(builder.written(tmp_path), ImportChoices(scale=0.01))
    assert any("its 300 objects became 1, one a material" in line for line in done.told())
    scene = done.scene
    assert [item.name for item in scene.objects] == ["Tile", "ground"]
    assert len(scene.objects[0].mesh.faces) == 300 * len(BOX.faces)


def test_the_command_writes_a_folder_that_holds_the_scene_and_a_line_for_each_approximation() -> None:
    builder = scene_with_glass()
    builder.content["materials"][0]["normalTexture"] = {"index": 0}
    builder.written(Path(), "my things.glb")
    answer = call("datagen import 'my things.glb'")
    assert (answer.status, answer.out) == (0, "scenes/my_things\n"), answer.err
    assert "Glass: has a normal map, which is left out" in answer.err
    assert answer.err.splitlines()[-1] == "next: datagen build scenes/my_things"
    root = Path("scenes/my_things")
    record = load_sealed(root / "import.json")
    assert record["approximations"] == ["Glass: has a normal map, which is left out"]
    assert (record["source"], record["scale"], record["up"]) == ("my things.glb", 1.0, "y")
    written = {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    # Read as any scene, nothing is left to mend, and it is the same to the last byte.
    assert {**scene_files(load_scene(root)), "import.json": written["import.json"]} == written
    again = call("datagen import 'my things.glb'")
    assert again.status == 1 and "holds an imported scene; remove it" in again.error


def test_materials_by_name_override_those_of_the_file_and_a_wrong_name_names_those_that_are_there(
    tmp_path: Path,
) -> None:
    path = scene_with_glass().written(tmp_path)
    done = taken(path, "--material gold --material 'v*=diamond'")
    assert done["vase"].material == Dielectric(ior=2.417)
    assert isinstance(done["box"].material, Conductor)
    assert "did you mean 'diamond'" in refused(path, "--material diamnd")
    expected = "error: --material: no object 'vose'; did you mean 'vase'? Choose from box, vase"
    assert refused(path, "--material vose=water") == expected


@pytest.mark.parametrize(("command", "name"), [("import", "vase.fbx"), ("build --scene", "vase.xyz")])
def test_a_format_that_is_not_read_says_how_to_export(command: str, name: str) -> None:
    Path(name).write_bytes(b"something")
    answer = call(f"datagen {command} {name}")
    assert answer.status == 1 and ".glb" in answer.error and "open it in Blender" in answer.error


def test_crease_shades_smooth_normals_over_edges_as_edges(tmp_path: Path) -> None:
    smooth = lathe([(0, 0), (0.04, 0), (0.04, 0.09), (0, 0.09)], segments=48, crease_deg=180)
    path = glass_of(smooth, name="tumbler").written(tmp_path)
    tumbler = taken(path, "--crease 30")["tumbler"].mesh
    assert np.degrees(np.arccos(corner_cosines(tumbler).min())) < 5
    assert refused(path, "--crease 181").startswith("error: --crease: is 181; expected")


# Materials


def test_the_specular_glossiness_model_is_grey_and_told(tmp_path: Path) -> None:
    builder = add(GltfBuilder(), "ball", BOX, {"extensions": {"KHR_materials_pbrSpecularGlossiness": {}}})
    done = taken(builder.written(tmp_path))
    assert done["ball"].material == Diffuse(color=(0.8, 0.8, 0.8))
    assert "is of the withdrawn specular-glossiness model; drawn grey and matt" in done.err


def halves(left: tuple[int, int, int], right: tuple[int, int, int]) -> np.ndarray:
    """An image whose halves along u have these colours."""
    return np.tile(np.repeat(np.array([left, right]), 4, axis=0)[None], (8, 1, 1))


def test_an_image_that_makes_a_part_of_a_surface_metal_is_averaged_and_told(tmp_path: Path) -> None:
    builder = GltfBuilder()
    use = use_of(builder, halves((0, 51, 0), (0, 255, 255)))
    for name, (low, high), texture in (
        ("most", (0.25, 1.0), use),
        ("some", (0.0, 0.55), use),
        # Its own lies otherwise than the colour's, in whose uv the mesh is: all of it counts.
        ("apart", (0.0, 0.1), {**use, "extensions": {"KHR_texture_transform": {"scale": [0.5, 1.0]}}}),
    ):
        pbr = {"metallicRoughnessTexture": texture, "baseColorTexture": use}
        uv = (CARD.uv * (high - low, 1) + (low, 0)).astype(np.float32)
        add(builder, name, dataclasses.replace(CARD, uv=uv), {"pbrMetallicRoughness": pbr})
    found = import_scene(builder.written(tmp_path), ImportChoices())
    kinds = {item.name: type(item.material) for item in found.scene.objects}
    assert kinds == {"most": Conductor, "some": Plastic, "apart": Conductor, "ground": Diffuse}
    told = {line.where: line.what for line in found.remarks if "has images of its factors" in line.what}
    assert told["apart"].endswith("drawn with their means: metallic 0.50 and roughness 0.60")
    assert set(told) == {"most", "some", "apart"}
