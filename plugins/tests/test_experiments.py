"""Tests the experiments that come with the program, whose methods and tables are plug-ins' as well."""

import pytest
from support import commands

from model.run.sweep import EXPERIMENTS, list_experiments, read_experiment


@pytest.mark.parametrize("name", list_experiments())
def test_every_experiment_that_comes_with_the_program_is_one_that_train_takes(name: str) -> None:
    answer = commands.call(f"model sweep {name} --dry-run")
    lines = answer.out.splitlines()
    assert answer.status == 0 and lines and len(lines) == len(set(lines))
    assert name in "".join(commands.call("model sweep --help").out.split()), "help may break a name at a hyphen"


def test_a_folder_of_experiments_is_all_of_its_parts_with_each_run_once() -> None:
    whole = read_experiment("paper-tables")
    parts = [read_experiment(path.stem) for path in (EXPERIMENTS / "paper-tables").glob("*.txt")]
    assert len(parts) == 7 and all(set(part.needs) <= set(whole.needs) for part in parts)
    assert len(whole.runs) < sum(len(part.runs) for part in parts)
