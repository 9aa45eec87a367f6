"""Tests of the page of a fit: what is measured against closed forms, and what the report shows of a folder."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.fits import write_fit
from support.meshes import mesh_of
from support.pages import ReadPage, read_page
from support.synthetic import write_synthetic_dataset

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset
from datagen.data.images import png_bytes
from datagen.data.meshes import signed_volume
from datagen.data.metadata import Imported
from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit_sealed, load_sealed
from eval.analyses.fits import FitObject, Frame, heat_map, hull_mesh, knows_truth, section_of, true_floor
from eval.page.report import make_report

UPRIGHT = Frame(point=np.zeros(3), up=np.array([0.0, 0, 1]), across=np.array([1.0, 0, 0]))


def cup(floor: float) -> trimesh.Trimesh:
    line = [(0, 0.02), (0.4, 0), (0.5, 1), (0.45, 1), (0.36, floor + 0.1), (0, floor)]
    return trimesh.creation.revolve(line, sections=64)


def test_the_section_of_a_ball_is_a_circle_whatever_the_frame() -> None:
    ball = mesh_of(trimesh.creation.icosphere(5, 0.5))
    for up, across in (((0, 0, 1), (1, 0, 0)), ((0.6, 0, 0.8), (0, 1, 0))):
        frame = Frame(point=np.array([0.1, 0, 0]), up=np.array(up, float), across=np.array(across, float))
        cut = section_of(ball, frame)
        middle = np.array([-0.1 * across[0], -0.1 * up[0]])
        far = abs(0.1 * np.cross(up, across)[0])
        radius = math.sqrt(0.5**2 - far**2)
        np.testing.assert_allclose(np.linalg.norm(cut - middle, axis=-1), radius, atol=1e-3)
        assert np.linalg.norm(cut[:, 1] - cut[:, 0], axis=-1).sum() == pytest.approx(2 * math.pi * radius, rel=1e-2)


def test_the_floor_of_a_vessel_is_measured_on_its_axis_from_its_lowest_point() -> None:
    assert true_floor(mesh_of(cup(0.2)), UPRIGHT)["floor"] == pytest.approx(0.2, abs=1e-3)
    beside = dataclasses.replace(UPRIGHT, point=np.array([3.0, 0, 0]))
    assert true_floor(mesh_of(cup(0.2)), beside) == {}


def test_a_hull_outline_becomes_a_closed_outward_solid_on_its_axis() -> None:
    outline = tuple((0.1, height) for height in np.linspace(0, 0.3, 7))
    axis = {"point": (1.0, 2.0, 3.0), "direction": (0.0, 1.0, 0.0)}
    mesh = hull_mesh(FitObject(name="tube", kind="revolution", axis=axis, hull_outline=outline))
    assert mesh is not None
    assert signed_volume(mesh) == pytest.approx(math.pi * 0.1**2 * 0.3, rel=0.01)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [0.9, 2.0, 2.9], atol=1e-3)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [1.1, 2.3, 3.1], atol=1e-3)
    assert hull_mesh(FitObject(name="box", kind="box")) is None


def test_a_heat_map_shows_the_object_whole_and_cut_brighter_where_it_is_off() -> None:
    ball = mesh_of(trimesh.creation.icosphere(4, 0.5))
    points = ball.vertices.astype(float)
    in_front = np.where(points[:, 1] < 0, 0.001, 0.0)
    whole = heat_map(ball, (points, in_front), UPRIGHT, 0.001, is_cut=False)
    cut = heat_map(ball, (points, in_front), UPRIGHT, 0.001, is_cut=True)
    shown, behind = whole[..., 3] > 0, cut[..., 3] > 0
    assert shown.mean() == pytest.approx(math.pi / 4 * (248 / 256) ** 2, rel=0.02)
    assert 0.5 * shown.sum() < behind.sum() < shown.sum()
    # In the lower half everything seen is in front; without it, the far side is, which is on the truth.
    assert whole[160:200, 100:156, :3].mean() > 3 * cut[160:200, 100:156, :3].mean()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A dataset whose pane was fitted, with runs on the truth and on what was found."""
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic")
    runs = (("told", "truth", 2), ("told-seed1", "truth", 3), ("found", "fitted", 4), ("hull", "fitted-hull", 8))
    for name, geometry, level in runs:
        run = tmp_path / "runs" / "synthetic" / name
        for split in TEST_SPLITS:
            (run / "predictions" / split).mkdir(parents=True)
            for view in dataset.views(split):
                darker = view.image - np.minimum(view.image, level)
                (run / "predictions" / split / f"{view.index:04d}.png").write_bytes(png_bytes(darker))
        (run / "run.json").write_text(json.dumps({"method": "light-path", "geometry": geometry}))
    write_fit(dataset, tmp_path / "runs" / "synthetic" / "fit-fitted", ("pane",))
    return tmp_path


def report(root: Path) -> ReadPage:
    make_report(root / "runs", root / "data", root / "out", output_format="csv")
    return read_page((root / "out" / "index.html").read_bytes())


@pytest.mark.usefixtures("no_pictures")
def test_the_report_has_a_page_of_each_fit(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = report(root)
    assert "fit-fitted: no predictions" not in capsys.readouterr().err
    assert "fit-fitted" in [link.text for link in page.all("a")]
    (numbers,) = [table.text for table in page.all("table") if "What was found" in table.text]
    assert "index of refraction" in numbers and "1.480 to 1.510" in numbers and "-0.010" in numbers
    captions = [caption.text for caption in page.all("figcaption")]
    assert {"pane, cut through its axis", "index of refraction over the search", "wall (mm) over the search"} <= set(
        captions
    )
    assert {"pane: fitted, outside", "pane: fitted, cut open", "room", "search"} <= set(captions)
    place = captions.index("wall (mm) over the search")
    beside = captions[place:].index("room") + place
    assert [text.partition(":")[0] for text in captions[place:beside] if "PSNR" in text] == 2 * [
        "found",
        "hull",
        "told",
    ]
    (scene,) = json.loads((root / "out" / "results.json").read_text())["scenes"]
    pane = scene["analyses"]["fits"]["fit-fitted"]["pane"]["measured"]
    # A square scaled by 1.02: its rim is up to 2 % of a metre beyond the true one, its middle on it.
    assert 0 < pane["errors"]["mean_distance"] < 0.02 and pane["true"]["ior"] == 1.5
    assert pane["errors"]["wall"] is None and pane["hull_errors"] is None


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "fit.json: format version 2; this program reads 1"),
        ({"pictures": ["../../data/secret.png"]}, "pictures: is '../../data/secret.png'; expected a name"),
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


@pytest.mark.usefixtures("no_pictures")
def test_without_its_geometry_a_fit_still_has_its_numbers(root: Path) -> None:
    shutil.rmtree(root / "data" / "synthetic" / "proxies")
    page = report(root)
    assert "1.480 to 1.510" in page.source and "pane, cut through" in page.source
    assert "Shapes against the true ones" not in page.source


@pytest.mark.usefixtures("no_pictures")
def test_a_damaged_mesh_is_named_and_the_runs_are_scored(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = root / "data" / "synthetic" / "proxies" / "fitted" / "meshes" / "pane.ply"
    mesh.write_bytes(mesh.read_bytes()[:-1] + b"!")
    with pytest.raises(HyalineError, match=r"pane\.ply: damaged"):
        report(root)
    assert "told" in capsys.readouterr().out


def test_the_truth_of_photographs_is_unknown(dataset: Dataset) -> None:
    source = Imported(layout="capture", source="photos", source_sha256="0", has_masks=True, has_depth=False)
    assert knows_truth(dataset)
    assert not knows_truth(dataclasses.replace(dataset, imported=source))
    assert knows_truth(dataclasses.replace(dataset, imported=dataclasses.replace(source, layout="refref")))
