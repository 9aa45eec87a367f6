"""Tests RESULTS.md: it is what the command writes from stored results, seeds become means, other files are refused."""

import json
import runpy
from pathlib import Path
from typing import Any

import pytest
from support.commands import call

from datagen.disk.errors import HyalineError
from eval.tables.grids import MISSING

ROOT = Path(__file__).resolve().parents[2]
results_page = runpy.run_path(str(ROOT / "docs/results.py"), run_name="results")["results_page"]
KEYS = ("psnr_db", "glass_psnr_db", "ssim", "delta_e")


def run(name: str, psnr_db: float, *, seed: int = 0) -> dict[str, Any]:
    scores = {key: {"mean": psnr_db, "pictures": [psnr_db]} for key in KEYS}
    return {
        "run": name,
        "knowledge": "true | geometry",
        "num_parameters": 1234,
        "seed": seed,
        "drop_db": None,
        "splits": {"interpolating": scores, "extrapolating": None},
    }


def results(**change: Any) -> dict[str, Any]:
    angles = {"extrapolating-10deg": {key: {"mean": 20.0, "pictures": [20.0]} for key in KEYS}}
    scene = {
        "scene": "glass_table",
        "dataset_seal": "0123456789abcdef",
        "preset": "tiny",
        "resolution": {"width": 16, "height": 16},
        "noise_ceiling_db": {"interpolating": "inf", "extrapolating": 40.0},
        "runs": [run("worse", 29.0), run("mine", 30.0), run("mine-seed1", 32.0, seed=1)],
        "seeds": [{"runs": ["mine", "mine-seed1"]}],
        "analyses": {
            "variants": {"angles": {"noise_ceiling_db": {"extrapolating-10deg": 45.0}, "runs": {"mine": angles}}},
        },
    }
    made_by = {"command": "make demo", "code": "0.1.0 (abc)"}
    return {"version": 1, "notes": ["As stored.", "Wrapped."], "made_by": made_by, "scenes": [scene], **change}


def write(folder: Path, name: str, content: dict[str, Any]) -> Path:
    path = folder / name
    path.write_text(json.dumps(content))
    return path


def test_the_pages_of_results_are_what_the_commands_write(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    folders = sorted(path for path in Path("docs/results").iterdir() if path.is_dir())
    assert sorted(Path("docs/results").glob("*.md")) == [folder.with_suffix(".md") for folder in folders]
    for folder in folders:
        is_bench = folder.name == "bench"
        page = call(f"hyaline-bench leaderboard {folder}").out if is_bench else results_page(folder)
        assert folder.with_suffix(".md").read_text() == page, "write it with `make results`"
        assert f"({folder.with_suffix('.md').as_posix()}" in Path("RESULTS.md").read_text()


def test_seeds_are_a_mean_with_its_deviation_and_the_best_run_comes_first(tmp_path: Path) -> None:
    lines = results_page(write(tmp_path, "demo.json", results())).splitlines()
    assert lines[:5] == ["# demo", "", "```", "make demo", "```"]
    assert lines[6] == "[demo.json](demo.json); hyaline 0.1.0 (abc)."
    assert "As stored." in lines and "Wrapped." not in lines
    first = lines.index("### glass_table: 16 x 16 pixels, 1 views of each test split") + 4
    table = [line.replace(MISSING, "none") for line in lines[first:]]
    mean = "31.00 ± 1.41"
    assert table[0].startswith(f"| mine | true \\| geometry | 1,234 | 2 | **{mean}** | none | **{mean}** | none |")
    assert table[0].endswith("| none |")
    assert table[1].startswith("| worse | true \\| geometry | 1,234 | 1 | 29.00 | none | 29.00 |")
    assert table[1].endswith("| **29.00** | none | none |"), "of colour differences the least is best"
    assert table[2].startswith("| noise ceiling |  |  |  | ∞ | 40.00 |")
    angles = lines[lines.index("### glass_table: variant angles") + 4 :]
    assert angles[:2] == [
        "| mine | 1 | 20.00 | 20.00 |",
        "| noise ceiling |  | 45.00 |  |",
    ]


@pytest.mark.parametrize("content", [results(version=2), results(scenes=[{"scene": "x"}]), {"version": 1}])
def test_a_file_of_another_kind_is_refused(content: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(HyalineError, match=r"demo.json: (format version 2|lacks 'runs'|lacks 'scenes')"):
        results_page(write(tmp_path, "demo.json", content))
