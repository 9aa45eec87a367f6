"""Tests `model fit` as a command, the folder of its stages, and what others make of the geometry that it writes."""

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
from datagen.disk.errors import HyalineError
from datagen.disk.records import commit_sealed, load_sealed
from datagen.scene.folder import open_scene
from datagen.scene.materials import Dielectric, Diffuse
from hyaline_photos.fit.fit import FitFolder
from hyaline_photos.fit.found import FoundGlass, write_geometry
from hyaline_photos.fit.hull import HullShape

FIT = "--unknown ball --steps 2 --skip grid --skip refine"


def done(words: str) -> str:
    """What a command that has to work says."""
    answer = call(words)
    assert answer.status == 0, answer.err
    return answer.err + answer.out


def train(root: Path, geometry: str, out: Path) -> str:
    """A command of the shortest training."""
    return f"model train light-path {root} --geometry {geometry} --steps 1 --batch 64 --device cpu --out {out}"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_traced_dataset(tmp_path_factory.mktemp("fit") / "glasses", resolution=16)


@pytest.fixture(scope="module")
def fitted(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fit of the ball; its pictures show no refraction, so that its material means nothing."""
    out = tmp_path_factory.mktemp("runs") / "fit"
    said = done(f"model fit {dataset.root} {FIT} --out {out}")
    assert f"next: model train light-path {dataset.root} --geometry fitted" in said
    return out


def test_the_geometry_has_the_ball_that_masks_show_and_all_else_as_it_is(dataset: Dataset, fitted: Path) -> None:
    truth, found = read_meshes(dataset, "truth"), read_meshes(dataset, "fitted")
    center, radius = BALL
    # Ten coarse views from above show its girth; a ball of the next pixel would be 20 % larger.
    assert np.linalg.norm((found[1].vertices - center)[:, :2], axis=1).max() == pytest.approx(radius, rel=0.08)
    for place in (0, 2, 3, 4):
        assert np.array_equal(found[place].vertices, truth[place].vertices)
    assert read_assignment(dataset, "fitted") == ("truth", "fitted", "truth", "truth", "truth")
    assert list(read_materials(dataset, "fitted")) == ["ball"]
    material = open_scene(dataset, "fitted").objects[1].material
    assert isinstance(material, Dielectric) and open_scene(dataset, "truth").objects[1].material != material
    (item,) = load_sealed(fitted / "fit.json")["objects"]
    ior = item["numbers"]["ior"]
    assert item["name"] == "ball" and item["unexplained"] < 0.05 and ior["low"] < ior["value"] < ior["high"]
    for name in ("room", "search"):
        assert np.asarray(Image.open(fitted / f"{name}.png")).std() > 10


def test_other_commands_take_the_geometry_and_runs_record_what_it_did_not_find(
    dataset: Dataset, fitted: Path, tmp_path: Path
) -> None:
    assert fitted.is_dir()
    skipped = "--unknown ball --steps 2 --skip grid --skip search --skip refine"
    done(f"model fit {dataset.root} {skipped} --room matt --name fitted-matt --out {tmp_path / 'fit'}")
    assert {"fitted", "fitted-matt"} <= set(list_geometries(dataset))
    glass = [item.name for item in dataset.objects if item.is_glass and item.name != "ball"]
    others = [item for item in open_scene(dataset, "truth").objects if not item.material.is_glass]
    assert sorted(read_materials(dataset, "fitted-matt")) == sorted(["ball", *(item.name for item in others)])
    shiny = [item.name for item in others if not isinstance(item.material, Diffuse)]
    assert glass and shiny
    for geometry, told in (("fitted", {*glass, *shiny}), ("fitted-matt", {*glass})):
        done(train(dataset.root, geometry, tmp_path / geometry))
        assert set(load_sealed(tmp_path / geometry / "run.json")["told"]) == told
    done(f"proxies check {dataset.root} --geometry fitted")
    done(f"datagen verify {dataset.root}")


def test_asked_again_it_keeps_what_was_found_and_other_wishes_are_refused(
    dataset: Dataset, fitted: Path, tmp_path: Path
) -> None:
    before, files = geometry_key(dataset, "fitted"), tree(dataset.root / "proxies")
    times = {path.name: path.stat().st_mtime_ns for path in fitted.glob("*.pt")}
    done(f"model fit {dataset.root} {FIT} --out {fitted}")
    assert {path.name: path.stat().st_mtime_ns for path in fitted.glob("*.pt")} == times
    (fitted / "outside.pt").write_bytes((fitted / "outside.pt").read_bytes()[:-100])
    assert "damaged" in done(f"model fit {dataset.root} {FIT} --out {fitted}")
    assert geometry_key(open_dataset(dataset.root), "fitted") == before
    slab = f"model fit {dataset.root} {FIT.replace('ball', 'slab')}"
    for words, why in (
        (f"--out {tmp_path / 'b'}", "fitted: holds a fit of ball, too; replace it with --overwrite"),
        (f"--out {fitted} --name fitted-slab", "holds a fit with another geometry"),
    ):
        answer = call(f"{slab} {words}")
        assert answer.status == 1 and why in answer.error
    assert not (tmp_path / "b").exists() and tree(dataset.root / "proxies") == files


def test_a_geometry_that_other_stages_replaced_ends_the_run_on_it_and_layers_follow_the_dataset(
    dataset: Dataset, fitted: Path, tmp_path: Path
) -> None:
    copy, out = Path(shutil.copytree(dataset.root, tmp_path / "copy")), shutil.copytree(fitted, tmp_path / "fit")
    fit, again = f"model fit {copy} {FIT} --out {out}", train(copy, "fitted", tmp_path / "run")
    done(again)
    done(f"datagen peel {copy} --num-layers 4 --overwrite")
    done(f"{fit} --skip search")
    assert geometry_key(open_dataset(copy), "fitted") != geometry_key(dataset, "fitted")
    answer = call(again)
    assert answer.status == 1 and f"{tmp_path / 'run'}: " in answer.error and "--overwrite" in answer.error
    assert open_dataset(copy).layer_store("fitted").head.num_layers == 4


@pytest.mark.parametrize(
    ("names", "flags", "why"),
    [
        (("ball",), "", "only unknown glass has a mesh; add meshes of"),
        (("floor", "pane"), "", "has no glass but thin panes"),
        (None, "--unknown bal", "no object 'bal'"),
        (None, "--unknown floor", "is opaque"),
        (None, "--name box", "--name"),
        (None, "--steps 0", "--steps"),
        (None, "--seed -1", "--seed: is -1"),
    ],
)
def test_what_cannot_be_fitted_is_one_line(
    dataset: Dataset, tmp_path: Path, names: tuple[str, ...] | None, flags: str, why: str
) -> None:
    if names is not None:
        scene = glass_scene()
        scene = dataclasses.replace(scene, objects=tuple(item for item in scene.objects if item.name in names))
        dataset = write_traced_dataset(tmp_path / "glasses", scene=scene, resolution=16)
    answer = call(f"model fit {dataset.root} {flags} --out {tmp_path / 'fit'}")
    assert answer.status != 0 and why in answer.error and not (tmp_path / "fit").exists()


def test_faces_that_a_search_flattened_are_left_out(dataset: Dataset) -> None:
    truth = read_meshes(dataset, "truth")
    flat = dataclasses.replace(truth[1], faces=np.concatenate([truth[1].faces, truth[1].faces[:1, [0, 0, 1]]]))
    glass = HullShape(surface=flat)
    write_geometry(dataset, "fitted-flat", truth, {}, {2: FoundGlass(glass=glass, unexplained=0.0)})
    assert len(read_meshes(dataset, "fitted-flat")[1].faces) == len(truth[1].faces)


def test_a_fit_that_is_resumed_keeps_what_it_found_and_a_damaged_record_is_replaced(tmp_path: Path) -> None:
    folder = FitFolder(root=tmp_path / "fit", asked={"seed": 1})
    head = folder.root / "fit.json"
    folder.begin(overwrite=False)
    folder.stage("room", "", lambda: {"seen": 1})
    commit_sealed(head, {**folder.head, "objects": ["ball"]})
    folder.begin(overwrite=False)
    assert load_sealed(head)["objects"] == ["ball"]
    head.write_bytes(head.read_bytes().replace(b"1", b"2", 1))
    with pytest.raises(HyalineError, match=r"fit\.json: "):
        folder.begin(overwrite=False)
    folder.begin(overwrite=True)
    assert load_sealed(head)["seed"] == 1 and "objects" not in load_sealed(head)
    assert not (folder.root / "room.pt").exists()
