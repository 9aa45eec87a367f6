"""Tests the choice of libLLVM and variant, with libraries that only pretend."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.machine import llvm

SOURCE = """
void LLVMGetVersion(unsigned *major, unsigned *minor, unsigned *patch) { *major = %d; *minor = 0; *patch = 6; }
"""


def pretend(folder: Path, major: int) -> Path:
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler to build a library that pretends to be LLVM")
    source, library = folder / f"llvm{major}.c", folder / f"libLLVM-{major}.so.1"
    source.write_text(SOURCE % major)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], check=True)
    return library


@pytest.mark.parametrize(("major", "works"), [(16, False), (17, True)])
def test_a_library_is_asked_for_its_version_in_a_child(tmp_path: Path, major: int, works: bool) -> None:
    library = pretend(tmp_path, major)
    assert llvm.probe(library) == ((library, f"{major}.0.6") if works else None)


def test_what_is_no_library_is_no_library(tmp_path: Path) -> None:
    (tmp_path / "libLLVM-20.so").write_text("INPUT(libLLVM-20.so.1)")
    assert llvm.probe(tmp_path / "libLLVM-20.so") is None
    assert llvm.probe(tmp_path / "missing.so") is None


def doctor(**environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "datagen", "doctor"]
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **environment})


def test_with_an_old_llvm_the_doctor_names_the_remedy_and_rendering_ends_with_it(tmp_path: Path) -> None:
    old = {"DRJIT_LIBLLVM_PATH": str(pretend(tmp_path, 15)), "CUDA_VISIBLE_DEVICES": ""}
    answer = doctor(**old)
    assert answer.returncode == 0
    assert "libLLVM-15.so.1 is no libLLVM of 17 or newer\n" in answer.stdout
    assert "fix it with: unset DRJIT_LIBLLVM_PATH" in answer.stdout
    assert "cannot render without a libLLVM" in answer.stdout
    code = "import datagen.terminal.command as c, datagen.machine.mitsuba_variant as m; c.run('x', m.use_mitsuba, [])"
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **old})
    assert ended.returncode == 1
    assert ended.stderr == "error: Mitsuba: no libLLVM of version 17 or newer here; `unset DRJIT_LIBLLVM_PATH`\n"
