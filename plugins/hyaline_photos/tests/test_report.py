"""Tests of the page of a fit: what is measured against closed forms, and what the report shows of a folder."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.fits import write_fit
from support.meshes import mesh_of
from support.pages import ReadPage, read_page
from support.synthetic import write_predictions, write_synthetic_dataset

from datagen.data.config import Imported
from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.disk.records import commit_sealed, load_sealed
from eval.page.report import make_report
from hyaline_photos.report import knows_truth, true_floor


def cup(floor: float) -> trimesh.Trimesh:
    line = [(0, 0.02), (0.4, 0), (0.5, 1), (0.45, 1), (0.36, floor + 0.1), (0, floor)]
    return trimesh.creation.revolve(line, sections=64)


def test_the_floor_of_a_vessel_is_measured_on_its_axis_from_its_lowest_point() -> None:
    up = np.array([0.0, 0, 1])
    assert true_floor(mesh_of(cup(0.2)), np.zeros(3), up)["floor"] == pytest.approx(0.2, abs=1e-3)
    assert true_floor(mesh_of(cup(0.2)), np.array([3.0, 0, 0]), up) == {}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A dataset whose pane was fitted, with a run."""
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic")
    write_predictions(dataset, tmp_path / "runs" / "synthetic" / "told", lambda picture: picture)
    write_fit(dataset, tmp_path / "runs" / "synthetic" / "fit-fitted", ("pane",))
    return tmp_path


def report(root: Path) -> ReadPage:
    make_report(root / "runs", root / "data", root / "out", output_format="json")
    return read_page((root / "out" / "index.html").read_bytes())


def test_the_report_has_a_page_of_each_fit(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = report(root)
    assert "fit-fitted: no predictions" not in capsys.readouterr().err
    assert "fit-fitted" in [link.text for link in page.all("a")]
    (numbers,) = [each.text for each in page.all("table") if "glass found from masks and pictures" in each.text]
    assert "1.490 (1.500)" in numbers
    assert {"room", "search"} <= {caption.text for caption in page.all("figcaption")}
    (scene,) = json.loads((root / "out" / "results.json").read_text())["scenes"]
    pane = scene["analyses"]["fits"]["fit-fitted"]["pane"]["measured"]
    # A square scaled by 1.02: its rim is up to 2 % of a metre beyond the true one, its middle on it.
    assert 0 < pane["errors"]["chamfer"] < 0.02 and pane["true"]["ior"] == 1.5
    assert pane["errors"]["thickness"] is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 1}, "fit.json: format version 1; this program reads 3"),
        ({"objects": [{"name": "pane"}]}, r"objects\[0\]: key 'kind' is missing"),
        ({"objects": 3}, "objects: is 3; expected a list"),
    ],
)
def test_a_fit_that_cannot_be_read_is_named_and_the_runs_are_scored(
    root: Path, change: dict, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = root / "runs" / "synthetic" / "fit-fitted" / "fit.json"
    commit_sealed(path, {**load_sealed(path), **change})
    with pytest.raises(HyalineError, match=message):
        report(root)
    assert "told" in capsys.readouterr().out


def test_a_damaged_mesh_is_named_and_without_the_geometry_a_fit_still_has_its_numbers(root: Path) -> None:
    geometry = root / "data" / "synthetic" / "proxies" / "fitted"
    mesh = geometry / "meshes" / "pane.ply"
    mesh.write_bytes(mesh.read_bytes()[:-1] + b"!")
    with pytest.raises(HyalineError, match=r"pane\.ply: damaged"):
        report(root)
    shutil.rmtree(geometry.parent)
    assert "1.490 (1.500)" in report(root).source


def test_the_truth_of_photographs_is_unknown(dataset: Dataset) -> None:
    source = Imported(layout="capture", source="photos", source_sha256="0", has_masks=True, has_depth=False)
    assert knows_truth(dataset)
    assert not knows_truth(dataclasses.replace(dataset, imported=source))
    assert knows_truth(dataclasses.replace(dataset, imported=dataclasses.replace(source, layout="refref")))
