"""Tests that README and the paper page state what the stored results hold."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


def load_tables() -> ModuleType:
    """docs/tables.py, which is not in a package."""
    spec = importlib.util.spec_from_file_location("docs_tables", ROOT / "docs/tables.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # Dataclasses look up their module while it is executed.
    spec.loader.exec_module(module)
    return module


tables = load_tables()


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_tables_are_those_of_the_stored_results(page: Path) -> None:
    text = page.read_text()
    assert tables.TABLE.findall(text)
    assert tables.filled(text) == text


def test_a_number_that_is_changed_by_hand_is_noticed() -> None:
    text = tables.PAGES[0].read_text()
    changed = re.sub(r"(?<=\*\*)\d\d\.\d\d", "99.99", text, count=1)
    assert changed != text and tables.filled(changed) == text


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_numbers_in_sentences_are_those_of_the_stored_results(page: Path) -> None:
    text = " ".join(page.read_text().split())
    assert [claim for claim in tables.CLAIMS[page.name]() if claim not in text] == []
