"""Tests of the look at a dataset: it shows what is there, names what is not, and its light paths obey optics."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.pages import ReadPage, read_page
from support.synthetic import HEIGHTS, write_synthetic_dataset

from datagen.data.dataset import Dataset, open_dataset
from datagen.look.drawings import RAYS, SKY, find_light_paths, object_colors
from datagen.look.look import look_page
from datagen.machine.mitsuba_variant import use_mitsuba

use_mitsuba()


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return write_synthetic_dataset(tmp_path / "data" / "synthetic")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, ReadPage]:
    """A dataset in which nothing is missing, and the page that the command writes."""
    root = tmp_path_factory.mktemp("look")
    dataset = write_synthetic_dataset(root / "data" / "synthetic")
    for _ in range(2):  # A page of its own is replaced.
        run(f"datagen look '{dataset.root}' --out '{root}/look.html'")
    return dataset, read_page((root / "look.html").read_bytes())


def test_the_page_shows_every_split_every_object_and_all_that_is_stored(whole: tuple[Dataset, ReadPage]) -> None:
    dataset, page = whole
    assert any(paragraph.text.endswith("files match their checksums.") for paragraph in page.all("p"))
    health = [value.text for value in page.all("dd")][: len(dataset.splits)]
    assert all(
        re.fullmatch(r"noise ceiling [\d.]+ dB; pixels that see glass: [\d.]+ %; black.*", text) for text in health
    )
    labels = {svg.attributes.get("aria-label") for svg in page.all("svg")}
    for split in dataset.splits:
        for name in ("picture", "glass", "depth", "normals", "layer 0", "layer 1"):
            assert f"{split} view 0: {name}" in labels
    assert "Cameras from above, and the glass" in labels
    assert {"pane", "floor"} <= {cell.text for cell in page.all("th")}
    assert any(cell.text.startswith("ThinDielectric(ior=1.5") for cell in page.all("td"))
    assert all(item.attributes["src"].startswith("data:") for item in page.all("img")) and "`" not in "".join(
        item.text for item in page.all("main")
    )
    fills = [rect.attributes.get("fill") for rect in page.all("rect")]
    assert {"#" + bytes(color.tolist()).hex() for color in object_colors(2)[1:]} <= set(fills)
    found = find_light_paths(dataset)
    assert found is not None and f"Light paths over train view {found[0].index}" in labels
    rows = [row.text for row in page.all("tr")]
    for path in found[1]:
        assert any(row.startswith(f"{path.ray}{path.pixel[0]}, {path.pixel[1]}pane → ") for row in rows)


def test_what_is_missing_or_damaged_is_said_and_the_rest_is_shown(dataset: Dataset) -> None:
    found = find_light_paths(dataset)
    assert found is not None
    (dataset.root / "images" / "train" / "0001.exr").unlink()
    (dataset.root / "images" / "train" / f"{found[0].index:04d}.png").unlink()
    extrapolating = dataset.root / "images" / "extrapolating" / "0000.png"
    extrapolating.write_bytes(extrapolating.read_bytes()[:-9])
    page = read_page(look_page(open_dataset(dataset.root)))
    labels = [svg.attributes.get("aria-label") for svg in page.all("svg")]
    assert "extrapolating view 1: depth" in labels and "extrapolating view 1" in labels  # The other one is whole.
    assert "3 of the files are missing or damaged." in [link.text for link in page.all("a")]
    bad = [element.text for element in page.elements if element.attributes.get("class") == "bad"]
    for place in ("extrapolating/0000.png: damaged", "train/0001.exr: the file is missing"):
        assert any(place in text for text in bad)
    assert "Cameras from above, and the glass" in labels and not any(
        str(label).startswith("Light paths over") for label in labels
    )


def test_a_ray_goes_straight_through_the_thin_pane_to_the_floor_and_its_mirror_image_to_the_sky(
    whole: tuple[Dataset, ReadPage],
) -> None:
    found = find_light_paths(whole[0])
    assert found is not None
    view, paths = found
    assert {path.ray for path in paths} == set(range(1, RAYS + 1))
    origin, directions = view.camera.rays()
    for path in paths:
        column, row = path.pixel
        camera, pane, *_, end = path.points
        np.testing.assert_array_equal(camera, origin)
        ray = (pane - camera) / np.linalg.norm(pane - camera)
        assert np.allclose(ray, directions[row, column], atol=1e-5), "it begins at the camera, through its pixel"
        assert pane[2] == pytest.approx(HEIGHTS[0], abs=1e-5)
        assert path.through == "pane"
        if path.is_reflected:
            back = end - pane
            assert np.allclose(back / np.linalg.norm(back), ray * [1, 1, -1], atol=1e-4), "the law of reflection"
            assert path.end == SKY
        else:
            assert np.allclose(np.cross(end - pane, ray), 0, atol=1e-4), "a thin pane bends nothing"
            assert path.end in ("floor", SKY)
            if path.end == "floor":
                assert end[2] == pytest.approx(HEIGHTS[1], abs=1e-5)
    kinds = [path.is_reflected for path in paths]
    assert kinds.count(True) == kinds.count(False) == RAYS
    assert any(path.end == "floor" for path in paths)
