"""Tests the choice of variant, and what the doctor says of it: with libraries that only pretend."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.machine import mitsuba_variant

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
