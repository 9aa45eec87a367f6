"""A report that is made again whenever runs change, while a sweep trains them."""

from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from datagen.disk.errors import HyalineError
from datagen.terminal.command import say
from eval.score.runs import list_run_folders

EVERY_S = 5
"""Seconds between two looks at the runs, and after which a browser reads the page again."""

WATCHED = (
    "run.json",
    "metrics.jsonl",
    "costs.json",
    "predictions.json",
    "predictions/*/*.png",
    "variants/*/predictions.json",
    "variants/*/predictions/*/*.png",
)
"""What a report depends on in a run's folder."""

State = frozenset[tuple[str, int, int]]


def watch(make: Callable[[], None], runs_root: Path, out: Path, *, pause: Callable[[float], None]) -> NoReturn:
    """Makes a report at once and after each change of the runs, until a signal ends it.

    What is wrong with runs is said, and no reason to end: they may not be complete yet.

    Args:
        pause: waits for so many seconds.
    """
    seen: State | None = None
    while True:
        state = runs_state(runs_root, out)
        if state != seen:
            try:
                make()
            except HyalineError as error:
                say(f"error: {error}")
            say(f"waits for {runs_root} to change; Ctrl-C ends this")
            seen = state
        pause(EVERY_S)


def runs_state(runs_root: Path, out: Path) -> State:
    """Name, time and size of every file that a report reads from the runs."""
    state = set()
    for folder in list_run_folders(runs_root, besides=out):
        for path in (path for pattern in WATCHED for path in folder.glob(pattern)):
            try:
                found = path.stat()
            except OSError:  # Gone since it was listed.
                continue
            state.add((path.as_posix(), found.st_mtime_ns, found.st_size))
    return frozenset(state)
