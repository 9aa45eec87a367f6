"""Tests of an installation in parts: what the base does alone, and what a command says whose part is missing."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from support.plugins import install
from support.synthetic import write_predictions, write_synthetic_dataset

from datagen.disk.errors import UsageError
from datagen.terminal.plugins import DISTRIBUTION, PARTS, VERSION, Group

ROOT = Path(__file__).resolve().parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MODULES = sorted({module for modules in PARTS.values() for module in modules})

WITHOUT_PARTS = f"""
import json, sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {MODULES}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocker())
import hyaline
from support.commands import call

view = hyaline.open_dataset("one").view("interpolating", 0)
assert view.radiance.shape == view.image.shape == (*view.mask("glass").shape, 3) == (*view.layers().uv.shape[1:3], 3)
assert hyaline.score(view.image, view.image).ssim == 1
try:
    hyaline.RayDataset
except hyaline.HyalineError as error:
    assert str(error) == 'hyaline.RayDataset: needs torch, which is not installed; ' \\
        '`pip install "hyaline-glass[model]"` brings it'
else:
    raise AssertionError("torch is there")

answers = {{line: call(line) for line in json.load(sys.stdin)}}
print(json.dumps({{line: [answer.status, answer.out, answer.err] for line, answer in answers.items()}}))
"""


def without_parts(folder: Path, *lines: str) -> dict[str, tuple[int, str, str]]:
    """Status, output and errors of command lines in an installation of the base alone."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    answer = subprocess.run(
        [sys.executable, "-c", WITHOUT_PARTS],
        input=json.dumps(lines),
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
        env=environment,
    )
    return {line: tuple(values) for line, values in json.loads(answer.stdout).items()}


def test_the_base_verifies_reads_and_scores_and_a_missing_part_is_one_line(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "one")
    write_predictions(dataset, tmp_path / "runs" / "one" / "mine", lambda image: 255 - image)
    needing = {
        "datagen build --scene glass_table --preset tiny": "generate",
        "datagen peel data/one --overwrite": "generate",
        "datagen add one --twins": "generate",
        "proxies make one --kind box": "proxies",
        "model train paper one --steps 1": "model",
        "model check-method light-path": "model",
    }
    working = ["datagen verify data/one", "datagen scenes", "report --json", "model train --help"]
    answers = without_parts(tmp_path, *working, *needing)
    for line in working:
        assert answers[line][0] == 0, answers[line]
    assert "mine" in answers["report --json"][1]
    for line, extra in needing.items():
        status, out, err = answers[line]
        told = [text for text in err.splitlines() if text.startswith("error: ")]
        assert (status, len(told), "Traceback" in err) == (1, 1, False), (line, out, err)
        program, verb = line.split()[:2]
        assert re.fullmatch(
            rf"error: {program} {verb}: needs \w+, which is not installed; "
            rf'`pip install "hyaline-glass\[{extra}\]"` brings it',
            told[0],
        ), told[0]


def test_each_part_has_the_modules_that_pip_would_bring() -> None:
    extras: dict[str, list[str]] = PROJECT["optional-dependencies"]

    def brought(extra: str) -> set[str]:
        found = set()
        for requirement in extras[extra]:
            if own := re.fullmatch(rf"{DISTRIBUTION}\[(.*)\]", requirement):
                found |= {name for part in own[1].split(",") for name in brought(part)}
            else:
                found.add(re.split(r"[^\w-]", requirement)[0])
        return found

    assert {name: set(modules) for name, modules in PARTS.items()} == {name: brought(name) for name in PARTS}
    everything = brought("dev") | {re.split(r"[^\w-]", requirement)[0] for requirement in PROJECT["dependencies"]}
    assert everything >= {name for modules in PARTS.values() for name in modules}
    assert PROJECT["name"] == DISTRIBUTION
    assert re.search(rf"^version: {re.escape(VERSION)}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)


def test_a_name_of_a_plugin_that_is_not_here_names_the_plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, "hyaline.ghosts", "ghost", "hyaline_glass:GHOST", "")
    (tmp_path / "hyaline_glass.py").unlink()
    monkeypatch.syspath_prepend(tmp_path)
    ghosts: Group = Group(name="hyaline.ghosts", what="ghost", guide="docs/index.md")
    assert ghosts.names() == ()
    with pytest.raises(UsageError, match="ghost 'ghost': is of the plug-in hyaline_glass, which is not here"):
        ghosts.find("ghost")
    with pytest.raises(UsageError, match="no ghost 'goblin'"):
        ghosts.find("goblin")
