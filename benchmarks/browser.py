"""A headless Chromium that opens pages from disk, and watches what they ask for and complain of."""

import contextlib
import importlib.util
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from datagen.disk.errors import HyalineError

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

PATIENCE_MS = 120_000
"""How long a page may take to answer, or to draw one ray a pixel."""


@dataclass(kw_only=True)
class Watched:
    """A page, and what it did besides being shown."""

    page: "Page"
    complaints: list[str] = field(default_factory=list)
    """Errors and warnings in the console, and uncaught exceptions."""
    requests: list[str] = field(default_factory=list)
    """Addresses that were asked for, the page's own first."""

    def hear(self, said: str) -> None:
        if "OpenGL, Performance" not in said:  # The driver's remarks on its speed come on busy machines.
            self.complaints.append(said)

    def evaluate(self, script: str, argument: object = None, *, patience_ms: int = PATIENCE_MS) -> Any:
        """What a function of the page answers, awaited for so long."""
        late = f"new Promise((_, no) => setTimeout(() => no(new Error('no answer')), {patience_ms}))"
        return self.page.evaluate(f"(given) => Promise.race([({script})(given), {late}])", argument)

    def picture(
        self, view: str, shape: tuple[int, ...], samples: int, edits: dict[str, dict[str, object]] | None = None
    ) -> np.ndarray:
        """The page's picture of a view of the dataset, of so many rays a pixel, after edits by object: (h, w, 3).

        Args:
            shape: height and width.
        """
        height, width = shape
        encoded = self.evaluate(
            "async (given) => (await hyaline).picture(...given)",
            [view, width, height, samples, edits or {}],
            patience_ms=PATIENCE_MS * samples,
        )
        return np.array(encoded, np.uint8).reshape(height, width, 4)[..., :3]


def find_browser() -> str:
    """The system's Chromium."""
    if importlib.util.find_spec("playwright") is None:
        raise HyalineError("playwright: not installed, and it drives the browser; `pip install -e .[browser]`")
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        raise HyalineError(
            f"browser: none of {', '.join(PROGRAMS)} is there; install the system's package chromium, such as by "
            "`apt-get install chromium`"
        )
    return program


@contextlib.contextmanager
def running_browser() -> Iterator["Browser"]:
    """A browser; only one may run at a time."""
    program = find_browser()
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
        page.set_default_timeout(PATIENCE_MS)
        watched = Watched(page=page)
        page.on("console", lambda it: watched.hear(f"{it.type}: {it.text}"))
        page.on("pageerror", lambda error: watched.complaints.append(str(error)))
        page.on("request", lambda request: watched.requests.append(request.url))
        yield watched
    finally:
        page.close()


def open_file(watched: Watched, path: Path, *, link: str = "") -> None:
    """Opens a page from disk, with `link` after the # of its address, and waits until its scene is loaded."""
    watched.page.goto(path.resolve().as_uri() + (f"#{link}" if link else ""))
    watched.evaluate("async () => { await hyaline; }")
