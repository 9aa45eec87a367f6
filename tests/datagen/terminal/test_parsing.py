"""Tests the grammar of all commands: words, lists, switches, help, JSON."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from support.commands import call, parsed
from support.synthetic import write_synthetic_dataset

from datagen.builder.choices import AddChoices, BuildChoices, ShardChoices, SizeChoices
from datagen.disk.errors import UsageError
from datagen.terminal.parsing import CommandGroup, Later, changed_flags, flag_words, group, parse

PROGRAMS = ("datagen", "proxies", "model")


def every_command() -> list[str]:
    """Each command of each program, in the words that choose it."""
    import importlib

    def below(line: str, command: object) -> list[str]:
        if not isinstance(command, CommandGroup):
            return [line]
        found = command.commands().items()
        loaded = {name: item.load(()) if isinstance(item, Later) else item for name, item in found}
        return [line, *(one for name, item in loaded.items() for one in below(f"{line} {name}", item))]

    roots = {program: importlib.import_module(f"{program}.cli").commands() for program in PROGRAMS}
    return [*(line for program, root in roots.items() for line in below(program, root)), "report"]


COMMANDS = every_command()
"""Listed on import, before other tests add methods to this process."""


def test_help_and_the_list_of_scenes_load_no_library_that_computes() -> None:
    code = (
        "import contextlib, io, sys\n"
        "from support.commands import call\n"
        f"for line in {COMMANDS!r}: assert call(line + ' --help').status == 0, line\n"
        "assert call('datagen scenes').status == 0\n"
        "print({'numpy', 'torch', 'mitsuba', 'trimesh'} & set(sys.modules))\n"
    )
    environment = {"PYTHONPATH": ":".join(sys.path)}
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert (said.returncode, said.stdout) == (0, "set()\n"), said.stderr


@pytest.mark.parametrize("line", ["datagen", "proxies", "model", "model train"])
def test_a_bare_command_prints_its_help(line: str) -> None:
    bare = call(line)
    assert (bare.status, bare.out, bare.err) == (2, call(f"{line} --help").out, "")


def test_the_page_of_commands_has_each() -> None:
    page = (Path(__file__).parents[3] / "docs" / "commands.md").read_text()
    assert [line for line in COMMANDS if line not in page and not line.startswith("model train ")] == []


def test_lists_are_flags_that_repeat_and_switches_have_two_forms() -> None:
    asked = parsed("datagen add one --edit no-glass --edit remove:vase --larger 2 --larger 4 --no-twins --angles")
    assert asked["choices"] == AddChoices(edit=("no-glass", "remove:vase"), larger=(2, 4), angles=True)
    with pytest.raises(UsageError, match="Unrecognized options: 4"):
        parsed("datagen add one --larger 2 4")


@pytest.mark.parametrize(
    ("line", "choices"),
    [
        ("datagen b", ["build"]),
        ("datagen build p", ["plant_shelf", "prism_bench", "pool"]),
        ("datagen build --preset s", ["small", "standard"]),
        ("datagen build --out ", []),  # A file.
        ("datagen look o", ["one"]),
        ("model train paper --twice ", ["one"]),
        ("model film ", ["one/mine"]),
        ("model predict --over", ["--overwrite"]),
    ],
)
def test_a_shell_completes_commands_flags_choices_datasets_and_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, choices: list[str]
) -> None:
    for file in ("data/one/dataset.json", "data/other", "runs/one/mine/run.json"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COMP_LINE", f"{line} and more")
    monkeypatch.setenv("COMP_POINT", str(len(line)))
    program, begun = line.split(" ")[0], line.split(" ")[-1]
    found = call(f"{program} --complete {program} '{begun}' before").out.split()
    assert [word for word in found if begun or not word.startswith("--")] == choices


@pytest.mark.parametrize(
    "record",
    [
        BuildChoices(preset="tiny", out=Path("a b"), overwrite=True, count=3, family="table", seed=-1),
        SizeChoices(resolution="32x16", ceiling=45.5),
        ShardChoices(launcher="slurm", shards=2),
        AddChoices(edit=("no-glass", "move:a:0,0,-1"), larger=(2, 3)),
    ],
)
def test_the_words_of_a_record_ask_for_it(record: object) -> None:
    def command(*, choices: object = type(record)()) -> None: ...

    command.__annotations__["choices"] = type(record)
    asked = parse("program", command, flag_words(changed_flags(record, type(record)())))
    assert asked.keywords == {"choices": record}


def test_scripts_get_one_object_and_no_progress(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "one", resolution=8, train_views=1)
    whole = call("datagen verify one --json --quiet")
    found = json.loads(whole.out)
    assert (whole.status, whole.err) == (0, "")
    assert set(found) == {"dataset", "verified", "problems", "remarks"}
    assert found["dataset"] == "data/one" and found["verified"] > 10 and found["problems"] == []
    next(dataset.root.glob("images/train/*.png")).write_bytes(b"broken")
    damaged = call("datagen verify one --json")
    found = json.loads(damaged.out)
    assert damaged.status == 1 and len(found["problems"]) == 1
    assert len(damaged.err.splitlines()) == 1


def test_a_command_whose_plugin_is_not_here_names_it() -> None:
    program = group("Tools.", {}, {"import": "hyaline_import"})
    with pytest.raises(UsageError, match=r"tool import: .* plug-in hyaline_import, which is not here"):
        parse("tool", program, ["import", "vase.glb"])
