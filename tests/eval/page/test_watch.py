"""Tests of a report that follows its runs: made at first, after each change, and not otherwise."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.pages import read_page
from support.synthetic import write_synthetic_dataset

from datagen.data.config import TEST_SPLITS
from datagen.data.png import png_bytes
from datagen.disk.errors import HyalineError
from eval.page.report import make_report
from eval.page.watch import EVERY_S, runs_state, watch


def test_a_watched_report_follows_its_runs_and_survives_those_that_are_not_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("eval.page.report.figures_of", lambda *_: {})
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic")
    runs, out = tmp_path / "runs", tmp_path / "runs" / "report"
    (runs / "synthetic").mkdir(parents=True)
    pauses, made = [], []

    def write(name: str, views: int) -> None:
        for split in TEST_SPLITS:
            folder = runs / "synthetic" / name / "predictions" / split
            folder.mkdir(parents=True, exist_ok=True)
            for view in range(views):
                (folder / f"{view:04d}.png").write_bytes(png_bytes(np.zeros_like(dataset.view(split, view).image)))

    def pause(seconds: float) -> None:
        pauses.append((seconds, len(made)))
        match len(pauses):
            case 1:
                write("black", views=1)  # Not complete.
            case 2:
                write("black", views=2)
            case 4:
                (runs / "synthetic" / "black" / "metrics.jsonl").write_text(json.dumps({"step": 1, "loss": 2.0}))
            case 5:
                raise KeyboardInterrupt

    def make() -> None:
        made.append(len(made))
        make_report(runs, tmp_path / "data", out, output_format="csv", refresh_s=EVERY_S)

    with pytest.raises(KeyboardInterrupt):
        watch(make, runs, out, pause=pause)
    # No run, half of one, all of it, nothing new, a training curve.
    assert pauses == [(EVERY_S, 1), (EVERY_S, 2), (EVERY_S, 3), (EVERY_S, 3), (EVERY_S, 4)]
    err = capsys.readouterr().err
    assert "error: " in err and "no predictions there" in err and "0001.png: missing" in err
    page = read_page((out / "index.html").read_bytes())
    assert "Training loss by training step" in [caption.text for caption in page.all("figcaption")]
    refresh = [
        meta.attributes["content"] for meta in page.all("meta") if meta.attributes.get("http-equiv") == "refresh"
    ]
    assert refresh == [str(EVERY_S)]

    make_report(runs, tmp_path / "data", out, output_format="csv")
    assert b'"refresh"' not in (out / "index.html").read_bytes()


def test_the_reports_own_files_are_no_change(tmp_path: Path) -> None:
    (tmp_path / "report" / "kept").mkdir(parents=True)
    before = runs_state(tmp_path, tmp_path / "report")
    (tmp_path / "report" / "kept" / "run.json").write_text("{}")
    assert runs_state(tmp_path, tmp_path / "report") == before == frozenset()


def test_a_choice_that_cannot_be_ends_a_watch_at_once(tmp_path: Path) -> None:
    from eval.cli import report

    with pytest.raises(HyalineError, match="format 'cvs': there is none of that name"):
        report(runs=tmp_path, format="cvs", watch=True)
    with pytest.raises(HyalineError, match="--watch: makes a whole report; leave out --table"):
        report(runs=tmp_path, table=("table1",), watch=True)
