"""When tests in a browser run: wherever there is one, and always where they are demanded."""

import os
from collections.abc import Sequence
from importlib import resources
from typing import TYPE_CHECKING

import pytest

from benchmarks.browser import Watched, find_browser
from datagen.disk.errors import HyalineError

if TYPE_CHECKING:
    from playwright.sync_api import Page


def require_browser() -> None:
    """Skips the test where there is no Chromium; fails it where tests in a browser are demanded, as CI does."""
    try:
        find_browser()
    except HyalineError as error:
        if os.environ.get("HYALINE_DEMAND_BROWSER"):
            pytest.fail(str(error))
        pytest.skip(str(error))


def wait_until(page: "Page", script: str) -> None:
    """Waits until an asynchronous script says true; `page.wait_for_function` takes its promise for true at once."""
    for _ in range(1000):
        if page.evaluate(script):
            return
        page.wait_for_timeout(20)
    pytest.fail(f"did not come true: {script}")


def check_accessible(watched: Watched, besides: Sequence[str] = ()) -> None:
    """axe-core's rules hold, besides some: contrast, names, roles, focus and others."""
    axe = pytest.importorskip("axe_playwright_python", reason="`pip install axe-playwright-python` brings axe-core")
    watched.page.evaluate((resources.files(axe) / "axe.min.js").read_text())
    found = watched.evaluate("async () => (await axe.run()).violations.map((rule) => [rule.id, rule.nodes[0].html])")
    assert [fault for fault in found if fault[0] not in besides] == []
