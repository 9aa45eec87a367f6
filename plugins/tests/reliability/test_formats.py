"""Tests that what an older program of the same formats has written is read, and that another format is refused."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from support.hostile import DATASET, RUN

from datagen.builder.verify import verify_dataset
from datagen.data.config import square
from datagen.data.dataset import open_dataset
from datagen.data.geometries import read_proxy_records
from datagen.disk.errors import HyalineError
from datagen.disk.records import SEAL, seal_bytes
from datagen.scene.folder import load_scene
from eval.score.runs import open_run, read_prediction
from model.run.predict import load_renderer
from model.run.run_folder import read_predictions, read_run
from model.state import fingerprint, load_state

pytestmark = pytest.mark.promise("R13")

HEADS: dict[str, Callable[[Path], object]] = {
    "scene/scene.json": lambda root: load_scene(root / "scene"),
    f"{DATASET}/dataset.json": lambda root: open_dataset(root / DATASET),
    f"{DATASET}/layers/straight/layers.json": lambda root: open_dataset(root / DATASET).layer_store(),
    f"{DATASET}/proxies/box/proxies.json": lambda root: read_proxy_records(open_dataset(root / DATASET), "box"),
    f"{RUN}/run.json": lambda root: read_run(root / RUN),
    f"{RUN}/predictions.json": lambda root: read_predictions(root / RUN),
    f"{RUN}/weights.pt": lambda root: load_state(root / RUN / "weights.pt"),
}
"""Each kind of file that carries a version, and what reads it."""


@pytest.fixture
def frozen(tmp_path: Path) -> Path:
    """What the first program of today's versions of all formats wrote (tests/support/freeze.py)."""
    with zipfile.ZipFile(Path(__file__).parent / "frozen" / "world.zip") as archive:
        archive.extractall(tmp_path)
    return tmp_path


def test_what_was_written_in_this_version_is_read_for_ever(frozen: Path) -> None:
    assert verify_dataset(frozen / DATASET).problems == []
    dataset = open_dataset(frozen / DATASET)
    assert dataset.config.resolution == square(8)
    assert dataset.view("extrapolating", 1).layers().object_id.any()
    assert len(load_scene(frozen / "scene").objects) == 2
    run = open_run(frozen / RUN, frozen / "data")
    assert read_prediction(run, "interpolating", 1).shape == (8, 8, 3)
    renderer = load_renderer(frozen / RUN, read_run(frozen / RUN).config, dataset)
    assert all(torch.isfinite(value).all() for value in renderer.parameters())


@pytest.mark.parametrize("path", HEADS)
@pytest.mark.parametrize("version", [0, 99, None, "1", -1])
def test_another_version_is_refused_by_name(frozen: Path, path: str, version: object) -> None:
    HEADS[path](frozen)
    (frozen / path).write_bytes(with_version((frozen / path).read_bytes(), version))
    with pytest.raises(HyalineError, match=f"{Path(path).name}: .*version"):
        HEADS[path](frozen)


def test_a_report_refuses_a_run_of_an_older_version(frozen: Path) -> None:
    path = frozen / RUN / "run.json"
    path.write_bytes(with_version(path.read_bytes(), 4))
    with pytest.raises(HyalineError, match=r"run\.json: format version 4; this program reads 5; train it again"):
        open_run(frozen / RUN, frozen / "data")


def with_version(data: bytes, version: object) -> bytes:
    """A file that says another version, and is whole else."""
    if data[:1] == b"{":
        content = json.loads(data)
        changed = {**content, "version": version}
        changed.pop(SEAL, None)
        return seal_bytes(changed) if SEAL in content else json.dumps(changed).encode()
    state: dict[str, Any] = torch.load(io.BytesIO(data), weights_only=True)
    state = {**{key: value for key, value in state.items() if key != "sha256"}, "version": version}
    buffer = io.BytesIO()
    torch.save({**state, "sha256": fingerprint(state)}, buffer)
    return buffer.getvalue()
