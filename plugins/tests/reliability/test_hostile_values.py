"""Hostile values in another project's cameras and in experiments, and files without end: one short line, soon.

Those in our own files are in test_hostile_files.py.
"""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support.checked import unchecked
from support.hostile.jsons import changed, places, without
from support.soon import soon
from support.synthetic import synthetic_scene

from datagen.data.cameras import look_at
from datagen.disk.errors import HyalineError
from datagen.scene.folder import load_scene, save_scene
from hyaline_import.datasets.choices import DatasetImportChoices
from hyaline_import.datasets.import_dataset import plan_import
from model.run.experiments import read_experiment

pytestmark = pytest.mark.promise("R6")


JSON_TEXTS = {
    "null": "null",
    "true": "true",
    "negative": "-1",
    "zero": "0",
    "huge float": "1e308",
    "tiny float": "5e-324",
    "beyond float": "1e999",
    "NaN": "NaN",
    "Infinity": "Infinity",
    "63 bits": str(2**63 - 1),
    "64 bits": str(2**64),
    "400 digits": "1" + "0" * 400,
    "5000 digits": "9" * 5000,
    "empty list": "[]",
    "empty object": "{}",
    "unhashable type": '{"type": []}',
    "object as type": '{"type": {"a": 1}}',
    "NUL": '"a\\u0000b"',
    "surrogate": '"\\ud800"',
    "escape": '"\\u001b[2J"',
    "path": '"../../../etc/passwd"',
    "absolute": '"/etc/passwd"',
    "long text": '"' + "x" * 100_000 + '"',
    "long list": "[" + "0," * 50_000 + "0]",
    "deep list": "[" * 50_000 + "]" * 50_000,
    "half as deep": "[" * 300 + "]" * 300,
    "key twice": '{"a": 1, "a": 2}',
}
"""The text of each value, by what it is."""

PLACEHOLDER = "HOSTILE VALUE"


def variants(data: dict) -> dict[str, str]:
    """The text of a JSON file with each hostile value at each place, and without each key, by what is wrong."""
    found = {}
    for path in filter(None, places(data)):
        name = ".".join(map(str, path))
        if isinstance(path[-1], str):
            found[f"{name} is missing"] = json.dumps(without(data, path))
        pattern = json.dumps(changed(data, path, PLACEHOLDER))
        for kind, text in JSON_TEXTS.items():
            found[f"{name} is {kind}"] = pattern.replace(json.dumps(PLACEHOLDER), text)
    return found


def try_all(texts: dict[str, str], place: Callable[[str], None], read: Callable[[], object]) -> dict[str, str]:
    """What came of each text: an error's line, or nothing where it was taken.

    Whatever is raised but our own error fails the test; as does an error that is no short line, or a long wait.
    """
    answers = {}
    for name, text in texts.items():
        place(text)
        try:
            with soon(), unchecked():  # Checks of each value would be most of the time.
                read()
            answers[name] = ""
        except HyalineError as error:
            answers[name] = str(error)
        except Exception as error:
            raise AssertionError(f"{name}: {type(error).__name__}: {error}") from error
        line = " ".join(answers[name].split())
        assert len(line) < 1000, f"{name}: {line}"
    return answers


Some = Callable[[dict[str, str]], dict[str, str]]


@pytest.fixture
def some(is_full: bool) -> Some:
    """Every other variant, or in a quick run every seventeenth one; from place to place, it is other values."""
    return lambda texts: dict(list(texts.items())[:: 2 if is_full else 17])


def refused_everywhere(answers: dict[str, str], *kinds: str) -> None:
    """Some values fit nowhere: they are refused at each place."""
    for name, answer in answers.items():
        if name.endswith(tuple(f" is {kind}" for kind in kinds)):
            assert answer, name


NOWHERE = ("beyond float", "NaN", "Infinity", "64 bits", "400 digits", "5000 digits", "NUL", "surrogate", "deep list",
           "half as deep", "key twice")  # fmt: skip


def test_every_hostile_value_in_another_projects_cameras_is_one_line(tmp_path: Path, some: Some) -> None:
    from PIL import Image

    for view in range(4):
        Image.new("RGB", (12, 8)).save(tmp_path / f"{view}.png")
    frames = [
        {"file_path": f"{view}.png", "transform_matrix": look_at((2, view, 1), (0, 0, 0)).tolist()} for view in range(4)
    ]
    data = {"fl_x": 10.0, "fl_y": 10.0, "cx": 6.5, "cy": 4.0, "w": 12, "h": 8, "k1": 0.0, "frames": frames}
    path = tmp_path / "transforms.json"
    answers = try_all(some(variants(data)), path.write_text, lambda: plan_import(tmp_path, DatasetImportChoices()))
    assert len(answers) > 30
    refused_everywhere(answers, *NOWHERE)


TOML_VALUES = [
    "nan", "inf", "-inf", "1e999", "9" * 400, "9" * 5000, "[]", "[[]]", "[[1]]", "{}", "{a = 1}", "1979-05-27",
    "1979-05-27T07:32:00Z", "07:32:00", '""', '"\\u0000"', '"\\u001b[2J"', '"../../x"', '"--overwrite"',
    '"' + "x" * 100_000 + '"',
    "true", "[true, 1]", "[" * 50_000, "-1", "0x7fffffffffffffff", "[" + "1, " * 100_000 + "]",
]  # fmt: skip


@pytest.mark.parametrize("key", ["method", "lr", "zero-layer", "x" * 1000])
def test_every_hostile_value_in_an_experiment_is_one_line(key: str, tmp_path: Path) -> None:
    path = tmp_path / "grid.toml"
    method = "" if key == "method" else 'method = "paper"\n'
    texts = {value[:40]: f"[[runs]]\n{method}{key} = {value}\n" for value in TOML_VALUES}
    answers = try_all(texts, path.write_text, lambda: read_experiment(str(path)))
    assert all(answers[value] for value in ("nan", "inf", "9" * 40, "[[1]]", "{}", "1979-05-27"))


def test_grids_without_end_and_other_shapes_are_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "grid.toml"
    axis = "[" + ", ".join(map(str, range(1000))) + "]"
    axes = "\n".join(f"{key} = {axis}" for key in ("seed", "steps", "batch"))
    texts = {
        "a grid of a milliard": f'[[runs]]\nmethod = "paper"\n{axes}\n',
        "many blocks": '[[runs]]\nmethod = "paper"\n' * 20_000,
        "dotted keys": "a." * 50_000 + "a = 1\n",
        "a deep table": "[" + "a." * 20_000 + "a]\n",
        "runs is a table": "[runs]\nmethod = 1\n",
        "runs is text": 'runs = "x"\n',
        "runs of numbers": "runs = [1, 2]\n",
        "about is a list": 'about = []\n[[runs]]\nmethod = "paper"\n',
        "unknown key": 'abuot = ""\n[[runs]]\nmethod = "paper"\n',
    }
    answers = try_all(texts, path.write_text, lambda: read_experiment(str(path)))
    assert all(answers.values())
    assert "asks for 1000000000 runs; expected at most 1,000" in answers["a grid of a milliard"]


def test_a_scene_of_a_hundred_thousand_objects_is_refused_at_once(tmp_path: Path) -> None:
    save_scene(synthetic_scene(), tmp_path)
    path = tmp_path / "scene.json"
    data = json.loads(path.read_text())
    texts = {}
    for key, value in (("objects", data["objects"][0]), ("lights", {}), ("walk", data["cameras"]["walk"][0])):
        many = [value] * 100_000 if key == "objects" else [value] * 20_000
        changed = {**data, "cameras": {**data["cameras"], "walk": many}} if key == "walk" else {**data, key: many}
        texts[key] = json.dumps(changed)
    answers = try_all(texts, path.write_text, lambda: load_scene(tmp_path))
    assert all(answers.values())
