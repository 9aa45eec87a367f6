"""The report end to end: folders of pictures in, tables, data and contact sheets out."""

import dataclasses
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import run
from support.synthetic import write_predictions, write_synthetic_dataset

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import open_dataset
from datagen.data.images import png_bytes
from datagen.disk.errors import HyalineError
from datagen.machine.doctor import code_version
from eval.page.report import make_report
from eval.score.runs import Record
from eval.tables.grids import Column, Grid, grid_text
from model.run.run_folder import RunRecord


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data/synthetic and three runs: perfect ones, grey ones, and a foreign method's folder."""
    root = tmp_path_factory.mktemp("report")
    dataset = write_synthetic_dataset(root / "data" / "synthetic")
    about = {
        "method": "ours",
        "geometry": "truth",
        "knowledge": "true geometry",
        "dataset": (root / "data" / "synthetic").as_posix(),
        "dataset_seal": dataset.seal,
        "seed": 3,
        "num_parameters": 33267,
        "label": "tiny",
        "num_texture_parameters": 1,
    }
    for name, change in {"perfect": lambda image: image, "grey": lambda image: np.full_like(image, 128)}.items():
        write_predictions(dataset, root / "runs" / "synthetic" / name, change)
        (root / "runs" / "synthetic" / name / "run.json").write_text(json.dumps(about))
    write_predictions(dataset, root / "runs" / "synthetic" / "foreign_nerf", darken, splits=["interpolating"])
    (root / "runs" / "synthetic" / "unfinished").mkdir()
    return root


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """The same, to be broken; its runs know no dataset folder but its own."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    for path in tmp_path.rglob("run.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"dataset": "nowhere"}))
    return tmp_path


def darken(image: np.ndarray) -> np.ndarray:
    return image - np.minimum(image, 3)


def report(root: Path, output_format: str = "json") -> None:
    make_report(root / "runs", root / "data", root / "out", output_format=output_format)


def runs_of(text: str) -> dict[str, dict[str, Any]]:
    (scene,) = json.loads(text)["scenes"]
    return {run["run"]: run for run in scene["runs"]}


def mean(run: dict[str, Any], key: str, split: str) -> float:
    return float(run["splits"][split][key]["mean"])


# What the report says


def test_json_on_stdout_is_the_file_and_holds_the_scores_of_every_picture(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_report(made / "runs", made / "data", tmp_path, output_format="json")
    text, err = capsys.readouterr()
    assert (tmp_path / "results.json").read_text() == text
    assert str(made) not in text  # No path of this machine.
    assert "unfinished: no predictions yet; skipped" in err
    results, runs = json.loads(text), runs_of(text)
    assert results["made_by"] == {"command": "report", "code": code_version()}
    assert results["scenes"][0]["preset"] == "tiny"
    assert results["scenes"][0]["noise_ceiling_db"]["interpolating"] == pytest.approx(49.009)
    assert list(runs) == ["perfect", "foreign_nerf", "grey"]

    perfect, grey, foreign = runs["perfect"], runs["grey"], runs["foreign_nerf"]
    assert perfect["splits"]["interpolating"]["psnr_db"] == {"mean": "inf", "pictures": ["inf", "inf"]}
    assert mean(perfect, "ssim", "extrapolating") == pytest.approx(1)
    assert (perfect["drop_db"], perfect["method"], perfect["num_parameters"], perfect["seed"]) == (
        *(None, "ours"),
        *(33267, 3),
    )
    assert mean(foreign, "psnr_db", "interpolating") == pytest.approx(20 * math.log10(255 / 3), abs=0.1)
    assert foreign["method"] is None and foreign["splits"]["extrapolating"] is None
    assert re.fullmatch("[0-9a-f]{64}", grey["predictions_sha256"])
    assert len({run["predictions_sha256"] for run in runs.values()}) == 3

    dataset = open_dataset(made / "data" / "synthetic")
    for split in TEST_SPLITS:
        truths = [dataset.view(split, view).image for view in range(2)]
        masks = [view.mask("glass") for view in dataset.views(split)[:2]]
        errors = [(truth.astype(float) - 128) ** 2 for truth in truths]
        whole = [10 * math.log10(255**2 / error.mean()) for error in errors]
        glass = [10 * math.log10(255**2 / error[mask].mean()) for error, mask in zip(errors, masks, strict=True)]
        assert mean(grey, "psnr_db", split) == pytest.approx(np.mean(whole), abs=1e-9)
        assert mean(grey, "glass_psnr_db", split) == pytest.approx(np.mean(glass), abs=1e-9)
    drop = mean(grey, "psnr_db", "interpolating") - mean(grey, "psnr_db", "extrapolating")
    assert grey["drop_db"] == pytest.approx(drop)


@pytest.mark.parametrize("output_format", ["table", "markdown"])
def test_every_format_has_all_cells_and_marks_the_best(
    output_format: str, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_report(made / "runs", made / "data", tmp_path, output_format=output_format)
    text = capsys.readouterr().out
    assert "has no predictions for the extrapolating split." in text and "wrapped" not in text
    lines = text.splitlines()
    if output_format == "table":
        assert max(map(len, lines)) <= 120
        (ceiling,) = [line.split() for line in lines if line.split()[:1] == ["noise"]]
        assert ceiling[2:4] == ["49.01", "49.01"]
        rows = {line.split()[0]: line for line in lines if line.split()[:1] in (["perfect"], ["grey"])}
        best = "∞*"
    else:
        (table,) = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
        assert len({line.count("|") for line in table.splitlines()}) == 1 and "PSNR dB ↑, interpolating" in table
        rows = {line.split()[1]: line for line in table.splitlines()}
        best = "**∞**"
    assert best in rows["perfect"] and best not in rows["grey"]
    assert list(rows).index("perfect") < list(rows).index("grey")


def test_a_narrow_terminal_gets_the_first_columns_and_is_told_of_the_others() -> None:
    columns = (Column(group="run", is_number=False), *(Column(group=f"score{place}") for place in range(9)))
    grid = Grid(title="a table", columns=columns, rows=(("paper", *["12.34"] * 9),))
    text = grid_text(grid, "table", width=60)
    assert max(map(len, text.splitlines())) <= 60 and "score5" in text and "score6" not in text
    assert "3 columns left out: the terminal is 60 wide." in text
    assert "score8" in grid_text(grid, "table", width=120)


def test_without_layers_the_glass_column_is_empty(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(copy / "data" / "synthetic" / "layers")
    report(copy)
    out, err = capsys.readouterr()
    assert runs_of(out)["grey"]["splits"]["interpolating"]["glass_psnr_db"]["mean"] is None
    assert "has no layers of the true geometry, so there is no PSNR on glass" in err


# Names in it


EVIL = "a\x1b[2J\x1b]0;owned\x07\r\nerror: \u202eforged | <b> \\ [x](y) `z` & $1$"


@pytest.mark.parametrize("look", ["table", "markdown"])
def test_a_name_in_a_table_neither_ends_its_line_nor_its_cell(look: str) -> None:
    grid = Grid(
        title=EVIL,
        columns=(Column(group="run", is_number=False), Column(group="n")),
        rows=((EVIL, "1"),),
        notes=(EVIL,),
    )
    plain = Grid(title="t", columns=grid.columns, rows=(("a", "1"),), notes=("n",))
    text = grid_text(grid, look, width=400)
    assert all(line.isprintable() for line in text.splitlines())
    assert len(text.splitlines()) == len(grid_text(plain, look, width=400).splitlines())
    if look == "markdown":
        row = next(line for line in text.splitlines() if line.startswith("| a"))
        assert row.replace(r"\|", "").count("|") == 3 and "<b>" not in row and "[x]" not in row


# What the report refuses


@pytest.mark.parametrize(
    ("name", "picture", "message"),
    [
        ("0001.png", None, r"grey/predictions/interpolating/0001\.png: missing; expected 0000\.png to"),
        ("0002.png", (32, 32, 3), r"0002\.png: not a view of the split"),
        ("0000.png", (32, 31, 3), r"0000\.png: is 31 x 32 pixels; expected 32 x 32"),
    ],
)
def test_pictures_that_are_not_those_of_the_split_are_named(
    copy: Path, name: str, picture: tuple[int, ...] | None, message: str
) -> None:
    path = copy / "runs/synthetic/grey/predictions/interpolating" / name
    path.unlink(missing_ok=True)
    if picture is not None:
        path.write_bytes(png_bytes(np.zeros(picture, np.uint8)))
    with pytest.raises(HyalineError, match=message):
        report(copy)


def test_predictions_for_other_data_are_refused_but_the_others_are_scored(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = copy / "runs/synthetic/grey/run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"dataset_seal": "f" * 64}))
    with pytest.raises(HyalineError, match=r"synthetic/grey: the predictions are for other data"):
        report(copy)
    assert set(runs_of(capsys.readouterr().out)) == {"perfect", "foreign_nerf"}


def test_linked_runs_belong_to_the_folder_that_links_them_and_unknown_variants_are_named(copy: Path) -> None:
    runs = copy / "runs" / "synthetic"
    shutil.move(runs, copy / "elsewhere")
    runs.symlink_to(copy / "elsewhere")
    (runs / "grey/variants/x4/predictions").mkdir(parents=True)
    with pytest.raises(HyalineError, match=r"^[^\n]*grey/variants/x4: the dataset has no such variant; it has none$"):
        report(copy)


def test_only_the_runs_of_the_chosen_dataset_are_scored(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (copy / "runs" / "other" / "lost" / "predictions" / "interpolating").mkdir(parents=True)
    moved = copy / "elsewhere" / "synthetic"
    shutil.move(copy / "data", copy / "elsewhere")
    make_report(copy / "runs", copy / "data", copy / "out", output_format="json", only=moved)
    assert list(runs_of(capsys.readouterr().out)) == ["perfect", "foreign_nerf", "grey"]
    run(f"report '{copy}/runs' --dataset '{moved}'")
    assert (copy / "runs/report-synthetic/index.html").is_file() and not (copy / "runs/report").exists()
    with pytest.raises(HyalineError, match=r"^.*other/lost: no dataset at .*elsewhere/other"):
        make_report(copy / "runs", copy / "elsewhere", copy / "out", output_format="json")
    capsys.readouterr()
    renamed = moved.rename(moved.with_name("renamed"))
    make_report(copy / "runs", copy / "data", copy / "out", output_format="json", only=renamed)
    assert list(runs_of(capsys.readouterr().out)) == ["perfect", "grey"]


def test_the_report_knows_every_key_that_training_writes() -> None:
    assert {item.name for item in dataclasses.fields(RunRecord)} == {item.name for item in dataclasses.fields(Record)}


def test_runs_of_one_name_are_told_apart(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(copy / "runs" / "synthetic" / "grey", copy / "runs" / "again" / "perfect")
    record = copy / "runs" / "again" / "perfect" / "run.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"dataset": str(copy / "data" / "synthetic")}))
    report(copy)
    rows = runs_of(capsys.readouterr().out)
    assert list(rows) == ["synthetic/perfect", "foreign_nerf", "again/perfect", "grey"]
    assert rows["again/perfect"]["splits"] == rows["grey"]["splits"]
    assert mean(rows["synthetic/perfect"], "psnr_db", "interpolating") == math.inf


# The command


def test_typed_in_bash_it_prints_only_the_table_on_stdout(made: Path) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    line = f"eval report --data {made}/data --runs {made}/runs --out out --json"
    done = subprocess.run(["bash", "-c", line], env=os.environ | {"PATH": path}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert set(runs_of(done.stdout)) == {"foreign_nerf", "grey", "perfect"}
    assert "wrote out/results.json" in done.stderr
