"""Promises and their tests: `@pytest.mark.promise("R4")` (of a whole file: `pytestmark = ...`), and how much is tried.

`pytest -m "promise or full" --full` tries everything.
"""

from collections.abc import Sequence
from typing import TypeVar

import pytest

Thing = TypeVar("Thing")


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("promises")
    group.addoption("--full", action="store_true", help="try every case of the promises, not a quick selection")


@pytest.fixture(scope="session")
def is_full(request: pytest.FixtureRequest) -> bool:
    """True when every case is to be tried, and not only a quick selection."""
    return request.config.getoption("--full")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--full"):
        left_out = [item for item in items if item.get_closest_marker("full")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def spread(things: Sequence[Thing], at_most: int) -> list[Thing]:
    """So many things, evenly spread, the first and the last among them."""
    if len(things) <= at_most:
        return list(things)
    return [things[round(index * (len(things) - 1) / (at_most - 1))] for index in range(at_most)]
