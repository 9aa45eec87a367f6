"""Tests that the scripts of `examples/` bring pictures and scores of other programs beside ours, by stand-ins."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.commands import call
from support.traced_dataset import write_traced_dataset

from datagen.data.dataset import open_dataset
from datagen.data.images import png_bytes

RADIANCE_FIELD = Path(__file__).resolve().parents[3] / "examples" / "radiance_field.py"

NERFSTUDIO = """#!{python}
import json, shutil, sys
from pathlib import Path
_, _, _, _, program, *words = sys.argv
get = lambda flag: words[words.index(flag) + 1]
if "nerfstudio.scripts.train" in program:
    run = Path(get("--output-dir"), get("--experiment-name"), words[0], get("--timestamp"))
    run.mkdir(parents=True)
    (run / "config.yml").write_text(json.dumps(dict(data=get("--data"), words=words)))
else:
    data = Path(json.loads(Path(get("--load-config")).read_text())["data"])
    for name in json.loads((data / "transforms.json").read_text())["test_filenames"]:
        place = Path(get("--output-path"), get("--split"), "rgb", Path(name).name)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(data / name, place)
"""
"""The Python of an environment whose nerfstudio draws every test view as it is."""


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment with that Python; the current folder is one with the dataset `glasses`."""
    programs = tmp_path / "environment" / "bin"
    programs.mkdir(parents=True)
    for name in ("python", "ns-train"):
        (programs / name).write_text(NERFSTUDIO.format(python=sys.executable))
        (programs / name).chmod(0o755)
    write_traced_dataset(tmp_path / "data" / "glasses", resolution=16)
    monkeypatch.chdir(tmp_path)
    return programs.parent


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, RADIANCE_FIELD, *map(str, words)], capture_output=True, text=True)


def test_what_it_draws_is_scored_against_the_same_views(environment: Path) -> None:
    answer = run("glasses", "--environment", environment, "--seed-of-ns-train", 3)
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout == "runs/glasses/nerfacto\n"
    again = run("glasses", "--environment", environment)
    assert again.returncode == 1 and "runs/glasses/nerfacto: exists" in again.stderr
    words = json.loads(Path("exports/glasses-nerfacto/nerfacto/run/config.yml").read_text())["words"]
    assert words[-2:] == ["--seed-of-ns-train", "3"] and "1500" in words
    assert call("report").status == 0
    (scene,) = json.loads(Path("runs/report/results.json").read_text())["scenes"]
    (scored,) = scene["runs"]
    assert (scored["method"], scored["geometry"]) == ("nerfacto", "none") and scored["cpu_seconds"] > 0
    for split in ("interpolating", "extrapolating"):
        assert scored["splits"][split]["psnr_db"]["pictures"] == ["inf", "inf"]


def test_views_by_angle_are_drawn_beside_the_others(environment: Path) -> None:
    angles = Path("data/glasses/variants/angles")
    frame = json.loads(Path("data/glasses/transforms_test.json").read_text())["frames"][0]
    (angles / "images" / "extrapolating-10deg").mkdir(parents=True)
    picture = angles / "images" / "extrapolating-10deg" / "0000.png"
    picture.write_bytes(b"as it is")
    (angles / "transforms_extrapolating-10deg.json").write_text(json.dumps({"frames": [frame]}))
    answer = run("glasses", "--environment", environment)
    assert answer.returncode == 0, answer.stderr
    drawn = Path("runs/glasses/nerfacto/variants/angles/predictions/extrapolating-10deg/0000.png")
    assert drawn.read_bytes() == picture.read_bytes()
    told = json.loads(Path("exports/glasses-nerfstudio/transforms.json").read_text())
    assert told["frames"][-1]["transform_matrix"] == frame["transform_matrix"]
    assert not any("depth_file_path" in each for each in told["frames"])


SECOND_OPINION = Path(__file__).resolve().parents[3] / "examples" / "second_opinion.py"

NERFBASELINES = """
import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

def psnr(a, b):
    return peak_signal_noise_ratio(a, b, data_range=1) {wrong}

def ssim(a, b):
    inner = structural_similarity(
        a, b, data_range=1, channel_axis=-1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
    )[1][5:-5, 5:-5]
    return inner.mean()

def convert_image_dtype(image, kind):
    return image.astype(kind) / 255
"""
"""Modules of nerfbaselines, by scikit-image."""


@pytest.fixture
def scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run with noisy pictures, and its report; the current folder has the dataset `glasses`."""
    root = write_traced_dataset(tmp_path / "data" / "glasses", resolution=16).root
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for split in ("interpolating", "extrapolating"):
        for index, view in enumerate(open_dataset(root).views(split)):
            noisy = np.clip(view.image + rng.normal(scale=9, size=view.image.shape), 0, 255).astype(np.uint8)
            place = tmp_path / f"runs/glasses/noisy/predictions/{split}/{index:04d}.png"
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(png_bytes(noisy))
    (tmp_path / "runs/glasses/noisy/run.json").write_text(
        json.dumps({"method": "noisy", "geometry": "none", "knowledge": "the truth", "config": {}})
    )
    assert call("report").status == 0
    return tmp_path


def ask(folder: Path, wrong: str = "") -> subprocess.CompletedProcess[str]:
    """The script's answer, with an environment whose nerfbaselines is the stand-in."""
    package, programs = folder / "packages" / "nerfbaselines", folder / "environment" / "bin"
    for path in (package, programs):
        path.mkdir(parents=True, exist_ok=True)
    (package / "__init__.py").touch()
    for name in ("metrics", "utils"):
        (package / f"{name}.py").write_text(NERFBASELINES.format(wrong=wrong))
    python = f'#!/bin/sh\nPYTHONPATH="{package.parent}" exec "{sys.executable}" "$@"\n'
    for name, content in (("python", python), ("nerfbaselines", "")):
        (programs / name).write_text(content)
        (programs / name).chmod(0o755)
    words = [sys.executable, str(SECOND_OPINION), "glasses", "--environment", str(programs.parent)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


def test_equal_scores_are_printed_side_by_side_and_a_difference_is_an_error(scored: Path) -> None:
    answer = ask(scored)
    assert answer.returncode == 0, answer.stderr
    rows = [line.strip("| ").split(" | ") for line in answer.stdout.splitlines()[2:]]
    assert [row[:2] for row in rows] == [["noisy", "interpolating"], ["noisy", "extrapolating"]]
    assert all(row[2] == row[3] and row[4] == row[5] and 20 < float(row[2]) < 40 for row in rows)
    answer = ask(scored, wrong="+ 0.001")
    assert (answer.returncode, answer.stderr) == (1, "2 scores differ\n")
