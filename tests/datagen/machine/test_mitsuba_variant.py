"""Tests the choice of variant, and what the doctor says of it: with libraries and a GPU that only pretend."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.commands import call

from datagen.machine import doctor, mitsuba_variant

SOURCE = """
void LLVMGetVersion(unsigned *major, unsigned *minor, unsigned *patch) { *major = %d; *minor = 0; *patch = 6; }
"""


def library(folder: Path, major: int) -> Path:
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler to build a library that pretends to be LLVM")
    source, path = folder / f"llvm{major}.c", folder / f"libLLVM-{major}.so.1"
    source.write_text(SOURCE % major)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", path, source], check=True)
    return path


def test_a_library_is_asked_for_its_version_in_a_child(tmp_path: Path) -> None:
    assert mitsuba_variant.probe(library(tmp_path, 16)) is None
    assert mitsuba_variant.probe(library(tmp_path, 17)) == (tmp_path / "libLLVM-17.so.1", "17.0.6")
    (tmp_path / "libLLVM-20.so").write_text("INPUT(libLLVM-20.so.1)")
    assert mitsuba_variant.probe(tmp_path / "libLLVM-20.so") is mitsuba_variant.probe(tmp_path / "missing.so") is None


def test_with_an_old_llvm_the_doctor_names_the_remedy_and_rendering_ends_with_it(tmp_path: Path) -> None:
    old = {"DRJIT_LIBLLVM_PATH": str(library(tmp_path, 15)), "CUDA_VISIBLE_DEVICES": ""}
    run = "import datagen.terminal.command as c, datagen.machine.mitsuba_variant as m; c.run('x', m.use_mitsuba, [])"
    told, ended = (
        subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, env={**os.environ, **old})
        for words in (["-m", "datagen", "doctor"], ["-c", run])
    )
    assert (told.returncode, ended.returncode) == (0, 1)
    for part in ("libLLVM-15.so.1 is no libLLVM of 17", "fix it with: unset DRJIT_LIBLLVM_PATH", "cannot render"):
        assert part in told.stdout
    assert ended.stderr == "error: Mitsuba: no libLLVM of version 17 or newer here; `unset DRJIT_LIBLLVM_PATH`\n"


def test_the_doctor_waits_briefly_for_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, program = tmp_path / "libcuda.so.1", tmp_path / "nvidia-smi"
    driver.write_bytes(b"")
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr(mitsuba_variant, "DRIVERS", (tmp_path / "missing", driver))
    monkeypatch.setattr(doctor, "LIST_LIMIT_S", 0.5)
    monkeypatch.setattr(mitsuba_variant, "_GPU_PROBE", "raise SystemExit('no OptiX here')")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    mitsuba_variant.cuda_problem.cache_clear()
    answer = call("datagen doctor")
    assert answer.status == 0
    for part in ("an NVIDIA driver, but nvidia-smi gave no answer (Command", "cannot render on it: no OptiX here"):
        assert part in answer.out
    monkeypatch.setattr(mitsuba_variant, "_GPU_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(mitsuba_variant, "PROBE_LIMIT_S", 0.5)
    assert mitsuba_variant.cuda_problem() == "the test render took more than 0.5 s"
