"""Tests that the schema of scene.json says what its reader does."""

import copy
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import synthetic_scene

from datagen.data.cameras import Lens, look_at
from datagen.data.config import square
from datagen.disk.errors import HyalineError
from datagen.disk.records import from_json
from datagen.scene.camera_list import CameraList
from datagen.scene.folder import FILE_RECORD, load_scene, scene_files
from datagen.scene.schema import scene_schema, schema_page, schema_text

ROOT = Path(__file__).resolve().parents[3]
SCHEMA = scene_schema()

TYPES = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}


def is_valid(value: object, schema: dict) -> bool:
    """The part of JSON schema that ours uses."""
    if "$ref" in schema:
        return is_valid(value, SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]])  # type: ignore[index]
    if "oneOf" in schema:
        return sum(is_valid(value, choice) for choice in schema["oneOf"]) == 1
    if "allOf" in schema:
        return all(is_valid(value, part) for part in schema["allOf"])
    if "const" in schema or "enum" in schema:
        return any(type(value) is type(one) and value == one for one in schema.get("enum", [schema.get("const")]))
    kind = schema.get("type")
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind in ("number", "integer"):
        return is_number and (kind == "number" or isinstance(value, int))
    if kind is not None and not isinstance(value, TYPES[kind]):
        return False
    if isinstance(value, dict):
        keys = schema.get("properties", {})
        return (
            set(schema.get("required", ())) <= set(value)
            and (schema.get("additionalProperties", True) or set(value) <= set(keys))
            and all(is_valid(item, keys[key]) for key, item in value.items() if key in keys)
        )
    if isinstance(value, list):
        items = schema.get("prefixItems", [schema.get("items")] * len(value))
        return len(value) == len(items) and all(map(is_valid, value, items))
    return True


def sample() -> dict:
    """A scene.json with most types in it."""
    data = json.loads(scene_files(synthetic_scene())["scene.json"])
    colors = [[0.1, 0.1, 0.1], [0.8, 0.8, 0.8]]
    materials = [
        {"type": "Dielectric", "ior": "bk7", "absorption": [1, 2, 3], "priority": -1, "dispersion": "measured"},
        {"type": "RoughDielectric", "ior": 1.4, "roughness": 0.2},
        {"type": "ThinDielectric", "tint": [1, 0.5, 0.5]},
        {"type": "Diffuse", "color": {"type": "SolidTexture", "pattern": "wood", "colors": colors, "scale": 0.1}},
        {"type": "Plastic", "color": {"type": "ImageTexture", "path": "a.png"}},
        {"type": "Conductor", "color": [1, 0.8, 0.3]},
    ]
    data["objects"] = [
        {"name": f"o{index}", "mesh": None, "material": material, "transform": {"translation": [0, 0, 1]}}
        for index, material in enumerate(materials)
    ]
    data["lights"] = [{"corner": [0, 0, 2], "edge_u": [1, 0, 0], "edge_v": [0, 1, 0], "radiance": [1, 1, 1]}]
    return data


def changes_of(data: object) -> Iterator[object]:
    """Each value inside left out, or replaced by one of another kind."""
    if isinstance(data, (dict, list)):
        for key in list(data) if isinstance(data, dict) else range(len(data)):
            for inner in changes_of(data[key]):
                changed = copy.copy(data)
                changed[key] = inner
                yield changed
            if isinstance(data, dict):
                yield {other: value for other, value in data.items() if other != key}
        if isinstance(data, dict):
            yield {**data, "nothing": 1}
    for other in (None, True, 0.5, 3, "text", [], {}, [1, 2, 3]):
        if type(other) is not type(data):
            yield other


def is_read(data: object) -> bool:
    try:
        from_json(FILE_RECORD, data, where="scene.json")  # type: ignore[arg-type]
    except HyalineError:
        return False
    return True


def test_the_shipped_schema_and_page_are_those_of_the_records() -> None:
    command = "python -m datagen.scene.schema"
    assert (ROOT / "datagen" / "scene" / "scene.schema.json").read_text() == schema_text(), command
    assert (ROOT / "docs" / "scene-json.md").read_text() == schema_page(), f"{command} --page"


def test_the_schema_accepts_what_is_written_and_what_the_documentation_shows() -> None:
    assert is_valid(json.loads(scene_files(synthetic_scene())["scene.json"]), SCHEMA)
    assert is_valid(sample(), SCHEMA)
    assert is_read(sample())
    found = re.search(r"```json\n(.*?)```", (ROOT / "docs" / "scenes.md").read_text(), flags=re.DOTALL)
    assert found is not None
    assert is_valid(json.loads(found[1]), SCHEMA)


def test_whatever_the_schema_refuses_the_reader_refuses_and_what_it_accepts_fails_only_by_its_values() -> None:
    count = refused = 0
    for changed in changes_of(sample()):
        count += 1
        accepted = is_valid(changed, SCHEMA)
        refused += not accepted
        if is_read(changed):
            assert accepted, changed
        elif accepted:
            # A value of the right kind: the records check numbers, names and paths themselves.
            with pytest.raises(HyalineError, match=r"expected|has no"):
                from_json(FILE_RECORD, changed, where="scene.json")  # type: ignore[arg-type]
    assert count > 500
    assert refused > 0.8 * count


def test_cameras_that_are_listed_are_read_as_they_stand(tmp_path: Path) -> None:
    from datagen.data.config import DatasetConfig, SplitConfig
    from datagen.data.transforms import TRANSFORMS_FILES
    from datagen.scene.folder import save_scene
    from datagen.scene.rig import make_cameras, with_listed_views

    save_scene(synthetic_scene(), tmp_path)
    data = json.loads((tmp_path / "scene.json").read_text())
    rng = np.random.default_rng(0)
    target = np.array([0.1, 0.0, 0.2])
    places = {
        split: rng.normal(size=(count, 3))
        for split, count in (("train", 5), ("interpolating", 2), ("extrapolating", 3))
    }
    for place in places.values():
        place[:, 2] = 1 + np.abs(place[:, 2])
    poses = {split: np.stack([look_at(one, target) for one in place]) for split, place in places.items()}
    del data["cameras"]
    assert is_valid(data, SCHEMA)
    (tmp_path / "scene.json").write_text(json.dumps(data))
    with pytest.raises(HyalineError, match=r"scene.json: has no cameras; expected `cameras` there, or transforms_tr"):
        load_scene(tmp_path)
    listed = {split: [{"transform_matrix": pose.tolist()} for pose in each] for split, each in poses.items()}
    for split, frames in listed.items():
        (tmp_path / TRANSFORMS_FILES[split]).write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    scene = load_scene(tmp_path)
    assert scene.cameras.target == pytest.approx(target, abs=1e-5)
    split = SplitConfig(views=8, spp=16)
    config = DatasetConfig(
        scene="synthetic", preset="tiny", resolution=square(16), train=split, interpolating=split, extrapolating=split
    )
    with pytest.raises(HyalineError, match=r"train: 8 views are asked for, and the scene lists 5 cameras"):
        make_cameras(scene.cameras, config)
    made = make_cameras(scene.cameras, with_listed_views(config, scene.cameras))
    for name, cameras in made.items():
        assert np.array_equal(cameras.world_from_camera, poses[name])
        assert cameras.fov_x == 0.6
    assert scene_files(load_scene(tmp_path)) == scene_files(scene)
    listed["train"][1]["transform_matrix"][0][0] += 0.1
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": listed["train"]}))
    with pytest.raises(
        HyalineError, match=r"train.json: frames\[1\].transform_matrix: .*expected a rotation and a place"
    ):
        load_scene(tmp_path)
    (tmp_path / "scene.json").write_text(json.dumps({**data, "cameras": {"type": "CameraList", "train": []}}))
    with pytest.raises(HyalineError, match=r"no CameraList is read any more; list them in transforms files"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("first", "last"), [(-30.0, 100.0), (150.0, 260.0), (0.0, 360.0)])
def test_listed_cameras_know_where_on_the_circle_around_their_target_they_stand(first: float, last: float) -> None:
    azimuth = np.radians(np.linspace(first, last, 14))
    elevation = np.radians(np.linspace(10, 50, 14))
    across = 2 * np.cos(elevation)
    places = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), 2 * np.sin(elevation)], axis=1)
    lens = Lens(fov_x=0.6, width=1, height=1)
    train = lens.cameras(np.stack([look_at(place, np.zeros(3)) for place in places]))
    cameras = CameraList(train=train, interpolating=train, extrapolating=train)
    assert cameras.radius == pytest.approx(2, abs=1e-5)
    assert cameras.elevation_deg == pytest.approx((10, 50), abs=1e-3)
    found = np.array(cameras.azimuth_deg)
    assert found[1] - found[0] == pytest.approx(last - first, abs=1e-3)
    assert (found[0] - first + 180) % 360 == pytest.approx(180, abs=1e-3)


def test_glass_is_known_by_name() -> None:
    from datagen.scene.materials import Dielectric, Plastic, RoughDielectric, ThinDielectric

    for kind in (Dielectric, RoughDielectric, ThinDielectric):
        assert kind(ior="diamond").surface().ior == 2.417
        assert kind(ior=1).surface().ior == 1
    assert Dielectric(ior="bk7").medium.ior == 1.5168  # type: ignore[union-attr]
    assert Plastic(color=(1, 1, 1), ior="acrylic").surface().ior == 1.491
    with pytest.raises(HyalineError, match=r"ior: is 'crown'; expected a number, or one of air, ice, water"):
        Dielectric(ior="crown")


def test_a_cutout_of_earlier_versions_is_refused_by_name(tmp_path: Path) -> None:
    data = json.loads(scene_files(synthetic_scene())["scene.json"])
    data["objects"][0]["cutout"] = {"type": "Cutout", "image": "leaf.png"}
    (tmp_path / "scene.json").write_text(json.dumps(data))
    with pytest.raises(HyalineError, match=r"scene\.json: a cutout is no longer read"):
        load_scene(tmp_path)
