"""Tests that a disk that is full, defective or read-only at any moment costs nothing but the work after it."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest
from support.commands import call, run
from support.disk import Fault, State, differing, empty, failing_from, observe, read_state
from support.promises import spread
from support.scenarios import EACH_SCENARIO, Scenario

pytestmark = pytest.mark.promise("R5")

QUICK = 3
"""Changes of the disk that a quick run refuses of each command."""


@EACH_SCENARIO
def test_a_disk_that_refuses_any_change_is_one_line_and_loses_nothing(
    scenario: Scenario, here: Path, start: Callable[[str], State], is_full: bool
) -> None:
    before = start(scenario.start)
    seen = observe(here, lambda: run(scenario.line))
    numbers = list(range(len(seen.changes)))
    broken = []
    for place, number in enumerate(numbers if is_full else spread(numbers, QUICK)):
        # One after the other, each number with another fault: together they meet all kinds of changes.
        fault: Fault = get_args(Fault)[place % 3]
        empty(here)
        before.restore(here)
        with failing_from(here, number, fault) as refused:
            answer = call(scenario.line)
        what = f"{fault} at change {number}, {seen.changes[number].what} {seen.changes[number].path}"
        after = read_state(here)
        if problem := wrong_answer(
            answer.status, answer.err, [str(here / change.path) for change in refused], after, seen.states[-1]
        ):
            broken.append(f"{what}: {problem}")
        if "--overwrite" not in scenario.line and (lost := lost_files(before, after)):
            broken.append(f"{what}: {lost} of what was there is lost or changed")
        again = call(scenario.line)
        if again.status != 0:
            broken.append(f"{what}: then {again.error}")
        elif difference := differing(read_state(here), seen.states[-1]):
            broken.append(f"{what}: then {difference}")
    assert not broken, f"{len(broken)}:\n" + "\n".join(broken[:12])


def wrong_answer(status: int, said: str, refused: list[str], found: State, expected: State) -> str | None:
    """What is wrong with how a command took a refusal; it may have done without, when all is as it should be."""
    if not refused:
        return None
    if status == 0:
        return (difference := differing(found, expected)) and f"ended well, but {difference}"
    lines = said.strip().splitlines()
    if status != 1 or "Traceback" in said or not lines[-1].startswith("error: "):
        return f"ended with {status}: {lines[-1]}"
    if sum(line.startswith("error: ") for line in lines) != 1:
        return f"has several errors: {said}"
    # A sweep goes on past runs that fail, and says why before its last line.
    words = said if "the lines above say" in lines[-1] else lines[-1]
    if not re.search(r"(data|runs|exports)/[a-z]+[\w./-]*: ", words):
        return f"does not name {refused[0]}: {lines[-1]}"
    return None


def lost_files(before: State, after: State) -> str:
    return next((path for path, data in before.files.items() if after.files.get(path) != data), "")
