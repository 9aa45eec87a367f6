"""A headless Chromium that opens pages from disk, and watches what they ask for and complain of."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
"""A browser whose drawing is computed by the processor: the same on every machine."""


@dataclass(kw_only=True)
class Watched:
    """A page, and what it did besides being shown."""

    page: "Page"
    complaints: list[str] = field(default_factory=list)
    """Errors and warnings in the console, and exceptions that nobody caught."""
    requests: list[str] = field(default_factory=list)
    """Addresses that were asked for, the page's own first."""

    def picture(
        self, view: str, size: int, samples: int, edits: dict[str, dict[str, object]] | None = None
    ) -> np.ndarray:
        """The page's picture of a view of the dataset, of so many rays a pixel, after edits by object: (h, w, 3)."""
        encoded = self.page.evaluate(
            "async ([view, size, samples, edits]) => (await hyaline).picture(view, size, samples, edits)",
            [view, size, samples, edits or {}],
        )
        return np.array(encoded, np.uint8).reshape(size, size, 4)[..., :3]


def find_browser() -> str | None:
    """The system's Chromium, if there is one."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


def require_browser() -> str:
    """The system's Chromium; without one the test is skipped, or fails where tests in a browser are demanded."""
    program = find_browser()
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        program = None
    if program is None:
        why = "no Chromium, or no playwright (`pip install -e .[browser]` and the system's package chromium)"
        if os.environ.get("HYALINE_DEMAND_BROWSER"):
            pytest.fail(why)
        pytest.skip(why)
    return program


@contextlib.contextmanager
def running_browser() -> Iterator["Browser"]:
    """A browser, of which there may be one at a time."""
    program = require_browser()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


@contextlib.contextmanager
def watched_page(browser: "Browser", *, width: int = 400, height: int = 300, dark: bool = False) -> Iterator[Watched]:
    """An empty page."""
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light")
    try:
        page.set_default_timeout(120_000)
        watched = Watched(page=page)
        page.on("console", lambda message: watched.complaints.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: watched.complaints.append(str(error)))
        page.on("request", lambda request: watched.requests.append(request.url))
        yield watched
    finally:
        page.close()


def open_file(watched: Watched, path: Path) -> None:
    """Opens a page from disk, and waits until its scene is there."""
    watched.page.goto(path.resolve().as_uri())
    watched.page.evaluate("async () => { await hyaline; }")
