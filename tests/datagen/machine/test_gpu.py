"""Tests what is said of a GPU, on machines that only pretend to have one."""

import os
from pathlib import Path

import pytest
from support.commands import call

from datagen.machine import hardware


@pytest.fixture(autouse=True)
def pretend(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A driver, as WSL has it, and a cache that is empty."""
    driver = tmp_path / "libcuda.so.1"
    driver.write_bytes(b"")
    monkeypatch.setattr(hardware, "DRIVERS", (tmp_path / "missing", driver))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    hardware.cuda_problem.cache_clear()


def nvidia_smi(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program = folder / "bin/nvidia-smi"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("exec sleep 60", "an NVIDIA driver, but nvidia-smi gave no answer (Command"),
        ("echo 'NVIDIA H200, 570.1'", "NVIDIA H200, 570.1"),
        ("exit 9", "none"),
    ],
)
def test_doctor_waits_briefly_for_nvidia_smi(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, said: str
) -> None:
    nvidia_smi(tmp_path, script, monkeypatch)
    monkeypatch.setattr(hardware, "LIST_LIMIT_S", 0.5)
    monkeypatch.setattr(hardware, "_PROBE", "raise SystemExit('no OptiX here')")
    answer = call("datagen doctor")
    assert answer.status == 0
    assert f"GPU        {said}" in answer.out and "; Mitsuba cannot render on it: no OptiX here" in answer.out


def test_a_probe_that_hangs_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hardware, "_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(hardware, "PROBE_LIMIT_S", 0.5)
    assert hardware.cuda_problem() == "the test render took more than 0.5 s"
