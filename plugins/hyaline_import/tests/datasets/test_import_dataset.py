"""Tests that other projects' datasets are taken over whole, and that what nobody knows of them is called unknown."""

import dataclasses
import json
import math
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms
from support.commands import call
from support.meshes import polygon_ply
from support.theirs import write_refref
from support.traced_dataset import write_traced_dataset

from datagen.builder.build import peel_dataset, summary
from datagen.builder.verify import verify_dataset
from datagen.data.config import SPLITS, TEST_SPLITS
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.meshes import signed_volume
from datagen.data.paths import TRUTH
from datagen.data.ply import read_ply, write_ply
from datagen.disk.errors import HyalineError
from datagen.look.look import look_page
from datagen.quantities import quantities, surfaces_of
from datagen.scene.description import CameraList
from datagen.scene.folder import load_scene
from datagen.scene.materials import ThinDielectric
from datagen.scene.rig import make_cameras
from hyaline_export.formats import export_dataset
from hyaline_import.commands import DatasetImportChoices
from hyaline_import.datasets.import_dataset import plan_import, write_import
from hyaline_import.datasets.layouts import on_background, opened

SIDE = 8


def take_over(folder: Path, root: Path, **choices: object) -> Dataset:
    chosen = DatasetImportChoices(**choices)  # type: ignore[arg-type]
    return write_import(plan_import(folder, chosen), root, overwrite=False)


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("ours") / "glasses"
    write_traced_dataset(root, resolution=32)
    return open_dataset(root)


@pytest.fixture(scope="module")
def refref(ours: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("exported") / "refref"
    write_refref(ours, root)
    return root


def meshes_of(root: Path) -> tuple[Path, ...]:
    return tuple(sorted((root / "meshes").iterdir()))


@pytest.fixture(scope="module")
def again(refref: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    dataset = take_over(refref, tmp_path_factory.mktemp("again") / "glasses", mesh=meshes_of(refref))
    peel_dataset(dataset, TRUTH, num_layers=8, overwrite=False)
    return open_dataset(dataset.root)


def test_a_refref_scene_comes_back_with_its_cameras_pictures_and_masks(ours: Dataset, again: Dataset) -> None:
    assert again.num_views == ours.num_views
    for split in SPLITS:
        before, after = ours.cameras(split), again.cameras(split)
        assert np.abs(before.world_from_camera - after.world_from_camera).max() < 1e-6
        assert after.fov_x == pytest.approx(before.fov_x, rel=1e-6) and after.width == before.width
        for old, new in zip(ours.views(split), again.views(split), strict=True):
            assert np.array_equal(old.image, new.image)
            mask = new.imported_mask
            assert mask is not None and np.array_equal(mask, quantities(old).glass)
    names = {item.name for item in surfaces_of(ours).scene.objects if item.material.is_glass}
    found = {item.name: item.material.surface().ior for item in surfaces_of(again).scene.objects}
    assert found == dict.fromkeys(names, 1.5)


def test_what_only_a_renderer_knows_is_unknown(again: Dataset) -> None:
    view = again.view("train", 0)
    assert (view.record.noise_mse, view.record.spp, view.record.seed) == (None, None, None)
    assert again.noise_ceiling_db("interpolating") is None
    assert any(line.startswith("interpolating: noise ceiling unknown; ") for line in summary(again, TRUTH))
    with pytest.raises(HyalineError, match="radiance and noise are unknown; its pictures were imported"):
        _ = view.radiance
    page = look_page(again).decode()
    assert "<dt>interpolating</dt><dd>noise ceiling unknown" in page and "imported from" in page
    for line in (f"add {again.root} --twins", f"film {again.root}"):
        answer = call(f"datagen {line}")
        assert answer.status == 1 and "the light in its scene is unknown" in answer.error


def test_every_byte_is_verified_and_the_same_command_brings_back_what_is_lost(
    refref: Path, again: Dataset, tmp_path: Path
) -> None:
    root = shutil.copytree(again.root, tmp_path / "glasses")
    assert verify_dataset(root).problems == []
    (root / "images" / "train" / "0000.mask.png").write_bytes(b"spoilt")
    (root / "records" / "train" / "0001.json").unlink()
    (root / "scene" / "meshes" / "ball.ply").unlink()
    assert len(verify_dataset(root).problems) == 3
    before = (again.root / "images" / "train" / "0000.mask.png").read_bytes()
    dataset = take_over(refref, root, mesh=meshes_of(refref))
    assert dataset.seal == again.seal and verify_dataset(root).problems == []
    assert (root / "images" / "train" / "0000.mask.png").read_bytes() == before


# Other layouts


def write_frames(root: Path, name: str, files: list[str], **more: object) -> None:
    """A transforms file of cameras on a circle, and a picture for each: red grows with the place in the file."""
    frames = []
    for place, file in enumerate(files):
        angle = 2 * math.pi * place / len(files)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1] = (-math.sin(angle), math.cos(angle), 0), (0, 0, 1)
        matrix[:3, 2] = (math.cos(angle), math.sin(angle), 0)
        matrix[:3, 3] = (4 + place) * matrix[:3, 2]
        frames.append({"file_path": file, "transform_matrix": matrix.tolist()})
        path = root / (file if Path(file).suffix else f"{file}.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = np.full((SIDE, SIDE, 4), (10 * place, 100, 200, 255), np.uint8)
        picture[:, : SIDE // 2, 3] = 0
        Image.fromarray(picture if path.suffix == ".png" else picture[..., :3]).save(path)
    (root / name).write_text(json.dumps({"camera_angle_x": 0.7, **more, "frames": frames}))


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    root = tmp_path / "lego"
    for role, count in (("train", 6), ("val", 2), ("test", 5)):
        write_frames(root, f"transforms_{role}.json", [f"./{role}/r_{place}" for place in range(count)])
    return root


def edit_json(change: Callable[[dict], object], *names: str) -> Callable[[Path], None]:
    """Changes transforms files; that of training unless others are named."""

    def spoil(root: Path) -> None:
        for name in names or ("transforms_train.json",):
            data = json.loads((root / name).read_text())
            change(data)
            (root / name).write_text(json.dumps(data))

    return spoil


ALL = tuple(f"transforms_{role}.json" for role in ("train", "val", "test"))


def test_blenders_scenes_lie_on_white_and_train_what_needs_no_meshes(blender: Path, tmp_path: Path) -> None:
    dataset = take_over(blender, tmp_path / "out")
    assert dataset.num_views == {"train": 6, "interpolating": 4, "extrapolating": 1}
    image = dataset.view("train", 3).image
    assert (image[:, : SIDE // 2] == 255).all() and (image[:, SIDE // 2 :] == (30, 100, 200)).all()
    assert dataset.objects == () and dataset.cameras("train").fov_x == 0.7
    answer = call(f"datagen peel {dataset.root}")
    assert answer.status == 1 and "has no meshes" in answer.error and "--mesh FILE" in answer.error
    place = {split: dataset.cameras(split).world_from_camera[:, :3, 3] for split in SPLITS}
    away = {split: np.linalg.norm(place[split][:, None] - place["train"], axis=2).min(axis=1) for split in TEST_SPLITS}
    assert away["extrapolating"].min() > away["interpolating"].max()
    assert verify_dataset(dataset.root).problems == []
    page = look_page(dataset).decode()
    assert "No meshes were imported" in page and "has no meshes" not in page and "Cameras from above" in page


def test_a_mesh_for_pictures_may_have_quads_and_be_open_and_one_that_is_not_read_says_what_to_do(
    blender: Path, tmp_path: Path
) -> None:
    (tmp_path / "prism.ply").write_bytes(polygon_ply(8, "little", False))
    prism, _ = read_ply(tmp_path / "prism.ply")
    (tmp_path / "open.ply").write_bytes(write_ply(dataclasses.replace(prism, faces=prism.faces[1:])))
    command = f"datagen import-dataset {blender} --mesh {tmp_path}"
    answer = call(f"{command}/prism.ply --mesh {tmp_path}/open.ply --up y --out {tmp_path / 'out'}")
    assert answer.status == 0, answer.err
    solid, pane = load_scene(tmp_path / "out" / "scene", is_checked=True).objects
    assert signed_volume(solid.mesh) == pytest.approx(8 * math.sin(2 * math.pi / 8), rel=1e-5)
    assert pane.material == ThinDielectric(ior=1.5)
    assert "open: has 3 open edges; drawn as thin glass" in answer.err
    answer = call(f"{command}/prism.ply --material prsm=gold --out {tmp_path / 'no'}")
    assert "no object 'prsm'; did you mean 'prism'? Choose from prism" in answer.error


def test_the_world_is_scaled_and_turned_and_the_background_may_be_black(blender: Path, tmp_path: Path) -> None:
    dataset = take_over(blender, tmp_path / "out", scale=0.5, up="y", background="black")
    cameras = dataset.cameras("train")
    assert (dataset.view("train", 0).image[:, : SIDE // 2] == 0).all()
    before = json.loads((blender / "transforms_train.json").read_text())["frames"][1]["transform_matrix"]
    x, y, z = (row[3] for row in before[:3])
    assert np.allclose(cameras.world_from_camera[1, :3, 3], (0.5 * x, -0.5 * z, 0.5 * y))
    assert np.allclose(np.linalg.det(cameras.world_from_camera[:, :3, :3]), 1)


@pytest.mark.parametrize("size", [{"w": 2 * SIDE, "h": SIDE}, {"w": 2 * SIDE}, {"h": SIDE}, {}])
def test_pictures_may_be_wider_than_high_and_smaller_than_w_and_h_with_a_principal_point_anywhere(
    blender: Path, tmp_path: Path, size: dict[str, int]
) -> None:
    for path in blender.rglob("*.png"):
        Image.open(path).crop((0, 2, SIDE, SIDE - 2)).save(path)
    edit_json(lambda data: data.pop("camera_angle_x"), *ALL)(blender)
    edit_json(lambda data: data.update(**size, fl_x=18.0, cx=6.0 if size else SIDE, cy=5.5), *ALL)(blender)
    dataset = take_over(blender, tmp_path / "out")
    assert (dataset.config.resolution.width, dataset.config.resolution.height) == (SIDE, SIDE // 2)
    assert dataset.view("train", 0).image.shape == (SIDE // 2, SIDE, 3)
    listed = CameraList(**{split: dataset.cameras(split) for split in SPLITS})
    made = make_cameras(listed, dataset.config)
    for split in dataset.splits:
        for cameras in (dataset.cameras(split), made[split]):
            center = 3 if size else SIDE / 2
            assert np.allclose(cameras[0].intrinsics, [[9, 0, center], [0, 9, 2.75], [0, 0, 1]])


def test_openmaterials_masks_are_found_beside_the_pictures(tmp_path: Path) -> None:
    root = tmp_path / "glass"
    for role, count in (("train", 4), ("test", 2)):
        files = [f"{role}/images/{place:03d}.png" for place in range(count)]
        focal = 0.5 * SIDE / math.tan(0.35)
        write_frames(root, f"transforms_{role}.json", files, fl_x=focal, fl_y=focal, cx=4, cy=4, w=SIDE, h=SIDE)
        (root / role / "mask").mkdir()
        for file in files:
            mask = np.zeros((SIDE, SIDE), np.uint8)
            mask[2:5] = 255
            Image.fromarray(mask).save(root / role / "mask" / Path(file).name)
    dataset = take_over(root, tmp_path / "out")
    assert dataset.imported is not None and dataset.imported.layout == "openmaterial"
    assert dataset.view("train", 1).mask("glass").sum() == 3 * SIDE
    assert "masks: show the object, which is taken for glass" in dataset.imported.remarks


def test_a_single_transforms_file_is_split_as_it_says_or_else_each_eighth_picture_is_for_tests(tmp_path: Path) -> None:
    root = tmp_path / "frames"
    files = [f"images/frame_{place:05d}.jpg" for place in range(20)]
    write_frames(root, "transforms.json", files)
    assert take_over(root, tmp_path / "one").num_views == {"train": 17, "interpolating": 2, "extrapolating": 1}
    windows = [f".\\{file}".replace("/", "\\") for file in files]  # As Windows writes paths.
    lists = {"train_filenames": windows[:10], "val_filenames": [], "test_filenames": windows[15:]}
    write_frames(root, "transforms.json", files, **lists)

    def rename(data: dict) -> None:
        for frame, name in zip(data["frames"], windows, strict=True):
            frame["file_path"] = name

    edit_json(rename, "transforms.json")(root)
    dataset = take_over(root, tmp_path / "two")
    assert dataset.num_views == {"train": 10, "interpolating": 4, "extrapolating": 1}
    assert dataset.imported is not None
    assert "splits: 5 of 20 pictures are in none of the file's lists; left out" in dataset.imported.remarks


def display_p3() -> bytes:
    """The ICC profile of sRGB with the primaries of Display P3, adapted to D50."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    primaries = {
        b"rXYZ": (0.51512, 0.24120, -0.00105),
        b"gXYZ": (0.29198, 0.69225, 0.04189),
        b"bXYZ": (0.15710, 0.06657, 0.78407),
    }
    for entry in range(struct.unpack_from(">I", data, 128)[0]):
        name, offset, _ = struct.unpack_from(">4sII", data, 132 + 12 * entry)
        if name in primaries:
            struct.pack_into(">3i", data, offset + 8, *(round(value * 65536) for value in primaries[name]))
    return bytes(data)


def test_pictures_are_converted_from_their_colour_profiles_to_srgb(tmp_path: Path) -> None:
    path = tmp_path / "phone.png"

    def read(color: tuple[int, ...], mode: str, profile: bytes) -> list[int]:
        Image.new(mode, (2, 2), color).save(path, icc_profile=profile)
        return on_background(opened(path), path, "white")[1, 1].tolist()

    # By colour-science 0.4.7: RGB_to_RGB(..., "Display P3", "sRGB", apply_cctf_decoding=True, apply_cctf_encoding=True)
    assert read((60, 160, 90), "RGB", display_p3()) == pytest.approx([0, 163, 82], abs=1)
    assert read((200, 60, 40, 255), "RGBA", display_p3()) == pytest.approx([217, 42, 23], abs=1)
    assert read((200, 60, 40, 0), "RGBA", display_p3()) == [255, 255, 255]
    assert read((77,), "L", display_p3()) == [77, 77, 77]
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    assert read((60, 160, 90), "RGB", srgb) == [60, 160, 90]
    with pytest.raises(
        HyalineError, match=r"phone\.png: has a colour profile that cannot be used .*convert it to sRGB"
    ):
        read((1, 2, 3), "RGB", b"junk")


def test_our_own_nerfstudio_export_comes_back(ours: Dataset, tmp_path: Path) -> None:
    export_dataset(ours, "nerfstudio", tmp_path / "exported", num_points=50)
    dataset = take_over(tmp_path / "exported", tmp_path / "out")
    for split in SPLITS:
        assert np.array_equal(dataset.cameras(split).world_from_camera, ours.cameras(split).world_from_camera)
        for old, new in zip(ours.views(split), dataset.views(split), strict=True):
            assert np.array_equal(old.image, new.image)


# Refusals


def flip(pose: np.ndarray) -> np.ndarray:
    return pose @ np.diag([1.0, -1, -1, 1])


@pytest.mark.parametrize(
    ("line", "written", "question"),
    [
        ("import-dataset {} --mesh {}/glass.ply", flip, r"OpenCV's poses have y and z flipped"),
        ("import-dataset {} --mesh {}/glass.ply", np.linalg.inv, ""),
    ],
)
def test_poses_in_another_convention_than_the_meshes_are_recognised(
    ours: Dataset, tmp_path: Path, line: str, written: Callable[[np.ndarray], np.ndarray], question: str
) -> None:
    shutil.copy(ours.root / "scene" / "meshes" / "ball.ply", tmp_path / "glass.ply")
    shutil.copy(ours.root / "transforms_train.json", tmp_path)
    shutil.copy(ours.root / "transforms_test.json", tmp_path)
    shutil.copytree(ours.root / "images", tmp_path / "images")
    for name in ("images/test", "images/train"):
        (tmp_path / name).exists() or shutil.copytree(ours.root / "images" / "interpolating", tmp_path / name)
    command = f"datagen {line.replace('{}', str(tmp_path))} --material glass --out {tmp_path / 'out'}"
    assert call(command).status == 0

    def rewrite(data: dict) -> None:
        for frame in data["frames"]:
            frame["transform_matrix"] = written(np.array(frame["transform_matrix"])).tolist()

    edit_json(rewrite, ALL[0], ALL[2])(tmp_path)
    answer = call(f"{command} --overwrite")
    assert answer.status == 1
    assert re.search(f"no camera sees glass; expected world_from_camera, .*{question}", answer.error), answer.err


def set_first(**values: object) -> Callable[[Path], None]:
    return edit_json(lambda data: data["frames"][0].update(values))


def outside(root: Path) -> None:
    (root.parent / "secret.png").write_bytes((root / "train" / "r_0.png").read_bytes())
    (root / "train" / "r_0.png").unlink()
    (root / "train" / "r_0.png").symlink_to(root.parent / "secret.png")


def turned(root: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.new("RGB", (SIDE, SIDE)).save(root / "train" / "r_1.png", exif=exif)


def written(name: str, data: bytes | str | Image.Image) -> Callable[[Path], object]:
    def spoil(root: Path) -> None:
        if isinstance(data, Image.Image):
            data.save(root / name)
        else:
            (root / name).write_bytes(data.encode() if isinstance(data, str) else data)

    return spoil


def removed(*patterns: str) -> Callable[[Path], object]:
    return lambda root: [path.unlink() for pattern in patterns for path in root.glob(pattern)]


def second(**values: object) -> Callable[[Path], None]:
    return edit_json(lambda data: data["frames"][1].update(values))


MIRRORED = np.diag([-1.0, 1, 1, 1]).tolist()
HALF_LIST, DEEP = '{"frames": [', Image.fromarray(np.full((SIDE, SIDE), 300, np.uint16))
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no folder": (shutil.rmtree, "is not a folder; expected one with transforms_train.json"),
    "nothing known": (removed("*.json"), "has neither transforms_train.json nor transforms.json"),
    "one of ours": (written("dataset.json", "{}"), "is a hyaline dataset already"),
    "truncated list": (written("transforms_train.json", HALF_LIST), "transforms_train.json: not a JSON file"),
    "no frames": (edit_json(lambda data: data.update(frames=[])), "has 0 frames; expected 1 to"),
    "a path out": (set_first(file_path="../../secret"), "expected a file inside the folder"),
    "a link out": (outside, "is a link out of its folder"),
    "a missing picture": (set_first(file_path="./train/r_99"), "names 'train/r_99', which is not in"),
    "a test picture to train on": (set_first(file_path="./test/r_0"), "r_0.png: is listed to train on and to test"),
    "a mirrored camera": (set_first(transform_matrix=MIRRORED), "transform_matrix: camera: .* expected a rotation"),
    "a distorted lens": (set_first(k1=0.2), "its lens is distorted .k1.; expected straight lines"),
    "a panorama": (second(camera_model="EQUIRECTANGULAR"), "frames.1.: its camera is not a pinhole camera"),
    "two lenses": (second(camera_angle_x=0.3), "expected one lens for all"),
    "no lens": (edit_json(lambda data: data.pop("camera_angle_x")), "has no lens; expected camera_angle_x"),
    "pixels that are not square": (set_first(fl_x=9.0, fl_y=9.5), "has focal lengths 9 and 9.5; expected square"),
    "another size": (written("train/r_2.png", Image.new("RGB", (4, 4))), "r_2.png: is 4 x 4 pixels; expected 8 x 8"),
    "another shape": (edit_json(lambda data: data.update(w=16, h=8)), "w and h are 16 x 8; expected 8 x 8"),
    "a picture on its side": (turned, r"r_1\.png: is stored turned or mirrored .EXIF orientation 6.*mogrify"),
    "16 bits": (written("train/r_1.png", DEEP), "expected 8 bits a channel"),
    "a truncated picture": (written("test/r_1.png", b"\x89PNG\r\n\x1a\n"), "r_1.png: not a picture that can be read"),
    "no tests": (removed("transforms_val.json", "transforms_test.json"), "has 6 pictures to train on and 0 to test"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_broken_folder_is_refused_in_one_line(blender: Path, tmp_path: Path, name: str) -> None:
    spoil, message = HOSTILE[name]
    spoil(blender)
    with pytest.raises(HyalineError, match=message) as refusal:
        take_over(blender, tmp_path / "out")
    assert "\n" not in str(refusal.value)


def test_another_import_in_the_same_place_needs_to_be_told(blender: Path, tmp_path: Path) -> None:
    take_over(blender, tmp_path / "out")
    with pytest.raises(HyalineError, match="pictures that were rendered or imported otherwise; pass --overwrite"):
        take_over(blender, tmp_path / "out", scale=2.0)
    chosen = DatasetImportChoices(scale=2.0)
    dataset = write_import(plan_import(blender, chosen), tmp_path / "out", overwrite=True)
    assert verify_dataset(dataset.root).problems == []
