"""Tests the choice of libLLVM and variant, with libraries that only pretend."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.machine import llvm, mitsuba_variant

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


@pytest.mark.parametrize(("major", "works"), [(14, False), (15, False), (16, False), (17, True), (23, True)])
def test_a_library_is_asked_for_its_version_in_a_child(tmp_path: Path, major: int, works: bool) -> None:
    found = llvm.probe(pretend(tmp_path, major), source="system")
    assert found is not None
    assert found.version == (major, 0, 6)
    assert found.works is works


def test_the_newest_library_that_works_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for major in (15, 19, 18):
        pretend(tmp_path, major)
    monkeypatch.setattr(llvm, "SYSTEM_PATTERNS", ((str(tmp_path), "libLLVM*.so*"),))
    found = llvm.system_llvm()
    assert found is not None
    assert found.version[0] == 19
    (tmp_path / "libLLVM-19.so.1").unlink()
    (tmp_path / "libLLVM-18.so.1").unlink()
    assert llvm.system_llvm() is None


def test_what_is_no_library_is_no_library(tmp_path: Path) -> None:
    (tmp_path / "libLLVM-20.so").write_text("INPUT(libLLVM-20.so.1)")
    assert llvm.probe(tmp_path / "libLLVM-20.so", source="system") is None
    assert llvm.probe(tmp_path / "missing.so", source="system") is None


def doctor(**environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "datagen", "doctor"]
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **environment})


def test_an_old_llvm_means_the_scalar_variant_and_a_remedy(tmp_path: Path) -> None:
    answer = doctor(DRJIT_LIBLLVM_PATH=str(pretend(tmp_path, 15)), CUDA_VISIBLE_DEVICES="")
    assert answer.returncode == 0
    assert "variant scalar_rgb" in answer.stdout
    assert "libLLVM-15.so.1 is no libLLVM of 17 or newer\n" in answer.stdout
    assert "fix it with: unset DRJIT_LIBLLVM_PATH" in answer.stdout


def test_the_scalar_variant_builds_a_dataset_of_the_same_scene(tmp_path: Path) -> None:
    from support.builds import command
    from support.synthetic import synthetic_scene

    from datagen.data.config import SPLITS
    from datagen.data.dataset import open_dataset
    from datagen.scene.folder import save_scene

    save_scene(synthetic_scene(), tmp_path / "scene")
    roots = {}
    for variant in ("scalar_rgb", ""):
        roots[variant] = tmp_path / f"data_{variant}"
        environment = {**os.environ, "HYALINE_VARIANT": variant}
        line = command(tmp_path / "scene", roots[variant], "--views", "1", "--test-views", "1")
        answer = subprocess.run(line, capture_output=True, text=True, check=True, env=environment)
        assert ("many times slower" in answer.stderr) == (variant == "scalar_rgb" or "scalar_rgb" in answer.stderr)
    slow, fast = (open_dataset(root) for root in roots.values())
    assert slow.view("train", 0).record.variant == "scalar_rgb"
    for split in SPLITS:
        one, other = (dataset.view(split, 0).layers() for dataset in (slow, fast))
        assert (one.object_id != other.object_id).mean() < 0.005
        difference = slow.view(split, 0).image.astype(int) - fast.view(split, 0).image
        assert abs(difference.mean()) < 3


def test_a_variant_that_this_machine_lacks_is_one_line(tmp_path: Path) -> None:
    environment = {**os.environ, "HYALINE_VARIANT": "cuda_ad_rgb", "DRJIT_LIBCUDA_PATH": str(tmp_path / "missing.so")}
    code = "import datagen.terminal.command as c, datagen.machine.mitsuba_variant as m; c.run('x', m.use_mitsuba, [])"
    command = [sys.executable, "-c", code]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert answer.returncode == 1
    assert answer.stderr.splitlines()[-1].startswith("error: Mitsuba cannot run as cuda_ad_rgb here (jit_init")
    described = doctor(**environment).stdout
    assert "variant cuda_ad_rgb: set by HYALINE_VARIANT, but it cannot render: " in described


def test_without_a_home_directory_kernels_are_not_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("HOME", "XDG_CACHE_HOME", "DRJIT_CACHE_DIR"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setattr(os, "getuid", lambda: 12345)  # Whom no machine knows.
    mitsuba_variant._keep_kernels_private()
    assert "no home directory; set HOME or XDG_CACHE_HOME; Dr.Jit compiles its kernels" in capsys.readouterr().err
    assert os.environ["DRJIT_CACHE_DIR"] == os.devnull


def test_an_unknown_variant_is_one_line() -> None:
    answer = doctor(HYALINE_VARIANT="gpu")
    assert answer.returncode == 1
    assert answer.stderr == (
        "error: HYALINE_VARIANT=gpu: no such variant; expected one of cuda_ad_rgb, llvm_ad_rgb, scalar_rgb\n"
    )
