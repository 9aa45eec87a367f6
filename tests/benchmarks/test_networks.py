"""Tests of the benchmarks of `model`, tiny: that they compare equal things. Nothing here looks at a time."""

import json

import numpy as np
import pytest
import torch

from benchmarks.choices import BenchChoices
from benchmarks.harness import show
from benchmarks.naive import COVERED, made_up_frame
from benchmarks.step import bench_gpu, bench_infer, bench_step

TINY = {"pixels": 512, "resolution": 24, "objects": 3, "layers": 4, "texture_size": 16, "rounds": 3}


@pytest.mark.parametrize("precision", ["fp32", pytest.param("bf16", marks=pytest.mark.full)])
def test_the_naive_baseline_computes_what_the_product_does(precision) -> None:
    choices = BenchChoices(**TINY, precision=precision)
    for report in (bench_step(choices), bench_infer(choices)):
        assert report.checks and all(check.passed for check in report.checks), report.checks


def test_the_bench_of_a_gpu_says_why_it_is_skipped(capsys: pytest.CaptureFixture[str]) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    show(bench_gpu(BenchChoices(**TINY)), as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["facts"] == {"skipped": "torch finds no CUDA device here"} and printed["passed"]


def test_made_up_layers_are_as_full_and_as_coherent_as_real_ones() -> None:
    choices = BenchChoices(resolution=128)
    frame = made_up_frame(choices, rng=np.random.default_rng(0))
    found = frame.object_id != 0
    assert abs(found.float().mean().item() - COVERED) < 0.08
    assert not (found[:, 1:] & ~found[:, :-1]).any()  # Empty places only after the last surface.
    uv = frame.take(torch.arange(len(frame.rgb)), None).uv.view(128, 128, -1, 2)
    object_id = frame.object_id.view(128, 128, -1)
    same = (object_id[:, 1:] == object_id[:, :-1]) & (object_id[:, 1:] != 0)
    steps = (uv[:, 1:] - uv[:, :-1]).abs().amax(dim=-1)[same]
    assert steps.median() < 0.02
