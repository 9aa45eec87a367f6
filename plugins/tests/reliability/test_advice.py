"""Tests that what a command advises works as it stands: its folders, runs, edits and proxies are there."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from support.commands import call, parsed
from support.disk import State
from support.scenarios import BUILD, TRAIN

from datagen.data.dataset import open_dataset
from datagen.data.geometries import check_geometry
from datagen.data.paths import find_dataset
from datagen.data.variants import list_variants
from model.run.predict import load_renderer
from model.run.run_folder import read_run

ADVICE = re.compile(r"^next: (.*)$|`((?:datagen|proxies|model|report|eval report) [^`]*)`", re.MULTILINE)
SPACED = "data/two words"


def advised(text: str) -> list[str]:
    """The commands in what was said, but those that only point to more help."""
    found = ["".join(pair).replace("eval report", "report") for pair in ADVICE.findall(text)]
    return [line for line in found if not line.endswith("--help")]


def check_advice(line: str) -> None:
    """Fails unless a command parses, and finds every folder, run, edit and geometry that it names."""
    given = parsed(line)
    name, run = given.get("dataset"), given.get("run")
    if isinstance(name, str):
        opened = open_dataset(find_dataset(name))
        if line.startswith("model train"):
            check_geometry(opened, given["choices"].geometry)  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(run, Path) and run != Path("RUN"):  # Any run.
        record = read_run(run)
        dataset = open_dataset(find_dataset(record.dataset))
        load_renderer(run, record.config, dataset)
        assert given.get("variant") in (None, *list_variants(dataset.root)), f"{line}: no such variant"
    if isinstance(runs := given.get("runs"), Path):
        assert list(runs.glob("*/*/predictions")), f"{line}: no runs there"


@pytest.fixture
def ask(start: Callable[[str], State]) -> Callable[..., list[str]]:
    """Runs a command in a folder with a scene, checks and returns what it advises, and follows that if it is quick."""
    start("scene")

    def asked(line: str, *, status: int = 0, follow: bool = True) -> list[str]:
        answer = call(line)
        assert answer.status == status, f"{line}: {answer.err}"
        lines = advised(answer.err)
        assert lines, f"{line}: advises nothing: {answer.err}"
        for advice in lines:
            check_advice(advice)
            if follow and not advice.startswith(("model train", "model sweep", "datagen build --scene glass_table")):
                followed = call(advice)
                assert followed.status == 0, f"{line} advises {advice}: {followed.err}"
        return lines

    return asked


def test_every_command_of_a_workflow_advises_what_works_as_it_stands(ask: Callable[..., list[str]]) -> None:
    build = BUILD.replace("data/one", f"'{SPACED}'")
    train = TRAIN.replace("data/one", f"'{SPACED}'")
    assert ask("datagen verify nothing", status=1) == ["datagen build --scene glass_table"]
    assert ask("datagen scenes") == ["datagen build --scene glass_table"]
    assert ask(build) == [f"proxies make '{SPACED}' --kind ellipsoid"]
    assert ask(f"datagen add '{SPACED}' --twins", follow=False) == ["model predict RUN --variant opaque-glass"]
    assert ask("report runs", status=1) == ["model train paper"]
    edit = f"datagen add '{SPACED}' --edit remove:pane"
    (draw,) = ask(edit, follow=False)
    assert draw == "model predict RUN --variant remove-pane"
    assert ask(f"model predict runs/none --dataset '{SPACED}'", status=1) == ["model train paper"]
    assert ask("report --table table1", status=1) == [f"model sweep table1 --dataset '{SPACED}'"]
    assert ask(f"proxies make '{SPACED}' --kind box") == [f"model train paper '{SPACED}' --geometry box"]
    assert ask(f"{train} --geometry hull", status=1) == ["proxies make"]
    assert ask(f"{train} --geometry mixed-a", status=1) == ["proxies make"]
    assert ask(f"{train} --out 'elsewhere/two words/paper'") == ["report elsewhere"]
    assert ask(train) == ["report"]
    run = "'runs/two words/paper-w8-t8-batch32-5-steps'"
    assert ask(draw.replace("RUN", run)) == ["report"]
    assert ask(f"model predict {run} --variant x2", status=1, follow=False) == ["datagen add"]
    assert call(f"datagen add '{SPACED}' --larger 2").status == 0
    assert ask(f"model predict {run} --variant x2") == ["report"]
    assert ask(f"model predict {run} --variant remove-floor", status=1, follow=False) == ["datagen add"]
