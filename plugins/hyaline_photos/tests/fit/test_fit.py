"""Tests `model fit` as a command, and what others make of the geometry that it writes."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.builds import tree
from support.commands import call
from support.traced_dataset import BALL, glass_scene, write_traced_dataset

from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import geometry_key, list_geometries, read_assignment, read_materials, read_meshes
from datagen.disk.records import load_sealed
from datagen.scene.folder import open_scene
from datagen.scene.materials import Dielectric, Diffuse
from hyaline_photos.fit.found import FoundGlass, write_geometry
from hyaline_photos.fit.hull import HullShape

FIT = "--unknown ball --steps 2 --skip grid --skip again"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("fit") / "glasses", resolution=24)


@pytest.fixture(scope="module")
def fitted(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fit of the ball; its pictures show no refraction, so that its material means nothing."""
    out = tmp_path_factory.mktemp("runs") / "fit"
    answer = call(f"model fit {dataset.root} {FIT} --out {out}")
    assert answer.status == 0, answer.err
    assert f"next: model train light-path {dataset.root} --geometry fitted" in answer.err + answer.out
    return out


def test_the_geometry_has_the_ball_that_masks_show_and_all_else_as_it_is(dataset: Dataset, fitted: Path) -> None:
    assert fitted.is_dir()
    truth, found = read_meshes(dataset, "truth"), read_meshes(dataset, "fitted")
    center, radius = BALL
    # Ten coarse views from above show its girth.
    assert np.linalg.norm((found[1].vertices - center)[:, :2], axis=1).max() == pytest.approx(radius, rel=0.08)
    for place in (0, 2, 3, 4):
        assert np.array_equal(found[place].vertices, truth[place].vertices)
    assert read_assignment(dataset, "fitted") == ("truth", "fitted", "truth", "truth", "truth")
    material = open_scene(dataset, "fitted").objects[1].material
    assert isinstance(material, Dielectric)
    assert list(read_materials(dataset, "fitted")) == ["ball"]
    assert open_scene(dataset, "truth").objects[1].material != material


def test_its_record_and_pictures_say_what_was_found(fitted: Path) -> None:
    record = load_sealed(fitted / "fit.json")
    (item,) = record["objects"]
    assert item["name"] == "ball"
    ior = item["numbers"]["ior"]
    assert ior["low"] < ior["value"] < ior["high"]
    assert item["unexplained"] < 0.05
    for name in ("room", "search"):
        assert np.asarray(Image.open(fitted / f"{name}.png")).std() > 10


def test_other_commands_take_the_geometry(dataset: Dataset, fitted: Path, tmp_path: Path) -> None:
    assert fitted.is_dir()
    assert "fitted" in list_geometries(dataset)
    check = call(f"proxies check {dataset.root} --geometry fitted")
    assert check.status == 0, check.err
    run = tmp_path / "run"
    for words in (
        f"model train light-path {dataset.root} --geometry fitted --steps 2 --batch 64 --device cpu --out {run}",
        f"model export {run} --out {tmp_path / 'page.html'}",
        f"datagen verify {dataset.root}",
    ):
        answer = call(words)
        assert answer.status == 0, answer.err


def test_runs_record_what_a_fit_did_not_find_itself(dataset: Dataset, fitted: Path, tmp_path: Path) -> None:
    assert fitted.is_dir()
    skipped = "--steps 2 --skip grid --skip search --skip again"
    answer = call(
        f"model fit {dataset.root} {skipped} --unknown ball --room matt --name fitted-matt --out {tmp_path / 'fit'}"
    )
    assert answer.status == 0, answer.err
    glass = [item.name for item in dataset.objects if item.is_glass and item.name != "ball"]
    others = [item.name for item in dataset.objects if not item.is_glass]
    assert sorted(read_materials(dataset, "fitted-matt")) == sorted(["ball", *others])
    shiny = [
        item.name
        for item in open_scene(dataset, "truth").objects
        if not item.material.is_glass and not isinstance(item.material, Diffuse)
    ]
    assert glass and shiny
    for method, geometry, told in (
        ("light-path", "fitted", {*glass, *shiny}),
        ("light-path", "fitted-matt", {*glass}),
        ("paper", "fitted", {*glass}),
        ("light-path", "truth", set[str]()),
    ):
        run = tmp_path / f"{method}-{geometry}"
        words = f"--geometry {geometry} --steps 1 --batch 64 --device cpu --out {run}"
        answer = call(f"model train {method} {dataset.root} {words}")
        assert answer.status == 0, answer.err
        assert set(load_sealed(run / "run.json")["told"]) == told


def test_a_fit_of_other_glass_does_not_replace_what_was_found(dataset: Dataset, fitted: Path, tmp_path: Path) -> None:
    before = tree(dataset.root / "proxies")
    answer = call(f"model fit {dataset.root} --unknown slab --steps 2 --skip grid --skip search --out {tmp_path / 'b'}")
    assert answer.status == 1 and "fitted: holds a fit of ball, too; replace it with --overwrite" in answer.error
    assert fitted.is_dir() and not (tmp_path / "b").exists() and tree(dataset.root / "proxies") == before


def test_asked_again_it_keeps_what_was_found_and_other_wishes_are_refused(dataset: Dataset, fitted: Path) -> None:
    before = geometry_key(dataset, "fitted")
    times = {path.name: path.stat().st_mtime_ns for path in fitted.glob("*.pt")}
    again = call(f"model fit {dataset.root} {FIT} --out {fitted}")
    assert again.status == 0, again.err
    assert {path.name: path.stat().st_mtime_ns for path in fitted.glob("*.pt")} == times
    assert geometry_key(open_dataset(dataset.root), "fitted") == before
    (fitted / "search.pt").write_bytes((fitted / "search.pt").read_bytes()[:-100])
    assert "damaged" in call(f"model fit {dataset.root} {FIT} --out {fitted}").err
    assert geometry_key(open_dataset(dataset.root), "fitted") == before
    other = call(f"model fit {dataset.root} {FIT.replace('ball', 'slab')} --out {fitted}")
    assert other.status == 1
    assert "holds a fit of ball, too" in other.error
    other = call(f"model fit {dataset.root} {FIT.replace('ball', 'slab')} --out {fitted} --name fitted-slab")
    assert "holds a fit with another geometry" in other.error


def test_a_geometry_that_other_stages_replaced_ends_the_run_on_it(
    dataset: Dataset, fitted: Path, tmp_path: Path
) -> None:
    copy, out = Path(shutil.copytree(dataset.root, tmp_path / "copy")), shutil.copytree(fitted, tmp_path / "fit")
    fit = f"model fit {copy} {FIT} --out {out}"
    train = (
        f"model train light-path {copy} --geometry fitted --steps 2 --batch 64 --device cpu --out {tmp_path / 'run'}"
    )
    assert call(train).status == 0
    searched = geometry_key(open_dataset(copy), "fitted")
    assert call(f"{fit} --skip search").status == 0
    assert geometry_key(open_dataset(copy), "fitted") != searched
    assert call(f"datagen verify {copy}").status == 0
    answer = call(train)
    assert answer.status == 1
    assert (
        "was trained on another geometry or number of layers than is there now; restore that, or train again"
        in answer.error
    )
    assert (tmp_path / "fit" / "search.pt").exists()
    assert call(f"{fit} --skip search --seed 1 --overwrite").status == 0
    assert not (tmp_path / "fit" / "search.pt").exists()


def test_layers_of_a_fit_follow_those_of_the_dataset(dataset: Dataset, fitted: Path, tmp_path: Path) -> None:
    copy, out = Path(shutil.copytree(dataset.root, tmp_path / "copy")), shutil.copytree(fitted, tmp_path / "fit")
    assert call(f"datagen peel {copy} --num-layers 4 --overwrite").status == 0
    answer = call(f"model fit {copy} {FIT} --out {out}")
    assert answer.status == 0, answer.err
    assert open_dataset(copy).layer_store("fitted").head.num_layers == 4


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (("ball",), "only unknown glass has a mesh; add meshes of"),
        (("floor", "pane"), "its only glass is thin panes (pane), which are not fitted"),
        (("floor",), "has no object of glass"),
    ],
)
def test_scenes_without_glass_to_fit_or_without_anything_around_it_are_refused(
    tmp_path: Path, names: tuple[str, ...], why: str
) -> None:
    scene = glass_scene()
    scene = dataclasses.replace(scene, objects=tuple(item for item in scene.objects if item.name in names))
    dataset = write_traced_dataset(tmp_path / "glasses", scene=scene, resolution=24)
    answer = call(f"model fit {dataset.root} --out {tmp_path / 'fit'}")
    assert answer.status == 1
    assert why in answer.error
    assert not (tmp_path / "fit").exists()


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        ("--unknown bal", "no object 'bal'"),
        ("--unknown floor", "is opaque"),
        ("--name box", "--name"),
        ("--steps 0", "--steps"),
        ("--seed -1", "--seed: is -1"),
    ],
)
def test_what_cannot_be_fitted_is_one_line(dataset: Dataset, tmp_path: Path, flags: str, why: str) -> None:
    unknown = "" if "unknown" in flags else "--unknown ball"
    answer = call(f"model fit {dataset.root} {unknown} {flags} --out {tmp_path / 'fit'}")
    assert answer.status != 0
    assert why in answer.error


def test_faces_that_a_search_flattened_are_left_out(dataset: Dataset) -> None:
    truth = read_meshes(dataset, "truth")
    flat = dataclasses.replace(truth[1], faces=np.concatenate([truth[1].faces, truth[1].faces[:1, [0, 0, 1]]]))
    glass = HullShape(surface=flat)
    write_geometry(dataset, "fitted-flat", truth, {}, {2: FoundGlass(glass=glass, unexplained=0.0)})
    assert len(read_meshes(dataset, "fitted-flat")[1].faces) == len(truth[1].faces)
