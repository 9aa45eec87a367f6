"""Tests that what a command advises works as it stands."""

import re
from collections.abc import Callable

from support.commands import call, parsed
from support.disk import State
from support.scenarios import BUILD, TRAIN

from datagen.machine.mitsuba_variant import use_mitsuba

ADVICE = re.compile(r"^next: (.*)$|`((?:datagen|proxies|model|report|eval report) [^`]*)`", re.MULTILINE)
SPACED = "data/two words"


def advised(text: str) -> list[str]:
    """The commands in what was said, but those that only point to more help."""
    found = ["".join(pair).replace("eval report", "report") for pair in ADVICE.findall(text)]
    return [line for line in found if not line.endswith("--help")]


def ask(line: str, *, status: int = 0, follow: bool = True) -> list[str]:
    """Runs a command, returns what it advises, which must be commands, and follows that if it is quick."""
    answer = call(line)
    assert answer.status == status, f"{line}: {answer.err}"
    lines = advised(answer.err)
    for advice in lines:
        parsed(advice)
        if follow and not advice.startswith(("model train", "model sweep", "datagen build glass_table")):
            followed = call(advice)
            assert followed.status == 0, f"{line} advises {advice}: {followed.err}"
    return lines


def test_every_command_of_a_workflow_advises_what_works_as_it_stands(start: Callable[[str], State]) -> None:
    use_mitsuba()  # Scenarios do not, and a report looks up normals.
    start("scene")
    build = BUILD.replace("data/one", f"'{SPACED}'")
    train = TRAIN.replace("data/one", f"'{SPACED}'")
    assert ask("datagen verify nothing", status=1) == ["datagen build glass_table"]
    assert ask("datagen scenes") == ["datagen build glass_table"]
    assert ask(build) == [f"proxies make '{SPACED}' --kind ellipsoid"]
    assert ask(f"datagen add '{SPACED}' --twins") == [f"model train paper '{SPACED}'"]
    assert ask("report runs", status=1) == ["model train paper"]
    assert ask(f"model predict runs/none --dataset '{SPACED}'", status=1) == ["model train paper"]
    assert ask("report --table table1", status=1) == [f"model sweep table1 --dataset '{SPACED}'"]
    assert ask(f"proxies make '{SPACED}' --kind box") == [f"model train paper '{SPACED}' --geometry box"]
    assert ask(f"{train} --geometry hull", status=1) == ["proxies make --kind hull"]
    assert ask(f"{train} --out 'elsewhere/two words/paper'") == ["report elsewhere"]
    assert ask(train) == ["report"]
    run = "'runs/two words/paper-w8-t8-batch32-5-steps'"
    draw = f"model predict {run} --variant remove-pane"
    assert ask(f"datagen add '{SPACED}' --edit remove:pane") == [draw]
    assert ask(f"model predict {run} --variant x2", status=1, follow=False) == ["datagen add"]
    assert call(f"datagen add '{SPACED}' --larger 2").status == 0
    assert ask(f"model predict {run} --variant x2") == ["report"]
    assert ask(f"model predict {run} --variant remove-floor", status=1, follow=False) == ["datagen add"]
