"""What all tests share: a folder of its own for each, checked annotations, the promises of docs/reliability.md,
what keeps them quick, and their order."""

import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

# Each process of the tests has one core for itself; PyTorch's threads on all of them would only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Idle threads sleep: by default those of NumPy spin for milliseconds, and eat up the cores of the tests beside them.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")
# Compiled modules are kept whatever the shell says: every process of the tests would compile hundreds of them anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Nothing waits for the disk, which takes 5 ms a file: only a power cut could tell the difference, and none is tried.
os.fsync = lambda _: None

from support.checked import check_annotations  # noqa: E402

check_annotations()  # Before anything imports one of the packages.

from support.synthetic import write_synthetic_dataset  # noqa: E402

from datagen.data.dataset import Dataset  # noqa: E402
from model.runtime import wait_briefly  # noqa: E402

wait_briefly()  # Before anything imports torch.

pytest_plugins = ["support.promises", "support.reading"]

LONGEST = (
    "plugins/hyaline_web/tests/page/test_page.py",
    "tests/proxies/test_proxies.py",
    "plugins/hyaline_photos/tests/fit/test_fit.py",
    "tests/datagen/scene/test_scenes.py",
    "tests/datagen/builder/test_shards.py",
    "tests/datagen/render/test_thin_walls.py",
    "tests/datagen/render/test_render.py",
    "tests/model/run/test_interrupted.py",
    "plugins/hyaline_import/tests/test_confined_import.py",
    "plugins/hyaline_photos/tests/fit/test_kinds.py",
    "plugins/tests/reliability/test_hostile_files.py",
    "tests/eval/page/test_page_in_browser.py",
    "plugins/hyaline_photos/tests/fit/test_boxes.py",
)
"""The slowest test files, in starting order."""


@pytest.fixture(scope="session", autouse=True)
def away_from_the_checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What lies in the checkout's `data/` and `runs/` is no test's business: fixtures that tests share work in a folder
    of the session."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("session"))
    yield
    os.chdir(before)


@pytest.fixture(autouse=True)
def own_folder(away_from_the_checkout: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test works in a folder of its own, and gets signals, which shells and stopped commands may ignore."""
    monkeypatch.chdir(tmp_path)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The pane and the floor, for reading only."""
    return write_synthetic_dataset(tmp_path_factory.mktemp("shared") / "data" / "synthetic")


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """On steps this small PyTorch's threads would wait for each other longer than they compute."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def pytest_collection_finish() -> None:
    """No garbage collection walks what importing all modules has made: it stays until the end, and walking it takes
    half a second each time."""
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first: begun last, one of them would keep one process busy while the others are done."""
    place = {Path(__file__).parent / file: index for index, file in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(place)))
