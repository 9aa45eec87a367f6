"""Tests what all plug-ins keep to: who imports whom, and that pyproject.toml names each of their parts."""

import ast
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from datagen.terminal.plugins import Group
from hyaline_export.formats import FORMATS
from hyaline_import.datasets.import_dataset import READERS as DATASET_READERS
from hyaline_import.source import READERS
from hyaline_random.names import FAMILIES

PLUGINS = Path(__file__).parents[1]
NEEDS = {"hyaline_photos": {"hyaline_import"}, "hyaline_bench": {"hyaline_export", "hyaline_random"}}
"""The plug-ins that a plug-in imports beside the core."""
POINTS = tomllib.loads((PLUGINS.parent / "pyproject.toml").read_text())["project"]["entry-points"]


def test_each_plugin_imports_the_core_and_only_those_plugins_it_needs() -> None:
    wrong = []
    for folder in sorted(PLUGINS.glob("hyaline_*")):
        for path in sorted(folder.rglob("*.py")):
            if "tests" in path.parts:
                continue
            nodes = list(ast.walk(ast.parse(path.read_text())))
            names = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
            names |= {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
            tops = {name.partition(".")[0] for name in names if name.startswith("hyaline_")}
            wrong += [f"{path}: {top}" for top in tops - {folder.name} - NEEDS.get(folder.name, set())]
    assert not wrong


@pytest.mark.parametrize(("group", "name"), [(group, name) for group in POINTS for name in POINTS[group]])
def test_each_entry_point_is_installed_and_loads(group: str, name: str) -> None:
    (point,) = metadata.entry_points(group=group, name=name)
    assert point.value == POINTS[group][name]
    assert point.load() is not None


@pytest.mark.parametrize("group", [FORMATS, DATASET_READERS, READERS, FAMILIES], ids=lambda group: group.name)
def test_each_built_in_part_of_a_group_loads(group: Group[object]) -> None:
    assert (PLUGINS.parent / group.guide).is_file()
    assert all(group.find(name) is not None for name in group.built_in)
