"""Tests of the command `proxies`: what it writes, keeps, makes anew and refuses."""

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.synthetic import write_synthetic_dataset

from datagen.data.config import Variant
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import describe_geometry, list_geometries, read_meshes, read_proxy_records
from datagen.disk.errors import HyalineError
from datagen.disk.storage import load_sealed
from proxies.cli import main
from proxies.make import make_proxies
from proxies.meshing import meshlab
from proxies.spec import FITTERS, ProxySpec


@pytest.fixture
def peeled(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Stands in for the peeler, which needs Mitsuba, and for pymeshlab, which needs a process; lists the calls."""
    calls: list[dict[str, Any]] = []

    def peel_dataset(dataset: Dataset, geometry: str, **settings: object) -> None:
        read_meshes(dataset, geometry)
        calls.append({"root": dataset.root, "geometry": geometry, **settings})

    monkeypatch.setattr("proxies.make.peel_dataset", peel_dataset)
    monkeypatch.setattr("proxies.make.peel_variants", lambda dataset, *, workers: None)
    monkeypatch.setattr(meshlab, "meshlab_problem", lambda: "left out")
    monkeypatch.setattr("proxies.make.meshlab_problem", lambda: None)
    return calls


@pytest.fixture
def here(tmp_path: Path) -> Path:
    write_synthetic_dataset(tmp_path / "data" / "one", resolution=8, train_views=1)
    return tmp_path


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["proxies", *arguments])
    main()


@pytest.mark.parametrize("kind", [kind for kind in FITTERS if kind not in ("wrap", "lowpoly")])
def test_make_writes_the_proxies_peels_them_and_prints_the_table(
    kind: str, here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    call(monkeypatch, "make", "--dataset", "one", "--kind", kind, "--num-layers", "3")
    out, err = capsys.readouterr()
    assert [line.split()[0] for line in out.splitlines() if "100 %" in line] == ["pane", "floor"]
    assert f"model train paper data/one --geometry {kind}" in err
    assert [(item["geometry"], item["num_layers"], item["overwrite"]) for item in peeled] == [(kind, 3, False)]
    content = load_sealed(here / "data/one/proxies" / kind / "proxies.json")
    assert content["kind"] == kind
    call(monkeypatch, "check", "--dataset", "data/one", "--kind", kind)
    assert capsys.readouterr().out == out


def test_a_second_run_keeps_the_files_and_overwrite_makes_the_same_bytes(
    here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    call(monkeypatch, "make")
    files = sorted((here / "data/one/proxies").rglob("*.*"))
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}
    call(monkeypatch, "make")
    assert "keeps its ellipsoid proxies" in capsys.readouterr().err
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files} == before
    call(monkeypatch, "make", "--overwrite")
    assert all(path.stat().st_mtime_ns != before[path][0] for path in files)
    assert {path: path.read_bytes() for path in files} == {path: data for path, (_, data) in before.items()}
    assert [item["overwrite"] for item in peeled] == [False, False, True]


def test_check_compares_surfaces_when_asked(
    here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    call(monkeypatch, "make", "--assign", "pane=noise")
    kept = capsys.readouterr().out
    call(monkeypatch, "check", "--name", "mixed")
    assert capsys.readouterr().out == kept
    call(monkeypatch, "check", "--name", "mixed", "--shapes")
    more = capsys.readouterr().out.removeprefix(kept)
    (row,) = [line for line in more.splitlines() if " mm " in line]  # The floor is its own mesh.
    name, chamfer, _, distance, *_ = row.split()
    assert name == "pane" and 0 < float(chamfer) < 100 and 0 < float(distance) < 100 and "°" in row


def test_a_damaged_mesh_is_made_again(
    here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    call(monkeypatch, "make", "--kind", "box")
    path = here / "data/one/proxies/box/meshes/floor.ply"
    good = path.read_bytes()
    path.write_bytes(good[:-20] + b" " + good[-19:])
    call(monkeypatch, "make", "--kind", "box")
    assert "making them again" in capsys.readouterr().err
    assert path.read_bytes() == good


@pytest.mark.parametrize("kind", ["wrap", "lowpoly"])
def test_a_wrap_without_pymeshlab_is_one_line_and_leaves_nothing(
    kind: str, here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    with pytest.raises(SystemExit):
        call(monkeypatch, "make", "--kind", kind)
    err = capsys.readouterr().err
    assert f"a {kind} needs pymeshlab: left out, or make `--kind hull`" in err
    assert err.count("\n") == 2 and err.count("error: ") == 1  # What it is at comes first.
    assert list_geometries(open_dataset(here / "data/one")) == ["truth"]
    assert peeled == []


def test_amounts_of_noise_stand_side_by_side(
    here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    dataset = open_dataset(here / "data/one")
    call(monkeypatch, "make", "--kind", "noise", "--amount", "0.002")
    call(monkeypatch, "make", "--kind", "noise")
    out, err = capsys.readouterr()
    assert "model train paper data/one --geometry noise-0.002" in err
    assert [line.split()[0] for line in out.splitlines() if line.rstrip().endswith("-")] == ["pane", "floor"] * 2
    assert [item["geometry"] for item in peeled] == ["noise-0.002", "noise-0.01"]
    assert list_geometries(dataset) == ["truth", "noise-0.002", "noise-0.01"]
    truths = read_meshes(dataset, "truth")
    small, large = (read_meshes(dataset, geometry) for geometry in ("noise-0.002", "noise-0.01"))
    for truth, near, far in zip(truths, small, large, strict=True):
        # The same field, five times as far.
        np.testing.assert_allclose(far.vertices - truth.vertices, 5 * (near.vertices - truth.vertices), atol=1e-6)
    call(monkeypatch, "check", "--kind", "noise", "--amount", "0.002")


def test_a_mixture_gives_each_object_the_proxy_that_its_kind_alone_gives(
    here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    dataset = open_dataset(here / "data/one")
    mixture = ("make", "--assign", "pa*=ellipsoid", "--assign", "floor=noise-0.02")
    call(monkeypatch, *mixture)
    out, err = capsys.readouterr()
    assert "model train paper data/one --geometry mixed" in err
    assert [item["geometry"] for item in peeled] == ["mixed"]
    assert [line.split()[:2] for line in out.splitlines() if "mm" in line] == [
        ["pane", "ellipsoid"],
        ["floor", "noise-0.02"],
    ]
    call(monkeypatch, "make", "--kind", "ellipsoid")
    call(monkeypatch, "make", "--kind", "noise", "--amount", "0.02")
    call(monkeypatch, "make", "--name", "mixed-floor", "--assign", "floor=box")
    meshes = here / "data/one/proxies"
    for name, kind in {"pane": "ellipsoid", "floor": "noise-0.02"}.items():
        same = [(meshes / geometry / f"meshes/{name}.ply").read_bytes() for geometry in ("mixed", kind)]
        assert same[0] == same[1]
    for mesh, truth in zip(read_meshes(dataset, "mixed-floor")[:1], read_meshes(dataset, "truth")[:1], strict=True):
        np.testing.assert_array_equal(mesh.vertices, truth.vertices)
        np.testing.assert_array_equal(mesh.uv, truth.uv)
    pane, floor = (record.statistics for record in read_proxy_records(dataset, "mixed-floor"))
    assert pane.mean_distance == pane.max_distance == 0 < floor.mean_distance

    assert (
        describe_geometry(dataset, "mixed-floor") == "proxy geometry (mixed-floor: box for floor; truth for the rest)"
    )
    assert describe_geometry(dataset, "ellipsoid") == "proxy geometry (ellipsoid)"
    call(monkeypatch, *mixture)
    assert "keeps its mixed proxies" in capsys.readouterr().err
    call(monkeypatch, "check", "--name", "mixed")
    with pytest.raises(SystemExit):
        call(monkeypatch, "make", "--assign", "pane=ellipsoid")
    assert (
        "mixed: has a noise-0.02 for floor, not truth; pass --overwrite, or another --name" in capsys.readouterr().err
    )


def test_without_a_scene_every_dataset_gets_proxies(
    here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    two = write_synthetic_dataset(here / "data" / "two", resolution=8, train_views=2)
    call(monkeypatch, "make", "--kind", "box")
    assert [item["root"] for item in peeled] == [Path("data/one"), Path("data/two")]
    assert [record.object for record in read_proxy_records(two, "box")] == ["pane", "floor"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("make", "--kind", "elipsoid"),
            "invalid choice 'elipsoid' for argument '--kind'. Expected one of ('box', 'ellipsoid', 'hull', ",
        ),
        (
            ("make", "--kind", "noise", "--amount", "0.2"),
            "amount 0.2: expected 0.001 to 0.05, relative to each object's",
        ),
        (("make", "--kind", "box", "--amount", "0.01"), "amount 0.01: box has no noise; use it with `--kind noise`"),
        (("check", "--kind", "noise"), "no noise-0.01 proxies; make them with `proxies make`"),
        (("make", "--dataset", "missing"), "data/missing: no dataset; there is data/one"),
        (("make", "--assign", "pain=box"), "no object 'pain'; did you mean 'pane'?"),
        (("make", "--assign", "pane=bx"), "no kind 'bx'; did you mean 'box'?"),
        (("make", "--assign", "pane"), "assign 'pane': expected OBJECT=KIND, such as fern=ellipsoid"),
        (("make", "--assign", "*=box", "--assign", "pane=hull"), "assign 'pane=hull': pane already has box; expected"),
        (("make", "--kind", "box", "--assign", "pane=box"), "--kind box: does not go with --assign"),
        (("make", "--amount", "0.02", "--assign", "pane=box"), "--amount 0.02: does not go with --assign"),
        (("check", "--kind", "box", "--name", "mixed"), "--kind, --amount: do not go with --name; leave them out"),
        (("check", "--amount", "0.02", "--name", "mixed"), "--kind, --amount: do not go with --name; leave them out"),
        (("check", "--name", "truth"), "no geometry 'truth'; choose from blocks, box"),
        (("make", "--rest", "box"), "--rest, --name: go with --assign OBJECT=KIND; leave them out"),
        (("make", "--name", "shelf", "--assign", "pane=box"), "name 'shelf': expected mixed, or mixed- and letters"),
        (
            ("make", "--assign", "pane=noise-much"),
            "kind 'noise-much': 'much' is not a number; expected noise-0.01 or similar",
        ),
        (
            ("check", "--name", "mixed"),
            "no mixed proxies; make them with `proxies make`",
        ),
        (("check", "--kind", "box"), "no box proxies; make them with `proxies make`"),
    ],
)
def test_errors_are_one_line_with_the_way_out(
    arguments: tuple[str, ...], message: str, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    with pytest.raises(SystemExit) as stop:
        call(monkeypatch, *arguments)
    words = ("--assign", "go with", "invalid choice", "no object '", "no kind '", "no geometry '")
    is_usage = any(word in message for word in words) and "make them" not in message
    assert stop.value.code == (2 if is_usage else 1)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert message in err


def test_a_half_built_dataset_is_one_line(
    here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    (here / "data/one/scene/meshes/floor.ply").unlink()
    with pytest.raises(SystemExit):
        call(monkeypatch, "make", "--dataset", "one")
    err = capsys.readouterr().err
    assert "floor.ply: the file is missing; run the command that made it again, which keeps what is whole" in err
    assert err.count("\n") == 2 and err.count("error: ") == 1  # What it is at comes first.
    assert not (here / "data/one/proxies/ellipsoid/proxies.json").exists()


def test_proxies_of_another_dataset_are_refused(
    here: Path, peeled: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    call(monkeypatch, "make", "--kind", "box")
    write_synthetic_dataset(here / "data" / "two", resolution=8, train_views=2)
    (here / "data/one/proxies").rename(here / "data/two/proxies")
    with pytest.raises(SystemExit):
        call(monkeypatch, "make", "--dataset", "two", "--kind", "box")
    assert "made for another dataset" in capsys.readouterr().err
    call(monkeypatch, "make", "--dataset", "two", "--kind", "box", "--overwrite")


def test_help_answers_before_anything_heavy_is_imported() -> None:
    code = (
        "import sys; sys.argv = ['proxies', 'make', '--help']\n"
        "from proxies.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'scipy', 'trimesh', 'pymeshlab', 'mitsuba', 'torch', 'model', 'eval'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)\n"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    assert "--kind" in answer.stdout


def test_fitting_imports_neither_renderer_nor_network() -> None:
    heavy = {"mitsuba", "torch", "model", "eval", "pymeshlab"}
    code = f"import sys, proxies.make; sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_variant_shares_the_proxies_of_its_dataset(here: Path) -> None:
    dataset = open_dataset(here / "data" / "one")
    variant = dataclasses.replace(dataset, variant=Variant(of=dataset.seal, splits=("extrapolating",), edit=None))
    with pytest.raises(HyalineError, match="is a variant; make proxies of the dataset around it"):
        make_proxies(variant, ProxySpec(kind="box"), overwrite=False)
    assert list_geometries(dataset) == ["truth"]
