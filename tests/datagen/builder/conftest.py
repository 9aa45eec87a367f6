"""A scene in a folder and the dataset that one build makes of it, which tests copy and compare with."""

from pathlib import Path

import pytest
from support.builds import build
from support.commands import run
from support.synthetic import synthetic_scene

from datagen.scene.folder import save_scene


@pytest.fixture(scope="session")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "mine"
    save_scene(synthetic_scene(), folder)
    return folder


@pytest.fixture(scope="session")
def built(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "built"
    run(build(scene_folder, out))
    return out
