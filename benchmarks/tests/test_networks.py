"""Tests of the benchmarks of `model`, tiny: that they compare equal things. Nothing here looks at a time."""

import pytest
import torch
from support.pretend_cuda import pretended_cuda

from benchmarks.choices import BenchChoices
from benchmarks.step import bench_step
from datagen.machine.mitsuba_variant import use_mitsuba

TINY = {"pixels": 512, "resolution": 24, "objects": 3, "layers": 4, "texture_size": 16, "rounds": 3}


@pytest.mark.full
def test_the_naive_baseline_computes_what_the_product_does() -> None:
    report = bench_step(BenchChoices(**TINY))
    assert report.checks and all(check.passed for check in report.checks), report.checks


@pytest.mark.full
def test_the_benchmark_of_gpus_runs_on_a_pretended_one(monkeypatch: pytest.MonkeyPatch) -> None:
    use_mitsuba()
    from benchmarks import gpu

    monkeypatch.setattr(gpu, "SIZE", 16)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "pretended")
    monkeypatch.setattr(gpu, "UPDATE", 32)
    try:
        torch.backends.cudnn.allow_tf32 = True
        with pretended_cuda():
            report = gpu.bench_gpu(BenchChoices(**TINY), frame=64, step=64)
        assert not (torch.backends.cudnn.allow_tf32 or torch.backends.cuda.matmul.allow_tf32)
    finally:
        torch.backends.cudnn.allow_tf32 = True  # As by default.
    assert all(check.passed for check in report.checks), report.checks
    assert [timing.name for timing in report.timings[4:]] == [
        "truth", "light paths", "light-path update", "light-path frame",
    ]  # fmt: skip
    paths, unit = str(report.facts["truth"]).split()
    assert unit == "paths/s" and float(paths) == pytest.approx(16 * 16 * 16 / report.timings[4].wall.median, rel=0.01)
