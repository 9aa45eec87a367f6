"""Tests that `examples/second_opinion.py` sets scores of `report` beside those of other code, and finds differences."""

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

SCRIPT = Path(__file__).resolve().parents[3] / "examples" / "second_opinion.py"

STAND_IN = """
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
        path.mkdir(parents=True)
    (package / "__init__.py").touch()
    for name in ("metrics", "utils"):
        (package / f"{name}.py").write_text(STAND_IN.format(wrong=wrong))
    python = f'#!/bin/sh\nPYTHONPATH="{package.parent}" exec "{sys.executable}" "$@"\n'
    for name, content in (("python", python), ("nerfbaselines", "")):
        (programs / name).write_text(content)
        (programs / name).chmod(0o755)
    words = [sys.executable, str(SCRIPT), "glasses", "--environment", str(programs.parent)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


def test_equal_scores_are_printed_side_by_side(scored: Path) -> None:
    answer = ask(scored)
    assert answer.returncode == 0, answer.stderr
    rows = [line.strip("| ").split(" | ") for line in answer.stdout.splitlines()[2:]]
    assert [row[:2] for row in rows] == [["noisy", "interpolating"], ["noisy", "extrapolating"]]
    assert all(row[2] == row[3] and row[4] == row[5] and 20 < float(row[2]) < 40 for row in rows)


def test_a_difference_beyond_single_precision_is_an_error(scored: Path) -> None:
    answer = ask(scored, wrong="+ 0.001")
    assert (answer.returncode, answer.stderr) == (1, "2 scores differ\n")
