"""Tests of the report's page: whole, alone, readable without scripts, and small whatever it has to show."""

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.pages import ReadPage, read_page
from support.synthetic import write_synthetic_dataset

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import open_dataset
from datagen.data.images import png_bytes
from datagen.disk.errors import HyalineError
from eval.page.page import report_page
from eval.page.report import make_report
from eval.page.run_page import describe_costs, flattened, ranked_views, read_training, training_charts
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


def write_page(root: Path, out: Path, monkeypatch: pytest.MonkeyPatch, **how) -> bytes:
    monkeypatch.setattr("eval.page.report.figures_of", lambda *_: {})
    make_report(root / "runs", root / "data", out, output_format="csv", **how)
    return (out / "index.html").read_bytes()


@pytest.fixture(scope="module")
def page(root: Path, tmp_path_factory: pytest.TempPathFactory) -> ReadPage:
    with pytest.MonkeyPatch.context() as patch:
        return read_page(write_page(root, tmp_path_factory.mktemp("out"), patch))


def test_names_from_files_are_shown_and_never_run(page: ReadPage) -> None:
    assert len(page.all("script")) == len(page.all("style")) == 1
    assert all((picture.attributes["src"] or "").startswith("data:image/svg+xml;") for picture in page.all("img"))
    assert HOSTILE in "".join(element.text for element in page.all("dd"))
    assert any(HOSTILE.replace("/", "|") in heading.text for heading in page.all("h2"))


def test_the_tables_stand_in_the_markup_with_the_best_values_marked(page: ReadPage) -> None:
    first = page.all("table")[0]
    assert first.attributes["class"] == "sortable"
    assert "plain" in first.text and "noise ceiling" in first.text
    assert all(head.attributes.get("scope") in ("col", "row") for head in page.all("th"))
    best = [cell for cell in page.all("td") if "best" in (cell.attributes.get("class") or "").split()]
    assert best and all(math.isfinite(float(cell.text)) for cell in best)


def test_every_run_has_its_pictures_its_training_and_a_way_to_make_it_again(page: ReadPage) -> None:
    captions = [caption.text for caption in page.all("figcaption")]
    for split in TEST_SPLITS:
        assert any(f"{split} view 0001 (worst)" in caption for caption in captions)
        assert any(f"{split} view 0000 (best)" in caption for caption in captions)
    assert {"PSNR on held-out views by training step", "Training loss by training step"} <= set(captions)
    assert "A part of metrics.jsonl cannot be read." in [paragraph.text for paragraph in page.all("p")]
    assert any("model train" in code.text and "--seed 3" in code.text for code in page.all("code"))
    assert "net.width" in [term.text for term in page.all("dt")]
    assert not any(
        "views; `eval report --shown-views" in paragraph.text for paragraph in page.all("p")
    )  # All are shown.
    pictures = [svg for svg in page.all("svg") if "picture" in (svg.attributes.get("class") or "")]
    assert pictures and all(svg.attributes["aria-label"] and svg.attributes["role"] == "img" for svg in pictures)
    assert "PSNR by the angle to the nearest training ray" in captions


def test_the_page_shows_no_key_and_no_backtick(page: ReadPage) -> None:
    (main,) = page.all("main")
    assert "`" not in main.text and "held_out" not in main.text


def test_held_out_scores_are_told_from_those_of_test_views(page: ReadPage, root: Path) -> None:
    ceiling = open_dataset(root / "data" / "synthetic").noise_ceiling_db("train")
    (note,) = (paragraph.text for paragraph in page.all("p") if paragraph.text.startswith("Held-out views"))
    assert "training views that are not trained on" in note and "do not compare with the scores on test views" in note
    assert f"their noise alone stops a perfect method at {ceiling:.1f} dB" in note
    unknown = str(training_charts(read_training(root / "runs" / "synthetic" / "plain")))
    assert "noisier than test views." in unknown


def test_the_navigation_lists_runs_below_their_scene(page: ReadPage) -> None:
    (nav,) = re.findall(r"<nav.*?</nav>", page.source)
    overview, scene = re.findall(r"<li><a [^>]*>(.*?)</a>(<ul>.*?</ul>)?</li>", nav.replace("<ul>", "<ul>", 1))[:2]
    assert overview == ("Overview", "")
    assert scene[0] == "synthetic" and scene[1].count("<li>") == 2 and ">plain</a>" in scene[1]


def test_a_run_that_tells_its_flags_is_made_again_by_them_alone(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(root, tmp_path / "copy")
    path = tmp_path / "copy" / "runs" / "synthetic" / "plain" / "run.json"
    record = json.loads(path.read_text()) | {"method": "paper", "flags": {"steps": "9", "seed": "3", "zero-layer": ""}}
    path.write_text(json.dumps(record))
    codes = [code.text for code in read_page(write_page(tmp_path / "copy", tmp_path / "out", monkeypatch)).all("code")]
    assert "model train paper data/synthetic --steps 9 --seed 3 --zero-layer" in codes
    foreign = {key: value for key, value in record.items() if key != "flags"}
    path.write_text(json.dumps(foreign))
    written = read_page(write_page(tmp_path / "copy", tmp_path / "out", monkeypatch))
    assert not any("model train paper data" in code.text for code in written.all("code"))
    assert any("does not record the command" in paragraph.text for paragraph in written.all("p"))
    path.write_text(json.dumps(record | {"flags": ["--steps"]}))
    with pytest.raises(HyalineError, match=r"run\.json: flags: is \['--steps'\]; expected an object"):
        write_page(tmp_path / "copy", tmp_path / "out", monkeypatch)


def test_the_same_runs_give_the_same_page(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages = [write_page(root, tmp_path / name, monkeypatch, most_views=1) for name in ("a", "b")]
    assert pages[0] == pages[1]
    assert str(root).encode() not in pages[0]


def test_a_page_is_no_larger_than_it_may_be_and_says_how_many_pictures_found_no_room(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = len(write_page(root, tmp_path / "whole", monkeypatch, most_views=100)) - 8_000
    monkeypatch.setattr("eval.page.report.report_page", lambda *a, **k: report_page(*a, **k | {"most_bytes": most}))
    data = write_page(root, tmp_path / "small", monkeypatch, most_views=100)
    assert most - 8_000 < len(data) <= most
    page = read_page(data)
    addresses = [image.attributes["href"] or "" for image in page.all("image")]
    assert addresses
    assert any("pictures were left out" in paragraph.text for paragraph in page.all("p"))


def test_a_number_of_views_that_cannot_be_is_refused(root: Path, tmp_path: Path) -> None:
    with pytest.raises(HyalineError, match=r"--shown-views: is 0; expected 1 to 10,000 of each split and run"):
        make_report(root / "runs", root / "data", tmp_path, output_format="csv", most_views=0)


def test_the_worst_the_median_and_the_best_view_come_first() -> None:
    values = (30.0, 10.0, math.inf, 20.0, 25.0, 40.0)
    ranked = ranked_views(SplitScores(images={"psnr_db": values}))
    assert [(view.view, view.rank) for view in ranked] == [
        (1, "worst"),
        (4, "median"),
        (2, "best"),
        (3, ""),
        (0, ""),
        (5, ""),
    ]
    assert [view.rank for view in ranked_views(SplitScores(images={"psnr_db": (5.0,)}))] == ["worst"]


def test_training_curves_are_thinned_and_other_lines_passed_over(tmp_path: Path) -> None:
    lines = [json.dumps({"step": step, "loss": 0.5, "note": "text"}) for step in range(1000)]
    (tmp_path / "metrics.jsonl").write_text("\n".join([*lines, '{"loss": 1}']))
    training = read_training(tmp_path)
    assert list(training.curves) == ["loss"] and not training.is_damaged
    assert len(training.curves["loss"]) == 334
    shutil.rmtree(tmp_path)
    assert read_training(tmp_path).curves == {}


def test_the_page_of_a_run_says_what_training_took(tmp_path: Path) -> None:
    assert "processor time" not in str(training_charts(read_training(tmp_path)))
    path = tmp_path / "costs.json"
    path.write_text('{"seconds": 75.4, "cpu_seconds": 8000, "peak_memory_bytes": 1234567890, "colour": "red"}')
    training = read_training(tmp_path)
    assert describe_costs(training) == [
        ("time", "1 min 15 s"),
        ("processor time", "2 h 13 min"),
        ("memory, at most", "1,235 MB"),
    ]
    assert "1,235 MB" in str(training_charts(training))
    path.write_text('{"seconds": 76}')
    assert describe_costs(read_training(tmp_path)) == [("time", "1 min 16 s")]
    for damaged in ("{", "[1]", '{"seconds": -1}', '{"seconds": NaN}', '{"seconds": true}'):
        path.write_text(damaged)
        assert describe_costs(read_training(tmp_path)) == []


def test_parameters_are_named_by_their_path() -> None:
    config = {"type": "T", "net": {"type": "N", "sizes": [1, 2], "name": "x"}, "lr": 0.1}
    assert flattened(config) == [("net.sizes", "[1, 2]"), ("net.name", "x"), ("lr", "0.1")]
