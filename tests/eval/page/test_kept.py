"""Tests of what a report keeps: nothing is computed twice, and nothing that is out of date is ever shown."""

import itertools
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import write_synthetic_dataset

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import open_dataset
from datagen.data.images import png_bytes
from datagen.disk.errors import HyalineError
from datagen.disk.storage import load_sealed
from eval.analyses.curve import curve_from_json, curve_json, curve_of
from eval.page.report import make_report
from eval.score import kept as kept_module
from eval.score.kept import Kept, number_from_json, number_json


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, two runs, and their report."""
    root = tmp_path_factory.mktemp("kept")
    dataset = write_synthetic_dataset(root / "data" / "synthetic")
    for name, step in (("near", 2), ("far", 30)):
        for split in TEST_SPLITS:
            folder = root / "runs" / "synthetic" / name / "predictions" / split
            folder.mkdir(parents=True)
            for view in dataset.views(split):
                # One view of one run is perfect: its PSNR is infinite.
                step_here = 0 if (name, view.index) == ("near", 1) else step
                (folder / f"{view.index:04d}.png").write_bytes(
                    png_bytes(view.image - np.minimum(view.image, step_here))
                )
    report(root)
    return root


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path


def report(root: Path) -> None:
    make_report(root / "runs", root / "data", root / "runs" / "report", output_format="json")


def files_of(root: Path) -> dict[str, tuple[bytes, int]]:
    """Content and time of every file of a report."""
    out = root / "runs" / "report"
    paths = [path for path in out.rglob("*") if path.is_file()]
    return {path.relative_to(out).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}


def contents(root: Path) -> dict[str, bytes]:
    return {name: content for name, (content, _) in files_of(root).items()}


def refuse(what: str) -> Callable[..., object]:
    def refusal(*_args: object, **_more: object) -> object:
        raise AssertionError(f"{what} again")

    return refusal


def test_a_second_report_computes_and_writes_nothing(
    copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_of(copy)
    for place, what in (
        ("eval.score.scores.score_picture", "scored"),
        ("eval.page.further.read_coverage", "read what training saw"),
        ("eval.figures.draw_sheet", "drew a sheet"),
        ("eval.page.page.document", "made a page"),
        ("datagen.data.dataset.decode_png", "decoded a picture"),
    ):
        monkeypatch.setattr(place, refuse(what))
    report(copy)
    assert files_of(copy) == before
    out, err = capsys.readouterr()
    assert out.encode() == before["results.json"][0]
    assert "wrote" not in err


def test_one_new_picture_changes_what_it_concerns_alone(copy: Path) -> None:
    before = contents(copy)
    path = copy / "runs/synthetic/far/predictions/extrapolating/0000.png"
    path.write_bytes(png_bytes(np.zeros((32, 32, 3), np.uint8)))
    report(copy)
    after = contents(copy)
    changed = {name for name in before if after.get(name) != before[name] and not name.startswith("kept/")}
    figures = {"comparison_synthetic.png", "curve_synthetic.svg", "synthetic_far.png"}
    assert changed == {"index.html", "results.json", *figures}
    # Of a run's scores by split and of the curves, one each are new; what nobody asks for is not there any more.
    gone, new = {name for name in before if name not in after}, {name for name in after if name not in before}
    assert len(gone) == len(new) == 2

    shutil.rmtree(copy / "runs" / "report")
    report(copy)
    assert contents(copy) == after


def test_what_was_damaged_is_computed_again(copy: Path) -> None:
    before = contents(copy)
    damages = itertools.cycle([b"", b"{}", b'{"result": null, "sha256": "0"}'])
    for path, damage in zip((copy / "runs" / "report" / "kept").iterdir(), damages):
        path.write_bytes(damage)
    (copy / "runs" / "report" / "synthetic_far.png").write_bytes(b"another picture")
    (copy / "runs" / "report" / "index.html").unlink()
    report(copy)
    assert contents(copy) == before


def test_other_code_asks_for_other_results(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(copy)
    monkeypatch.setattr(kept_module, "code_digest", lambda: "other code")
    report(copy)
    after = contents(copy)
    assert after["results.json"] == before["results.json"]
    kept = [
        {name for name in files if name.startswith("kept/") and name != "kept/drawn.json"} for files in (before, after)
    ]
    assert len(kept[0]) == len(kept[1]) and not kept[0] & kept[1]


def test_a_damaged_truth_is_still_found(copy: Path) -> None:
    path = open_dataset(copy / "data" / "synthetic").root / "images" / "extrapolating" / "0001.png"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(HyalineError, match=r"extrapolating/0001\.png: damaged"):
        report(copy)


def test_nothing_is_kept_through_a_link(copy: Path, tmp_path: Path) -> None:
    folder = copy / "runs" / "report" / "kept"
    shutil.rmtree(folder)
    (tmp_path / "elsewhere").mkdir()
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(HyalineError, match="is a symbolic link, and hyaline does not write through links"):
        report(copy)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_result_is_computed_once_and_found_again(tmp_path: Path) -> None:
    kept = Kept()
    assert (
        kept.get("kind", [1], lambda: [1.5, "inf"]) == kept.get("kind", [1], lambda: refuse("computed")) == [1.5, "inf"]
    )
    assert kept.get("kind", [2], lambda: None) is None and kept.get("other", [1], lambda: 3) == 3
    assert len(kept.new) == len(kept.used) == 3
    assert {load["kind"] for load in kept.new.values()} == {"kind", "other"}


def test_numbers_and_curves_come_back_as_they_were() -> None:
    for value in (None, 0.1, 30, math.inf):
        assert number_from_json(number_json(value)) == value
    with pytest.raises(HyalineError, match="is 'nan'; expected a number"):
        number_from_json("nan")
    generator = np.random.default_rng(0)
    angle = generator.uniform(0, 50, 5000)
    angle[:300] = np.inf
    curve = curve_of(angle, generator.integers(1, 40, 5000), generator.uniform(0, 90, 5000))
    assert curve.unseen is not None and curve.db_per_10deg is not None
    assert curve_from_json(curve_json(curve)) == curve


def test_every_kept_file_is_sealed_and_says_what_it_is(made: Path) -> None:
    paths = [path for path in (made / "runs" / "report" / "kept").iterdir() if path.name != "drawn.json"]
    kinds = sorted(str(load_sealed(path)["kind"]) for path in paths)
    assert kinds == ["curve"] * 2 + ["scores"] * 4
