"""Tests that no command runs code that lies in the folder where it is called, or in a scene's."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.scenarios import BUILD, TRAIN
from support.synthetic import synthetic_scene

from datagen.scene.folder import save_scene

MODULES = (
    *(
        "numpy",
        "torch",
        "mitsuba",
        "drjit",
        "numcodecs",
        "PIL",
        "scipy",
        "trimesh",
        "matplotlib",
        "tyro",
        "rich",
        "numba",
    ),
    *("skimage", "colour", "pymeshlab", "xatlas", "datagen", "model", "proxies", "eval", "sitecustomize", "json"),
)
PLUGINS = (
    *("sphere", "ply", "mesh", "diffuse", "dielectric", "thindielectric", "path", "box", "multijitter", "independent"),
    *("envmap", "hdrfilm", "perspective", "bitmap"),
)
"""Mitsuba looks for plugins in the working folder first, unless told otherwise; to load one runs its constructor."""

CONSTRUCTOR = """
#include <stdio.h>
__attribute__((constructor)) static void run(void) { FILE *file = fopen("MARK-PLUGIN", "a"); if (file) fclose(file); }
"""


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """A working folder with a scene, where importing or loading anything leaves a mark."""
    save_scene(synthetic_scene(), tmp_path / "scene")
    for name in MODULES:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / f'MARK-{name}')!r}, 'w')\nraise SystemExit(9)\n")
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is not None:
        (tmp_path / "plugin.c").write_text(CONSTRUCTOR)
        subprocess.run([compiler, "-shared", "-fPIC", "-o", tmp_path / "plugin.so", tmp_path / "plugin.c"], check=True)
        for folder in (tmp_path / "plugins", tmp_path / "scene" / "plugins"):
            folder.mkdir()
            for name in PLUGINS:
                shutil.copy(tmp_path / "plugin.so", folder / f"{name}.so")
    return tmp_path


@pytest.mark.promise("R7")
@pytest.mark.parametrize(
    "line",
    [
        f"{BUILD} --workers 2",
        f"{TRAIN} --out runs/one/paper",
        pytest.param("proxies make --kind box", marks=pytest.mark.full),
        pytest.param("model sweep grid.txt", marks=pytest.mark.full),
        pytest.param("report", marks=pytest.mark.full),
    ],
    ids=lambda line: " ".join(line.split()[:2]),
)
def test_no_command_runs_code_of_the_folder_where_it_is_called(line: str, trap: Path, done: dict[str, Path]) -> None:
    for name in ("data", "runs"):
        if "before" in done and (done["before"] / name).is_dir():
            shutil.copytree(done["before"] / name, trap / name)
    (trap / "grid.txt").write_text(
        "model train paper data/one --steps 1 --batch 32 --texture-size 8 --hidden 8 --device cpu\n"
    )
    script, *words = line.split()
    answer = subprocess.run(
        [str(Path(sys.executable).parent / script), *words], cwd=trap, capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stderr
    assert not list(trap.glob("MARK-*"))
    done["before"] = trap


@pytest.fixture(scope="module")
def done() -> dict[str, Path]:
    """Where the command before left what the next one needs."""
    return {}
