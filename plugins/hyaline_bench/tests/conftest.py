"""A benchmark of two scenes that needs no Mitsuba, with angles and one edit."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import look_at, pixel_rays, shade, synthetic_scene, trace, write_synthetic_dataset

from datagen.data.config import ANGLE_SPLITS, TEST_SPLITS, SceneEdit, Split, Variant
from datagen.data.dataset import Dataset
from datagen.data.images import encode_exr, linear_from_srgb, png_bytes
from datagen.data.paths import view_name
from datagen.data.variants import EDIT_MASKS_FOLDER, ELSEWHERE, LIGHT, OBJECT, variant_root
from datagen.data.writing import commit_view, write_head
from datagen.disk.ownership import EDIT_MASKS, begin
from datagen.disk.records import Json
from datagen.disk.storage import commit_all, sha256
from datagen.scene.edits import edit_scene, parse_edit
from datagen.scene.folder import scene_files
from hyaline_bench import protocol

PROTOCOL = """
version = 3
max_depth = 100
bootstrap = { resamples = 1000, seed = 0, confidence = 0.95 }
[presets]
tiny = { resolution = 32, train = { views = 8, spp = 4 }, test = { views = 2, spp = 4 } }
demo = { resolution = 64, train = { views = 8, spp = 4 }, test = { views = 2, spp = 4 } }
[scenes]
synthetic = ["remove:pane"]
[digests.tiny]
synthetic = "0123456789abcdef"
[random]
families = ["nested", "table"]
first_seed = 7100
count = 1
[hidden]
count = 2
commitment = ""
[splits]
interpolating = "near"
extrapolating = "far"
extrapolating-10deg = "outside"
[tracks]
pictures = "Pictures."
masks = "Masks."
proxies = "Proxies."
shapes = "Shapes."
materials = "Materials."
"""


def write_variant(dataset: Dataset, name: str, edit: SceneEdit | None) -> None:
    """The variant `angles`, or an edit at the dataset's own cameras, with truth of its own."""
    angles: tuple[Split, ...] = tuple(ANGLE_SPLITS)
    splits = TEST_SPLITS if edit else angles
    cameras = {split: dataset.cameras(split if edit else "extrapolating") for split in splits}
    if edit is None:  # Moved, so that nothing else has these pictures.
        for place, split in enumerate(splits):
            poses = np.stack([look_at(np.array([2.0, place - 1, 1.2 + view]), np.zeros(3)) for view in range(2)])
            cameras[split] = dataclasses.replace(cameras[split], world_from_camera=poses)
    files = scene_files(edit_scene(synthetic_scene(), (parse_edit("remove:pane"),)).scene) if edit else {}
    variant = write_head(
        variant_root(dataset.root, name),
        dataset.config,
        dataset.objects,
        cameras,
        files,
        variant=Variant(of=dataset.seal, splits=splits, edit=edit),
    )
    for split in splits:
        for view in range(2):
            layers = trace(*pixel_rays(cameras[split], view), 4)
            picture = shade(layers) if edit is None else 255 - shade(layers)
            radiance = linear_from_srgb(picture / 255).astype(np.float32)
            exr = encode_exr(radiance, np.full_like(radiance, 1e-3))
            pictures = {".png": png_bytes(picture), ".exr": exr}
            commit_view(variant, split, view, pictures, seed=0, spp=4, noise_mse=1e-4, variant="none")


def write_masks(dataset: Dataset, name: str) -> None:
    """Edit masks of a variant: its right half changes, and a quarter of that in the second view."""
    files: dict[str, bytes] = {}
    for split in TEST_SPLITS:
        for view, value in enumerate((LIGHT, OBJECT)):
            mask = np.full((*dataset.config.resolution.shape, 3), ELSEWHERE, np.uint8)
            mask[view * 24 :, 16:] = value
            files[f"{split}/{view_name(view)}.png"] = png_bytes(mask)
    root = variant_root(dataset.root, name) / EDIT_MASKS_FOLDER
    content: dict[str, Json] = {"files": {f"{EDIT_MASKS_FOLDER}/{file}": sha256(data) for file, data in files.items()}}
    begin(root, EDIT_MASKS, content, replace=True)
    commit_all(root, files)


def write_scene(root: Path, scene: str, train_views: int = 8) -> Dataset:
    """A dataset of one scene with its variants."""
    dataset = write_synthetic_dataset(root / f"{scene}-tiny", scene_name=scene, train_views=train_views)
    write_variant(dataset, "angles", None)
    write_masks(dataset, "no-glass")
    if scene == "synthetic":
        write_variant(dataset, "remove-pane", SceneEdit(edits=("remove:pane",), changed=("pane",), copies={}))
        write_masks(dataset, "remove-pane")
    return dataset


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both datasets, for reading only."""
    root = tmp_path_factory.mktemp("bench")
    for scene in ("synthetic", "random-nested-7100"):
        write_scene(root / "data", scene)
    (root / "protocol.toml").write_text(PROTOCOL)
    return root


@pytest.fixture
def other(tmp_path: Path) -> Dataset:
    """A dataset of another secret scene, in the folder `other`."""
    return write_scene(tmp_path / "other", "random-nested-7103", train_views=9)


@pytest.fixture
def small_protocol(made: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[protocol.Protocol]:
    """The protocol of the two scenes, in place of the real one."""
    monkeypatch.setattr(protocol, "PROTOCOL", made / "protocol.toml")
    protocol.load_protocol.cache_clear()
    yield protocol.load_protocol()
    protocol.load_protocol.cache_clear()
