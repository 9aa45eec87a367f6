"""When tests in a browser run: wherever there is one, and always where they are demanded."""

import os
from collections.abc import Callable

import pytest

from benchmarks.browser import find_browser
from datagen.disk.errors import HyalineError


def require_browser() -> None:
    """Skips the test where there is no Chromium; fails it where tests in a browser are demanded, as CI does."""
    require(find_browser)


def require(find: Callable[[], object]) -> None:
    """The same for whatever a function finds."""
    try:
        find()
    except HyalineError as error:
        if os.environ.get("HYALINE_DEMAND_BROWSER"):
            pytest.fail(str(error))
        pytest.skip(str(error))
