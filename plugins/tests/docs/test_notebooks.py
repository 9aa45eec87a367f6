"""Tests that the notebooks of `examples/` run from top to bottom, and are stored without what they printed."""

import ast
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.commands import run
from support.synthetic import write_synthetic_dataset

import hyaline
from datagen.data.images import read_png

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))


@pytest.fixture
def examples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder in which Jupyter would start them, beside the data of a small dataset."""
    write_synthetic_dataset(tmp_path / "data" / "one")
    run("datagen peel data/one --num-layers 4 --overwrite")
    (tmp_path / "examples").mkdir()
    monkeypatch.chdir(tmp_path / "examples")
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES.parent))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield tmp_path / "examples"
    torch.set_num_threads(threads)


def code_of(name: str) -> list[str]:
    """The cells of code of a notebook."""
    cells = json.loads((EXAMPLES / name).read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def run_notebook(name: str) -> tuple[dict[str, Any], list[object]]:
    """What a notebook's names are bound to at its end, and what each cell would show below itself."""
    names: dict[str, Any] = {}
    shown = []
    for number, source in enumerate(code_of(name), start=1):
        where = f"{name}, cell {number}"
        body = ast.parse(source, filename=where).body
        last = body.pop() if isinstance(body[-1], ast.Expr) else None
        exec(compile(ast.Module(body, []), where, "exec"), names)
        shown.append(eval(compile(ast.Expression(last.value), where, "eval"), names) if last is not None else None)
    return names, shown


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_is_stored_without_outputs_and_numbers_of_runs(path: Path) -> None:
    notebook = json.loads(path.read_text())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None and cell["metadata"] == {} for cell in code)
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])


def test_looking_at_a_dataset_shows_views_layers_and_scores_below_the_ceiling(
    examples: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names, shown = run_notebook("look_at_a_dataset.ipynb")
    said = capsys.readouterr().out
    assert "objects: pane (glass), floor" in said and "pane after " in said and "floor after " in said
    assert [picture is not None for picture in shown] == [False, True, True, False, True]
    assert 5 < names["psnr_db"] < names["ceiling_db"]
    restored = names["srgb"](names["view"].radiance)
    assert np.abs(restored.astype(int) - names["view"].image).max() <= 1


def test_a_run_trained_in_a_notebook_is_rendered_from_anywhere(examples: Path) -> None:
    names, _ = run_notebook("train_and_render.ipynb")
    drawn = read_png(examples.parent / "runs" / "one" / "notebook" / "predictions" / "interpolating" / "0000.png")
    assert np.array_equal(names["picture"], drawn)
    mean = np.mean([view.image for view in names["dataset"].views("train")], axis=0).astype(np.uint8)
    assert names["scores"].psnr_db > hyaline.score(mean, names["view"].image).psnr_db + 3  # It has learned.
    assert [frame.shape for frame in names["frames"]] == [(32, 32, 3)] * 4


@pytest.mark.full
def test_a_random_scene_is_built_trained_on_and_reported_in_a_few_cells(examples: Path) -> None:
    names, shown = run_notebook("randomise_a_scene.ipynb")
    assert len(code_of("randomise_a_scene.ipynb")) == 5 and all(item is not None for item in shown)
    assert names["dataset"].num_views == {"train": 12, "interpolating": 2, "extrapolating": 2}
    again, other = (names["random_scene"](seed).objects[1].material for seed in (3, 4))
    assert again == names["scene"].objects[1].material != other
    assert names["picture"].shape == (32, 32, 3) and names["report"].page.is_file()
    assert float(names["report"].rows[0]["psnr_db_interpolating"]) > 10
