"""Tests that other distributions add to each table of plug-ins: the examples of the guides, and what goes wrong."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from support.commands import call
from support.plugins import install, install_from_guide
from support.synthetic import write_synthetic_dataset

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import open_dataset
from datagen.disk.errors import HyalineError
from datagen.scene.folder import load_scene, scene_files
from hyaline_export.formats import FORMATS
from hyaline_random.drawing import draw_scene
from hyaline_random.names import FAMILIES, RandomName, parse_random

OFF = "OFF\n4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
ROOT = Path(__file__).resolve().parents[2]
GROUPS = ("exports", "tables", "methods", "random_families", "scene_readers", "dataset_readers")


@pytest.fixture
def guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Installs examples of guides, and goes to an empty folder."""
    place, modules = tmp_path / "installed", []
    place.mkdir()
    monkeypatch.syspath_prepend(place)
    monkeypatch.setenv("PYTHONPATH", str(place))
    monkeypatch.chdir(tmp_path)
    yield lambda page: modules.extend(install_from_guide(place, page))
    for module in modules:
        sys.modules.pop(module, None)


def test_a_reader_of_a_scene_reads_a_file_of_its_ending(guide: Callable[..., None], tmp_path: Path) -> None:
    guide("A reader")
    Path("prism.off").write_text(OFF)
    answer = call("datagen import prism.off --material glass --scale 0.1")
    assert answer.status == 0, answer.err
    assert "prism.off: has no unit; taken for metres" in answer.err
    scene = load_scene(tmp_path / "scenes" / "prism")
    (prism,) = [item for item in scene.objects if item.name == "prism"]
    assert prism.material.is_glass and len(prism.mesh.faces) == 4
    Path("cut.off").write_text(OFF[:-8])
    assert call("datagen import cut.off").error.startswith("error: cut.off: cannot be read as OFF (")


def test_what_one_distribution_exports_another_imports(guide: Callable[..., None], tmp_path: Path) -> None:
    guide("An export")
    guide("A reader")
    before = write_synthetic_dataset(tmp_path / "data" / "one")
    assert call("datagen export one --format csv").status == 0
    answer = call("datagen import-dataset exports/one-csv --out data/two")
    assert answer.status == 0, answer.err
    after = open_dataset(tmp_path / "data" / "two")
    assert after.imported is not None and after.imported.layout == "csv"
    for split in TEST_SPLITS:
        np.testing.assert_array_equal(after.view(split, 1).image, before.view(split, 1).image)
        poses = (dataset.cameras(split).world_from_camera for dataset in (after, before))
        np.testing.assert_allclose(*poses, atol=1e-12)


def test_a_family_is_drawn_by_its_name_and_changes_no_other_scene(guide: Callable[..., None]) -> None:
    names = [str(RandomName(seed=seed)) + RandomName(seed=seed).family for seed in range(6)]
    assert parse_random("random-marbles-0007") is None
    guide("A family of random scenes")
    assert FAMILIES.names()[-1] == "marbles"
    meant = parse_random("random-marbles-0007")
    assert meant == RandomName(seed=7, chosen="marbles")
    first, again = draw_scene(meant).scene, draw_scene(meant).scene
    assert first.name == "random-marbles-0007" and 3 <= sum("marble" in item.name for item in first.objects) <= 6
    assert scene_files(first) == scene_files(again)
    assert [str(RandomName(seed=seed)) + RandomName(seed=seed).family for seed in range(6)] == names


def test_a_table_is_printed_beside_those_of_the_paper(guide: Callable[..., None], tmp_path: Path) -> None:
    guide("A table")
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic", resolution=8, train_views=1)
    for name, size in (("large", 2000), ("small", 1000)):
        run = tmp_path / "runs" / "synthetic" / name
        for split in TEST_SPLITS:
            shutil.copytree(dataset.root / "images" / split, run / "predictions" / split)
        record = {"dataset": str(dataset.root), "dataset_seal": dataset.seal, "method": name, "num_parameters": size}
        (run / "run.json").write_text(json.dumps(record))
    answer = call("report --table sizes --format markdown")
    assert answer.status == 0, answer.err
    cells = [[cell.strip() for cell in line.split("|")] for line in answer.out.splitlines()]
    rows = [row[1:5] for row in cells if len(row) > 4 and row[1] in ("large", "small")]
    assert rows == [["small", "1,000", "∞", "∞"], ["large", "2,000", "∞", "∞"]]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("raise RuntimeError('no GPU')", "cannot be imported (RuntimeError: no GPU)"),
        ("CSV = 3", "is not a Format; see docs/extending.md"),
    ],
)
def test_a_broken_plugin_is_one_line_that_names_its_distribution(
    guide: Callable[..., None], tmp_path: Path, source: str, message: str
) -> None:
    guide("An export")
    (tmp_path / "installed" / "csv_export.py").write_text(source)
    write_synthetic_dataset(tmp_path / "data" / "one", train_views=1)
    answer = call("datagen export one --format csv")
    assert answer.status == 1 and answer.err.count("\n") == 1
    assert answer.err.startswith(f"error: format 'csv': csv_export:CSV of csv-export {message}")
    assert "did you mean 'csv'?" in call("datagen export one --format csw").error


def test_two_distributions_of_one_name_are_named(guide: Callable[..., None], tmp_path: Path) -> None:
    guide("An export")
    install(tmp_path / "installed", "hyaline.exports", "csv", "other_tables:plan", "")
    with pytest.raises(HyalineError, match=r"format 'csv': two distributions bring it \((csv-export|other-tables), "):
        FORMATS.find("csv")
    install(tmp_path / "installed", "hyaline.random_families", "table", "my_tables:FAMILY", "")
    with pytest.raises(HyalineError, match=r"family 'table': two distributions bring it \(hyaline-glass, my-tables\)"):
        FAMILIES.names()


def test_no_name_imports_a_module_of_the_working_folder(tmp_path: Path) -> None:
    for group in GROUPS:
        module = f"evil_{group}"
        install(tmp_path, f"hyaline.{group}", "evil", f"{module}:evil", f"open('MARK-{module}', 'w')\n")
    (tmp_path / "evil.py").write_text("open('MARK-evil', 'w')\n")
    (tmp_path / "scene.evil").write_text("")
    (tmp_path / "evil").mkdir()
    write_synthetic_dataset(tmp_path / "data" / "one", train_views=1)
    lines = (
        *("datagen export one --format evil:evil", "report --table evil"),
        *("datagen import scene.evil", "datagen import-dataset evil", "model check-method evil"),
        "datagen build --scene random-evil-0001",
    )
    # As in an installed program, the working folder is not among the paths that modules are imported from (-P).
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    code = (
        "import json, sys; from support.commands import call;"
        "print(json.dumps([[line, answer.status, answer.err] for line in sys.argv[1:] for answer in [call(line)]]))"
    )
    child = subprocess.run(
        [sys.executable, "-P", "-c", code, *lines], cwd=tmp_path, env=environment, capture_output=True, check=True
    )
    for line, status, said in json.loads(child.stdout):
        assert status in (1, 2) and said.startswith("error: "), (line, said)
    assert not list(tmp_path.glob("MARK-*"))


@pytest.mark.parametrize(("line", "choice"), [("datagen build", "nested"), ("datagen export", "bop-sensor")])
def test_help_shows_the_choices_that_plug_ins_bring(line: str, choice: str) -> None:
    assert choice in "".join(call(f"{line} --help").out.split())
