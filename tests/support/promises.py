"""Promises and their tests: a marker, a count of cases, and the table that a whole run writes.

A test says `@pytest.mark.promise("R4")` (of a whole file: `pytestmark = ...`) and, where it tries many cases, takes the
fixture `cases` and adds how many it has tried; else each of its parameters is one case. `pytest -m promise --full
--promises=docs/reliability.md` tries everything and writes the counts into that file.
"""

import collections
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar, cast

import pytest

Thing = TypeVar("Thing")

BEGIN, END = "<!-- counts: written by `make reliability` -->", "<!-- end of counts -->"


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("promises")
    group.addoption("--full", action="store_true", help="try every case of the promises, not a quick selection")
    group.addoption("--rewrite-outcomes", action="store_true", help="write the table of hostile files' outcomes anew")
    group.addoption("--promises", type=Path, metavar="FILE", help="write the table of counts into this file")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Counts(config), "promise-counts")


@pytest.fixture(scope="session")
def is_full(request: pytest.FixtureRequest) -> bool:
    """True when every case is to be tried, and not only a quick selection."""
    return request.config.getoption("--full")


@pytest.fixture
def cases(request: pytest.FixtureRequest) -> Iterator[Callable[[int, str], None]]:
    """Adds a number of cases that held, and what they are, to the counts of the test's promise."""
    found: collections.Counter[str] = collections.Counter()
    yield lambda number, what: found.update({what: number})
    request.node.user_properties.append(("cases", dict(found)))


def spread(things: Sequence[Thing], at_most: int) -> list[Thing]:
    """So many things, evenly spread, the first and the last among them."""
    if len(things) <= at_most:
        return list(things)
    return [things[round(index * (len(things) - 1) / (at_most - 1))] for index in range(at_most)]


class Counts:
    """How many cases of each promise were tried."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.start = time.monotonic()
        self.tried: dict[str, dict[str, collections.Counter[str]]] = {}
        """Cases by promise and by test file."""
        self.failed: collections.Counter[str] = collections.Counter()
        self.names: set[str] = set()

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        if not self.config.getoption("--full"):
            left_out = [item for item in items if item.get_closest_marker("full")]
            self.config.hook.pytest_deselected(items=left_out)
            items[:] = [item for item in items if item not in left_out]
        for item in items:
            names = [name for mark in item.iter_markers("promise") for name in mark.args]
            if names:
                # Reports carry it, also from another process (pytest-xdist), which collects for itself.
                item.user_properties.append(("promises", sorted(set(names))))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        told = dict(report.user_properties)
        for name in cast(list[str], told.get("promises", [])):
            self.names.add(name)
            if report.failed:
                self.failed[name] += 1
            elif report.when == "teardown":
                file = report.nodeid.split("::")[0]
                cases = cast(dict[str, int], told.get("cases")) or {"tests": 1}
                counts = self.tried.setdefault(name, {}).setdefault(file, collections.Counter())
                counts.update(cases)

    def pytest_sessionfinish(self) -> None:
        path: Path | None = self.config.getoption("--promises")
        if path is None or not self.tried or hasattr(self.config, "workerinput"):
            return  # Of several processes (pytest-xdist) the first one hears of all tests.
        before, _, rest = path.read_text().partition(BEGIN)
        _, _, after = rest.partition(END)
        path.write_text(f"{before}{BEGIN}\n{self.table()}\n{END}{after}")

    def table(self) -> str:
        """The counts as a table in Markdown."""
        lines = ["| promise | kept by | cases that held | tests that failed |", "|---|---|---|---:|"]
        for name in sorted(self.names, key=lambda name: int(name[1:])):
            files = self.tried.get(name, {})
            total: collections.Counter[str] = sum(files.values(), collections.Counter())
            found = ", ".join(f"{number:,} {what}" for what, number in total.most_common())
            kept_by = ", ".join(f"[{Path(file).name}](../{file})" for file in sorted(files))
            lines.append(f"| {name} | {kept_by} | {found} | {self.failed[name]} |")
        kind = "full" if self.config.getoption("--full") else "quick"
        minutes = (time.monotonic() - self.start) / 60
        return "\n".join([*lines, "", f"Counts of the {kind} run, which took {minutes:.0f} minutes."])
