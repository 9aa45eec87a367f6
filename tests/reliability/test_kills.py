"""Tests that a command that is killed at any moment ends, when it is run again, as if nothing had happened."""

from collections.abc import Callable
from pathlib import Path

import pytest
from support.commands import call, run
from support.disk import State, differing, empty, observe, read_state
from support.promises import spread
from support.scenarios import SCENARIOS, Scenario

pytestmark = pytest.mark.promise("R1")

QUICK = 6
"""States of each command that a quick run tries."""


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_a_command_killed_at_any_change_of_the_disk_ends_in_the_same_bytes(
    scenario: Scenario,
    here: Path,
    start: Callable[[str], State],
    is_full: bool,
    cases: Callable[[int, str], None],
) -> None:
    start(scenario.start)
    seen = observe(here, lambda: run(scenario.line))
    end = seen.states[-1]
    broken = []
    states = list(seen.states) if is_full else spread(list(seen.states), QUICK)
    for state in states:
        empty(here)
        state.restore(here)
        answer = call(scenario.line)
        found = read_state(here)
        if answer.status != 0:
            broken.append(f"{state.before}: {answer.error}")
        elif difference := differing(found, end):
            broken.append(f"{state.before}: {difference}")
    assert not broken, f"{len(broken)} of {len(states)}: " + "\n".join(broken[:10])
    cases(len(states), "states of the disk")
    cases(len(seen.changes) if is_full else 0, "changes of the disk enumerated")
