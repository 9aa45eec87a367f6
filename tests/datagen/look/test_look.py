"""Tests of the look at a dataset: it shows what is there, names what is not, and stands alone as a page."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.pages import ReadPage, read_page
from support.synthetic import write_synthetic_dataset

from datagen.data.dataset import Dataset, open_dataset
from datagen.look.look import _settings, folder_sizes, look_page, missing_lines
from datagen.look.view_pictures import depth_picture, object_colors, stored_pictures
from datagen.pages.html import tag


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return write_synthetic_dataset(tmp_path / "data" / "synthetic")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, ReadPage]:
    """A dataset in which nothing is missing, and the page that the command writes."""
    root = tmp_path_factory.mktemp("look")
    dataset = write_synthetic_dataset(root / "data" / "synthetic")
    run(f"datagen look '{dataset.root}' --out '{root}/look.html'")
    return dataset, read_page((root / "look.html").read_bytes())


def test_the_page_shows_every_split_every_object_and_all_that_is_stored(whole: tuple[Dataset, ReadPage]) -> None:
    dataset, page = whole
    assert any(paragraph.text.endswith("files match their checksums.") for paragraph in page.all("p"))
    labels = {svg.attributes.get("aria-label") for svg in page.all("svg")}
    for split in dataset.splits:
        for name in ("picture", "glass", "depth", "normals", "layer 0", "layer 1"):
            assert f"{split} view 0: {name}" in labels
    assert "Cameras from above" in labels
    cells = [cell.text for cell in page.all("th")]
    assert {"pane", "floor"} <= set(cells)
    assert {"ThinDielectric", "Diffuse"} <= {cell.text for cell in page.all("td")}


def test_pictures_come_before_text_and_say_what_their_colours_mean(whole: tuple[Dataset, ReadPage]) -> None:
    dataset, page = whole
    order = [item.attributes.get("id") for item in page.elements if item.name == "section"]
    assert order[0] == "pictures"
    places = [order.index(name) for name in ("pictures", "light-paths", "cameras", "stored", "objects", "facts")]
    assert places == sorted(places)
    layers = dataset.view("train", 0).layers()
    seen = layers.depth[0][layers.object_id[0] > 0]
    near, far = (f"{value:.2f} m" for value in (seen.min(), seen.max()))
    bars = [svg.attributes["aria-label"] for svg in page.all("svg") if svg.attributes.get("class") == "bar"]
    assert f"depth from {near}, bright, to {far}, dark" in bars
    assert {near, far} <= {span.text for span in page.all("span")}
    legends = [item.text for item in page.all("ul") if item.attributes.get("aria-label") == "Objects by colour"]
    assert legends == ["panefloor"] * len(dataset.splits)
    swatches = re.findall(r'class="key square".*?fill="(#.{6})".*?</svg>(\w+)', page.source)
    for color, name in swatches:
        shown = object_colors(2)[dataset.object_id(name)]
        assert color == "#" + bytes(shown.tolist()).hex()
    details = [item for item in page.all("details") if "pictures" in item.text]
    assert ["open" in item.attributes for item in details] == [True, False, False]
    assert "`" not in "".join(item.text for item in page.all("main"))


def test_what_is_missing_or_damaged_is_said_and_the_rest_is_shown(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datagen.look.look.draw_light_paths", lambda *_: tag("p"))  # Of another test.
    (dataset.root / "images" / "train" / "0001.exr").unlink()
    (dataset.root / "layers" / "straight" / "records" / "interpolating" / "0000.json").unlink()
    extrapolating = dataset.root / "images" / "extrapolating" / "0000.png"
    extrapolating.write_bytes(extrapolating.read_bytes()[:-9])
    count = dataset.num_views["train"]
    assert missing_lines(dataset) == [
        f"train: 1 of {count} views are not built, such as 1",
        f"interpolating: 1 of {dataset.num_views['interpolating']} views lack layers of truth",
    ]
    page = read_page(look_page(open_dataset(dataset.root)))
    labels = [svg.attributes.get("aria-label") for svg in page.all("svg")]
    assert "extrapolating view 1: depth" in labels and "extrapolating view 1" in labels  # The other one is whole.
    assert "3 things are missing or damaged." in [link.text for link in page.all("a")]
    bad = [element.text for element in page.elements if element.attributes.get("class") == "bad"]
    assert any("extrapolating/0000.png: damaged" in text for text in bad)
    assert any("train/0001.exr: the file is missing" in text for text in bad)
    assert any("run the command that made it again" in paragraph.text for paragraph in page.all("p"))
    assert "train view 0: picture" in labels


def test_masks_depth_and_layers_are_what_the_dataset_stores(dataset: Dataset) -> None:
    view = dataset.view("interpolating", 0)
    stored, layers = stored_pictures(view, has_layers=True), view.layers()
    pictures = {name: picture.pixels for name, picture in stored.items()}
    glass = view.mask("glass")
    np.testing.assert_array_equal(pictures["glass"][glass], view.image[glass])
    assert (pictures["glass"][~glass] <= view.image[~glass] // 5).all()
    np.testing.assert_array_equal(pictures["layer 1"], object_colors(2)[layers.object_id[1]])
    assert len(np.unique(object_colors(200), axis=0)) == 201
    depth = depth_picture(np.array([[1, 2], [3, 9]], np.float32), np.array([[True, True], [True, False]]))
    assert depth.pixels[..., 0].tolist() == [[255, 147], [40, 0]]
    assert depth.metres == (1, 3)
    assert stored["layer 1"].object_ids == tuple(np.unique(layers.object_id[1][layers.object_id[1] > 0]))
    assert list(stored_pictures(view, has_layers=False)) == ["picture"]


def test_sizes_are_those_of_the_files(dataset: Dataset) -> None:
    sizes = folder_sizes(dataset.root)
    paths = [Path(place) / name for place, _, names in os.walk(dataset.root) for name in names]
    assert sum(sizes.values()) == sum(path.stat().st_size for path in paths)
    assert sizes["images"] == sum(path.stat().st_size for path in (dataset.root / "images").rglob("*.*"))


def test_of_a_large_dataset_the_names_alone_are_looked_at(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = dataset.root / "images" / "train" / "0000.exr"
    picture.write_bytes(picture.read_bytes()[:-9])
    monkeypatch.setattr("datagen.look.look.MOST_VERIFIED_BYTES", 1000)
    monkeypatch.setattr("datagen.look.look.draw_light_paths", lambda *_: tag("p"))  # Of another test.
    page = read_page(look_page(open_dataset(dataset.root)))
    assert "No file is missing." in [paragraph.text for paragraph in page.all("p")]
    assert any("datagen verify" in code.text for code in page.all("code"))


def test_the_settings_of_a_material_are_words_and_numbers() -> None:
    told = {"type": "Plastic", "color": [0.5, 0.25, 1.0], "ior": "bk7", "roughness": 0.0, "map": {"type": "Checker"}}
    assert _settings(told) == "color (0.5, 0.25, 1), ior bk7, roughness 0, map Checker"
