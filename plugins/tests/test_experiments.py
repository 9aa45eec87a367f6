"""Tests the experiments that come with the program, whose methods and tables are plug-ins' as well."""

import pytest
from support.training import call

from model import cli
from model.run.experiments import EXPERIMENTS, list_experiments, read_experiment


def test_a_part_is_its_blocks_of_the_paper_s_tables(is_full: bool) -> None:
    whole = read_experiment("paper-tables")
    names = set(list_experiments()) - {path.stem for path in EXPERIMENTS.glob("*.toml")}
    assert len(names) == 8
    parts = {name: read_experiment(name) for name in (names if is_full else ("table1", "deepvoxels"))}
    assert {run[0] for run in parts["deepvoxels"].runs} == {"deepvoxels"}
    assert len(parts["table1"].runs) == 9 and parts["table1"].needs == ("datagen build glass_table",)
    for part in parts.values():
        assert set(part.runs) < set(whole.runs) and set(part.needs) < set(whole.needs)


@pytest.mark.parametrize("name", sorted(path.stem for path in EXPERIMENTS.glob("*.toml")))
def test_every_experiment_that_comes_with_the_program_is_one_that_train_takes(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, "sweep", name, "--dry-run") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines and len(lines) == len(set(lines))
    assert name in cli.sweep.__doc__  # pyright: ignore[reportOperatorIssue]
