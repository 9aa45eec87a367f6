"""Tests of the report's page: whole, alone, readable without scripts, and small whatever it has to show."""

import json
import math
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from support.pages import ReadPage, read_page
from support.synthetic import write_synthetic_dataset

from datagen.data.config import TEST_SPLITS
from datagen.data.images import png_bytes
from eval.page.page import ranked_views
from eval.page.report import make_report
from eval.score.scores import SplitScores

HOSTILE = '"><img src=x onerror=alert(1)><script>alert(2)</script>'


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, a run with a record and training curves, and one whose folder and record are hostile."""
    root = tmp_path_factory.mktemp("page")
    dataset = write_synthetic_dataset(root / "data" / "synthetic")
    for name, step in (("plain", 8), (HOSTILE.replace("/", "|"), 40)):
        run = root / "runs" / "synthetic" / name
        for split in TEST_SPLITS:
            (run / "predictions" / split).mkdir(parents=True)
            for view in dataset.views(split):
                darker = view.image - np.minimum(view.image, step * (1 + view.index))
                (run / "predictions" / split / f"{view.index:04d}.png").write_bytes(png_bytes(darker))
        record = {"method": f"paper{HOSTILE}", "label": HOSTILE, "knowledge": HOSTILE, "flags": {"seed": "3"}}
        (run / "run.json").write_text(json.dumps(record | {"config": {HOSTILE: HOSTILE, "net": {"width": 64}}}))
    metrics = [{"step": step, "loss": 1 / step, "held_out_psnr": 20.0 + step} for step in (1, 2, 3)]
    text = "".join(f"{json.dumps(line)}\n" for line in metrics)
    (root / "runs" / "synthetic" / "plain" / "metrics.jsonl").write_text(text + '{"step": 4, "lo')
    return root


def write_page(root: Path, out: Path) -> bytes:
    make_report(root / "runs", root / "data", out, output_format="json")
    return (out / "index.html").read_bytes()


@pytest.fixture(scope="module")
def page(root: Path, tmp_path_factory: pytest.TempPathFactory) -> ReadPage:
    return read_page(write_page(root, tmp_path_factory.mktemp("out")))


def test_names_from_files_are_shown_and_never_run(page: ReadPage) -> None:
    assert len(page.all("script")) == len(page.all("style")) == 1
    assert all((picture.attributes["src"] or "").startswith("data:image/svg+xml;") for picture in page.all("img"))
    assert HOSTILE in "".join(element.text for element in page.all("dd"))
    assert any(HOSTILE.replace("/", "|") in heading.text for heading in page.all("h1"))


def test_every_run_has_its_pictures_its_training_and_a_way_to_make_it_again(page: ReadPage) -> None:
    captions = [caption.text for caption in page.all("figcaption")]
    for split in TEST_SPLITS:
        assert any(f"{split} view 0001 (worst)" in caption for caption in captions)
        assert any(f"{split} view 0000 (best)" in caption for caption in captions)
    assert {"PSNR on held-out views by training step", "Training loss by training step"} <= set(captions)
    assert any(paragraph.text.startswith("Held-out views are training views") for paragraph in page.all("p"))
    assert any("model train" in code.text and "--seed 3" in code.text for code in page.all("code"))
    assert any('"width": 64' in text.text for text in page.all("pre"))
    pictures = [svg for svg in page.all("svg") if "picture" in (svg.attributes.get("class") or "")]
    assert pictures and all(svg.attributes["aria-label"] and svg.attributes["role"] == "img" for svg in pictures)


def test_the_same_runs_give_the_same_page(root: Path, tmp_path: Path) -> None:
    pages = [write_page(root, tmp_path / name) for name in ("a", "b")]
    assert pages[0] == pages[1]
    assert str(root).encode() not in pages[0]


def test_an_exported_scene_is_linked_from_where_the_page_lies(root: Path, tmp_path: Path) -> None:
    run = next(path for path in (root / "runs" / "synthetic").iterdir() if path.name != "plain")
    (run / "scene.html").touch()
    page = read_page(write_page(root, tmp_path / "out"))
    links = {link.attributes["href"] or "" for link in page.all("a")}
    (scene,) = (tmp_path / "out" / unquote(link) for link in links if not link.startswith("#"))
    assert scene.samefile(run / "scene.html")
    (run / "scene.html").unlink()


def test_the_worst_the_median_and_the_best_view_are_shown() -> None:
    values = (30.0, 10.0, math.inf, 20.0, 25.0, 40.0)
    ranked = ranked_views(SplitScores(images={"psnr_db": values}))
    assert ranked == {1: "worst", 4: "median", 2: "best"}
    assert ranked_views(SplitScores(images={"psnr_db": (5.0,)})) == {0: "worst"}
