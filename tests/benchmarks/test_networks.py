"""Tests of the benchmarks of `model`, tiny: that they compare equal things. Nothing here looks at a time."""

import pytest

from benchmarks.choices import BenchChoices
from benchmarks.step import bench_infer, bench_step

TINY = {"pixels": 512, "resolution": 24, "objects": 3, "layers": 4, "texture_size": 16, "rounds": 3}


@pytest.mark.parametrize("precision", ["fp32", pytest.param("bf16", marks=pytest.mark.full)])
def test_the_naive_baseline_computes_what_the_product_does(precision) -> None:
    choices = BenchChoices(**TINY, precision=precision)
    for report in (bench_step(choices), bench_infer(choices)):
        assert report.checks and all(check.passed for check in report.checks), report.checks
