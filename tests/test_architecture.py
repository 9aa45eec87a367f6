"""Tests the shape of the code: who imports whom, where heavy packages live, how fast help answers."""

import ast
import functools
import graphlib
import subprocess
import sys
from collections.abc import Set
from pathlib import Path

import pytest
from support.soon import soon

from datagen.scene.finding import SOURCES
from datagen.terminal.plugins import COMMANDS
from eval.tables.plugins import REPORT_PARTS, TABLES
from model.methods.protocol import METHODS

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
    "pymeshlab": {"proxies/kinds/wrap.py"},
    "torch": {"model", "hyaline/tensors.py", "eval/score/metrics.py"},
    "skimage": {"eval"},
    "colour": {"eval"},
    "xatlas": {"datagen/scene/atlas.py"},
    "manifold3d": {"datagen/data/meshes.py"},
    "numcodecs": {"datagen/data/layers.py"},
    "OpenEXR": {"datagen/data/images.py"},
    "submitit": {"datagen/machine/launch.py"},
}
"""Where the core imports a heavy package."""


FLOORS = {
    "datagen": [
        *("cli", "look", "builder", "quantities", "trace", "render"),
        *("scene", "data", "machine", "pages", "terminal", "disk"),
    ],
    "proxies": ["cli", "make", "kinds", "measure", "solid"],
    "model": ["cli", "run", "methods", "batches", "nets", "runtime", "settings", "state"],
    "hyaline": ["cli", "tensors", "reports", "pictures", "runs", "datasets", "scenes", "cameras"],
    "eval": ["cli", "page", "variants", "tables", "score"],
}
"""The rooms of each package, the highest first: a file imports from its own room and from those below it."""


FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
HEAVY = {"mitsuba", "drjit", "torch", "trimesh", "pymeshlab", "scipy", "skimage", "numba"}
GROUPS = (METHODS, TABLES, COMMANDS, SOURCES, REPORT_PARTS)


@functools.cache
def parsed_files() -> dict[Path, ast.Module]:
    """The packages' files by their places; parsing them takes two seconds, which only who runs these tests waits."""
    return {
        path.relative_to(ROOT): ast.parse(path.read_text())
        for package in (*PACKAGES, LIBRARY)
        for path in sorted((ROOT / package).rglob("*.py"))
    }


def imported_by(tree: ast.Module) -> list[str]:
    """The modules that a file imports anywhere in it, also inside functions and for annotations alone."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.append(node.module)
    return names


def test_each_file_imports_only_what_its_place_allows() -> None:
    wrong = []
    for place, tree in parsed_files().items():
        names = {name.split(".")[0] for name in imported_by(tree)}
        wrong += [f"{place}: {name}" for name in (names & {*PACKAGES, LIBRARY}) - ALLOWED[place.parts[0]]]
        homeless = [name for name in names & HOMES.keys() if not {place.parts[0], place.as_posix()} & HOMES[name]]
        wrong += [f"{place}: {name} has no home here" for name in homeless]
    assert not wrong


def test_each_file_says_in_its_first_line_what_it_owns() -> None:
    assert not [str(place) for place, tree in parsed_files().items() if tree.body and not ast.get_docstring(tree)]


def test_each_file_imports_only_from_its_room_and_those_below() -> None:
    wrong = []
    for place, tree in parsed_files().items():
        package, room = place.with_suffix("").parts[:2]
        if room in ("__init__", "__main__"):
            continue
        floors = FLOORS[package]
        assert room in floors, f"{place}: a room that no floor has; the floors are {floors}"
        others = [name.split(".")[1] for name in imported_by(tree) if name.startswith(f"{package}.")]
        wrong += [f"{place}: {other} is above {room}" for other in others if floors.index(other) < floors.index(room)]
    assert not wrong


def test_the_core_imports_no_plugin() -> None:
    assert not [
        f"{place}: {name}"
        for place, tree in parsed_files().items()
        for name in imported_by(tree)
        if name.startswith("hyaline_")
    ]


def test_every_entry_of_a_table_of_plugins_is_there() -> None:
    for table in GROUPS:
        assert (ROOT / table.guide).is_file()
        assert all(table.find(name) is not None for name in table.names())
    assert len({table.name for table in GROUPS}) == len(GROUPS)


def test_no_function_is_longer_than_80_lines_and_no_file_than_400() -> None:
    lengths = {
        f"{place}::{node.name}": (node.end_lineno or 0) - node.lineno + 1
        for place, tree in parsed_files().items()
        for node in ast.walk(tree)
        if isinstance(node, FUNCTIONS)
    }
    lengths |= {str(place): len((ROOT / place).read_text().splitlines()) for place in parsed_files()}
    long = {name for name, lines in lengths.items() if lines > (80 if "::" in name else 400)}
    assert not long


def test_no_imports_go_in_a_circle_deferred_ones_included() -> None:
    modules = {
        ".".join(place.with_suffix("").parts).removesuffix(".__init__"): tree for place, tree in parsed_files().items()
    }
    waits_for = {name: modules_imported_by(tree, modules.keys()) - {name} for name, tree in modules.items()}
    order = graphlib.TopologicalSorter(waits_for)
    order.prepare()  # Raises a CycleError that names the modules of a circle.


def modules_imported_by(tree: ast.Module, modules: Set[str]) -> set[str]:
    """Which of `modules` a file imports: `from a import b` means a.b where that is one, else a."""
    found = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= names & modules or {node.module}
    return found & modules


def loaded_after(statement: str) -> set[str]:
    program = f"{statement}; import sys; print(*sys.modules)"
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(answer.stdout.split())


@pytest.mark.parametrize("module", ["data.dataset", "data.layers", "scene.description", "data.meshes"])
def test_the_contract_imports_without_heavy_packages(module: str) -> None:
    assert not loaded_after(f"import datagen.{module}") & (HEAVY | {"xatlas", "numcodecs", "manifold3d"})


@pytest.mark.parametrize("program", [*PACKAGES, LIBRARY])
def test_help_answers_at_once_and_every_command_has_it(program: str) -> None:
    assert not loaded_after(f"import {program}.cli") & (HEAVY | {"matplotlib"})
    with soon():  # About half a second.
        answer = subprocess.run([sys.executable, "-m", program, "--help"], capture_output=True, text=True, check=True)
    assert program in answer.stdout or "report" in answer.stdout
