"""Tests that layers are finished by the same command, whatever a kill or a deletion left of them."""

import os
import shutil
from pathlib import Path

import pytest
from support import fake_renderer
from support.synthetic import synthetic_scene

from datagen.build.build import build_dataset, peel_dataset
from datagen.data.config import DatasetConfig, SplitConfig, square
from datagen.data.dataset import open_dataset
from datagen.data.paths import TRUTH

pytestmark = pytest.mark.promise("R1")

FEW = SplitConfig(views=1, spp=4)
CONFIG = DatasetConfig(
    scene="synthetic",
    preset="tiny",
    resolution=square(4),
    train=SplitConfig(views=2, spp=4),
    interpolating=FEW,
    extrapolating=FEW,
)


@pytest.fixture(autouse=True)
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # Nothing here cuts the power.
    fake_renderer.install(monkeypatch)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data") / "built"
    with pytest.MonkeyPatch.context() as patch:
        fake_renderer.install(patch)
        build(root)
    return root


def build(root: Path) -> None:
    build_dataset(synthetic_scene(), root, CONFIG, num_layers=3, workers=1, overwrite=False)


def peel(root: Path, *, overwrite: bool = False) -> None:
    peel_dataset(open_dataset(root), TRUTH, num_layers=3, overwrite=overwrite)


def tree(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_peel_and_build_make_whole_what_is_left_when_a_file_or_folder_of_layers_is_deleted(
    built: Path, tmp_path: Path
) -> None:
    whole = tree(built)
    root = tmp_path / "damaged"
    shutil.copytree(built, root)
    places = [Path("layers"), *(path.relative_to(built) for path in sorted((built / "layers").rglob("*")))]
    for number, place in enumerate(places):
        path = root / place
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        (peel, build)[number % 2](root)
        assert tree(root) == whole, place
