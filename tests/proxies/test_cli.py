"""Tests of the command `proxies`: what it writes, keeps, makes anew and refuses."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import call
from support.synthetic import write_synthetic_dataset

from datagen.data.config import Variant
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import describe_geometry, list_geometries, read_meshes, read_proxy_records
from datagen.disk.errors import HyalineError
from datagen.disk.records import load_sealed
from proxies.make import make_proxies

ONE = Path("data/one")


@pytest.fixture(autouse=True)
def peeled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """A dataset in the working directory, and the calls of a stand-in for the peeler, which needs Mitsuba."""
    calls: list[dict[str, Any]] = []

    def peel_dataset(dataset: Dataset, geometry: str, **settings: object) -> None:
        read_meshes(dataset, geometry)
        calls.append({"root": dataset.root, "geometry": geometry, **settings})

    monkeypatch.setattr("proxies.make.peel_dataset", peel_dataset)
    monkeypatch.setattr("proxies.make.peel_variants", lambda dataset, *, workers: None)
    monkeypatch.chdir(tmp_path)
    write_synthetic_dataset(ONE, resolution=8, train_views=1)
    return calls


@pytest.mark.parametrize("kind", ["box", "ellipsoid", "hull"])
def test_make_writes_the_proxies_peels_them_and_prints_the_table(kind: str, peeled: list[dict[str, Any]]) -> None:
    made = call(f"proxies make one --kind {kind} --num-layers 3")
    assert [line.split()[:2] for line in made.out.splitlines() if "100 %" in line] == [["pane", kind], ["floor", kind]]
    assert f"model train paper data/one --geometry {kind}" in made.err
    assert [(item["geometry"], item["num_layers"], item["overwrite"]) for item in peeled] == [(kind, 3, False)]
    assert load_sealed(ONE / "proxies" / kind / "proxies.json")["kind"] == kind
    assert call(f"proxies check data/one --geometry {kind}").out == made.out


def test_a_second_run_keeps_the_files_and_overwrite_makes_the_same_bytes(peeled: list[dict[str, Any]]) -> None:
    call("proxies make")
    files = sorted((ONE / "proxies").rglob("*.*"))
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}
    assert "keeps its ellipsoid proxies" in call("proxies make").err
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files} == before
    call("proxies make --overwrite")
    assert all(path.stat().st_mtime_ns != before[path][0] for path in files)
    assert {path: path.read_bytes() for path in files} == {path: data for path, (_, data) in before.items()}
    assert [item["overwrite"] for item in peeled] == [False, False, True]


def test_a_mixture_gives_each_object_the_proxy_that_its_kind_alone_gives(peeled: list[dict[str, Any]]) -> None:
    dataset = open_dataset(ONE)
    mixture = "proxies make --assign *=hull --assign pa*=ellipsoid --assign floor=box"
    made = call(mixture)
    assert "model train paper data/one --geometry mixed" in made.err
    assert [item["geometry"] for item in peeled] == ["mixed"]
    rows = [line.split()[:2] for line in made.out.splitlines() if "mm" in line]
    assert rows == [["pane", "ellipsoid"], ["floor", "box"]]
    call("proxies make --name mixed-floor --assign floor=box")
    for name, kind in {"pane": "ellipsoid", "floor": "box"}.items():
        call(f"proxies make --kind {kind}")
        one, other = ((ONE / "proxies" / geometry / f"meshes/{name}.ply").read_bytes() for geometry in ("mixed", kind))
        assert one == other
    mesh, truth = read_meshes(dataset, "mixed-floor")[0], read_meshes(dataset, "truth")[0]
    np.testing.assert_array_equal(mesh.vertices, truth.vertices)
    np.testing.assert_array_equal(mesh.uv, truth.uv)
    pane, floor = (record.statistics for record in read_proxy_records(dataset, "mixed-floor"))
    assert pane and floor and pane.mean_distance == pane.max_distance == 0 < floor.mean_distance
    words = "proxy geometry (mixed-floor: box for floor; truth for the rest)"
    assert describe_geometry(dataset, "mixed-floor") == words
    assert describe_geometry(dataset, "ellipsoid") == "proxy geometry (ellipsoid)"
    assert "keeps its mixed proxies" in call(mixture).err
    call("proxies check --geometry mixed")
    assert "has a box for floor, not truth; pass --overwrite" in call("proxies make --assign pane=ellipsoid").err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("make --kind elipsoid", 2, "invalid choice 'elipsoid' for argument '--kind'"),
        ("make missing", 1, "data/missing: no dataset; there is data/one"),
        ("make --assign pain=box", 2, "no object 'pain'; did you mean 'pane'?"),
        ("make --assign pane=bx", 2, "no kind 'bx'; did you mean 'box'?"),
        ("make --assign pane", 1, "assign 'pane': expected OBJECT=KIND"),
        ("make --kind box --assign pane=box", 2, "--kind does not go with --assign"),
        ("make --name mixed-b", 2, "--name needs it"),
        ("make --name shelf --assign pane=box", 1, "name 'shelf': expected mixed"),
        ("check --geometry truth", 2, "no geometry 'truth'; choose from box"),
        ("check --geometry mixed", 1, "no mixed proxies; make them with `proxies make --help`"),
        ("check", 1, "no ellipsoid proxies; make them with `proxies make --kind ellipsoid`"),
    ],
)
def test_errors_are_one_line_with_the_way_out(arguments: str, code: int, message: str) -> None:
    answer = call(f"proxies {arguments}")
    assert (answer.status, answer.out, answer.err.count("error: ")) == (code, "", 1)
    assert message in answer.err


def test_proxies_of_another_dataset_are_refused() -> None:
    call("proxies make --kind box")
    write_synthetic_dataset(Path("data/two"), resolution=8, train_views=2)
    (ONE / "proxies").rename("data/two/proxies")
    assert "of another dataset" in call("proxies make two --kind box").err
    assert call("proxies make two --kind box --overwrite").status == 0


def test_a_variant_shares_the_proxies_of_its_dataset() -> None:
    dataset = open_dataset(ONE)
    variant = dataclasses.replace(dataset, variant=Variant(of=dataset.seal, splits=("extrapolating",), edit=None))
    with pytest.raises(HyalineError, match="is a variant; make proxies of the dataset around it"):
        make_proxies(variant, "box")
    assert list_geometries(dataset) == ["truth"]
