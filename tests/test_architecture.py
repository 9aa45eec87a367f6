"""Tests the shape of the code: who imports whom, where heavy packages live, how fast help answers."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.soon import soon

ROOT = Path(__file__).parent.parent
PACKAGES = ("datagen", "proxies", "model", "eval")
LIBRARY = "hyaline"
"""What people import: it may import all four, and none of them imports it."""
ALLOWED = {
    "datagen": {"datagen"},
    "proxies": {"proxies", "datagen"},
    "model": {"model", "datagen"},
    "eval": {"eval", "datagen"},
    "hyaline": {"hyaline", "datagen", "proxies", "model", "eval"},
}
HOMES = {
    "mitsuba": {"datagen"},
    "drjit": {"datagen"},
    "pymeshlab": {"proxies/meshing/meshlab.py", "datagen/scene/importers/surfaces.py"},
    "torch": {"model", "hyaline/tensors.py"},
    "skimage": {"eval"},
    "colour": {"eval"},
    "xatlas": {"datagen/scene/atlas.py"},
    "manifold3d": {"datagen/scene/cutouts.py", "datagen/scene/importers/overlaps.py", "datagen/scene/mending.py"},
    "zarr": {"datagen/data/layer_writing.py"},
    "OpenEXR": {"datagen/data/exr.py"},
    "submitit": {"datagen/build/launch.py"},
    "viser": {"model/view/server.py", "model/view/stage.py", "model/view/panel.py", "model/view/view.py"},
}


FLOORS = {
    "datagen": (
        "cli",
        "look",
        "export",
        "import_dataset",
        "build",
        "quantities",
        "trace",
        "render",
        "scene",
        "data",
        "machine",
        "pages",
        "terminal",
        "disk",
    ),
    "proxies": ("cli", "make", "spec", "kinds", "meshing"),
    "model": ("cli", "view", "web", "run", "methods", "losses", "batches", "nets", "settings"),
    "hyaline": ("tensors", "runs", "scores", "cameras", "datasets"),
    "eval": ("cli", "page", "papers", "analyses", "figures", "tables", "score"),
}
"""The rooms of each package, the highest first: a file imports from its own room and from those below it."""


def imports_of(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
TOO_LONG: set[str] = set()
"""What is still to be split: longer than a function's 80 lines, or a file's 400."""
FILES = [path for package in (*PACKAGES, LIBRARY) for path in sorted((ROOT / package).rglob("*.py"))]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_each_file_imports_only_what_its_place_allows(path: Path) -> None:
    place = path.relative_to(ROOT)
    names = imports_of(path)
    assert names & {*PACKAGES, LIBRARY} <= ALLOWED[place.parts[0]]
    for package, homes in HOMES.items():
        if package in names:
            assert place.parts[0] in homes or place.as_posix() in homes, f"{package} has no home here"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_each_file_says_in_its_first_line_what_it_owns(path: Path) -> None:
    if path.name != "__init__.py" or path.read_text().strip():
        assert ast.get_docstring(ast.parse(path.read_text()))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_each_file_imports_only_from_its_room_and_those_below(path: Path) -> None:
    package, *rest = path.relative_to(ROOT).with_suffix("").parts
    if rest[0] in ("__init__", "__main__"):
        return
    floors = FLOORS[package]
    assert rest[0] in floors, f"a room that no floor has; the floors are {floors}"
    for node in ast.walk(ast.parse(path.read_text())):
        modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for other in (module.split(".")[1] for module in modules if module.startswith(f"{package}.")):
            assert floors.index(other) >= floors.index(rest[0]), f"{rest[0]} imports {other}, a room above it"


def functions_of(path: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, FUNCTIONS)]


def test_no_function_is_longer_than_80_lines_and_no_file_than_400() -> None:
    lengths = {
        f"{path.relative_to(ROOT)}::{node.name}": (node.end_lineno or 0) - node.lineno + 1
        for path in FILES
        for node in functions_of(path)
    }
    lengths |= {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in FILES}
    long = {name for name, lines in lengths.items() if lines > (80 if "::" in name else 400)}
    assert long <= TOO_LONG


def test_the_formatter_is_told_to_look_away_in_few_places() -> None:
    folders = (*PACKAGES, LIBRARY, "benchmarks", "docs", "examples", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    found = [line for path in files for line in path.read_text().splitlines() if re.search(r"# fmt: (off|skip)$", line)]
    assert len(found) < 40


def modules_imported_by(path: Path, modules: set[str]) -> set[str]:
    """Which of `modules` a file imports anywhere in it, also inside functions and for annotations alone."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= names & modules or {node.module}
    return found & modules


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_no_imports_go_in_a_circle_deferred_ones_included() -> None:
    files = {module_name(path): path for path in FILES}
    waits_for = {name: modules_imported_by(path, set(files)) - {name} for name, path in files.items()}
    order = graphlib.TopologicalSorter(waits_for)
    order.prepare()  # Raises a CycleError that names the modules of a circle.


def loaded_after(statement: str) -> set[str]:
    program = f"{statement}; import sys; print(*sys.modules)"
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(answer.stdout.split())


@pytest.mark.parametrize(
    "module",
    [
        "datagen.data.dataset",
        "datagen.data.layers",
        "datagen.scene.description",
        "datagen.data.meshes",
    ],
)
def test_the_contract_imports_without_heavy_packages(module: str) -> None:
    heavy = {"mitsuba", "drjit", "torch", "trimesh", "pymeshlab", "xatlas", "zarr", "scipy", "skimage", "numba"}
    heavy |= {"manifold3d"}
    assert not loaded_after(f"import {module}") & heavy


@pytest.mark.parametrize("program", PACKAGES)
def test_help_answers_at_once_and_every_command_has_it(program: str) -> None:
    heavy = {"mitsuba", "drjit", "torch", "trimesh", "pymeshlab", "scipy", "matplotlib", "skimage", "numba"}
    assert not loaded_after(f"import {program}.cli") & heavy
    with soon():  # About half a second.
        answer = subprocess.run([sys.executable, "-m", program, "--help"], capture_output=True, text=True, check=True)
    assert program in answer.stdout or "report" in answer.stdout
