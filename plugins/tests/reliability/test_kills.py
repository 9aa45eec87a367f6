"""Tests that a command that is killed at any moment ends, when it is run again, as if nothing had happened."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from support.commands import call, run
from support.disk import State, differing, empty, observe, read_state
from support.scenarios import EACH_SCENARIO, Scenario

pytestmark = pytest.mark.promise("R1")


@EACH_SCENARIO
def test_a_command_killed_at_any_change_of_the_disk_ends_in_the_same_bytes(
    scenario: Scenario,
    here: Path,
    start: Callable[[str], State],
    is_full: bool,
) -> None:
    start(scenario.start)
    seen = observe(here, lambda: run(scenario.line))
    end = seen.states[-1]
    broken = []
    states = seen.states if is_full else telling(seen.states)
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


def telling(states: Sequence[State]) -> list[State]:
    """Where a wrong order of commits would show: right after a file of each kind that promises others got its name."""
    found = {}
    for state in states:
        path = "" if state.after is None or state.after.what != "rename" else state.after.path
        if path.endswith((".json", ".pt")) and "/transforms_" not in path:
            found.setdefault(re.sub(r"\d+|train|val", "", path), state)
    return [states[len(states) // 2], *found.values()]
