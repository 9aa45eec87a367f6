"""Tests what `pip wheel` and a source distribution hold: every file of the packages, and all that the tests need."""

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("hyaline", "datagen", "proxies", "model", "eval")
BESIDE = ("plugins", "tests", "benchmarks", "examples", "docs", ".ci")
"""What a checkout has beside them that tests need."""
BUILD = "from hatchling import build as b; print(b.build_sdist('.'), b.build_wheel('.'))"


def files_of(folder: Path, *names: str) -> set[str]:
    """Every file below, by path relative to the folder, but caches and what a build leaves."""
    found = (path for name in names for path in (folder / name).rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix() for path in found if "__pycache__" not in path.parts}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout, with a wheel and a source distribution in it."""
    place = tmp_path_factory.mktemp("built") / "checkout"
    place.mkdir()
    for name in (*PACKAGES, *BESIDE):
        shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, place)
    subprocess.run([sys.executable, "-c", BUILD], cwd=place, check=True, capture_output=True)
    return place


def test_the_wheel_has_every_file_of_the_packages_and_nothing_else(built: Path) -> None:
    (wheel,) = built.glob("hyaline_glass-*.whl")
    with zipfile.ZipFile(wheel) as file:
        names = {name for name in file.namelist() if ".dist-info/" not in name}
    plugins = files_of(ROOT / "plugins", *(path.name for path in (ROOT / "plugins").glob("hyaline_*")))
    assert names == files_of(ROOT, *PACKAGES) | {name for name in plugins if name.split("/")[1] != "tests"}


def test_the_source_distribution_has_the_tests_and_what_they_need(built: Path) -> None:
    (sdist,) = built.glob("hyaline_glass-*.tar.gz")
    with tarfile.open(sdist) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    needed = files_of(ROOT, *PACKAGES, *BESIDE) | {path.name for path in ROOT.glob("*.md")}
    needed |= {"Makefile", "constraints.txt", "pyproject.toml", "mkdocs.yml"}
    assert needed - names == set()
