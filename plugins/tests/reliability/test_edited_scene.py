"""Tests that no command uses a dataset's scene, proxies or fitted glass after somebody has edited their files."""

import dataclasses
import itertools
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import call, run
from support.fits import write_fit
from support.traced_dataset import glass_scene, write_traced_dataset

from datagen.data.images import png_bytes
from datagen.data.ply import read_ply, write_ply
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.materials import ImageTexture, Plastic
from model.methods.light_path.pixels import _load_surfaces

pytestmark = pytest.mark.promise("R4")

DATA = Path("data/one")
SIZE = "--steps 2 --batch 32 --texture-size 8 --device cpu"
TRAIN = f"model train light-path {DATA} {SIZE}"
RUN = "runs/one/light-path"
FILM = "--path orbit --frames 2 --width 8"

READ_MATERIALS = (
    f"datagen verify {DATA}",
    f"{TRAIN} --out runs/one/again",
    f"model predict {RUN} --device cpu --overwrite",
    f"model film {RUN} {FILM} --device cpu --out film.webp",
    f"model export {RUN} --out page.html",
    f"model fit {DATA} --unknown ball",
    f"datagen add {DATA} --edit remove:ball",
    f"datagen add {DATA} --larger 2",
    f"datagen film {DATA} {FILM} --spp 1 --out film.webp",
    f"datagen export {DATA} --format nerfstudio --out exported",
    "report",
)
READ_FIT = (
    f"datagen verify {DATA}",
    f"{TRAIN} --geometry fitted --out runs/one/again",
    "model predict runs/one/fitted --device cpu --overwrite",
    "model export runs/one/fitted --out page.html",
    f"datagen peel {DATA} --geometry fitted --overwrite",
    "report",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with a picture as texture, an edit and fitted glass, runs on the truth and on the fit, and a fit."""
    use_mitsuba()
    folder = tmp_path_factory.mktemp("made")
    scene = glass_scene()
    rows = png_bytes(np.full((2, 2, 3), 90, np.uint8))
    cube = dataclasses.replace(scene.objects[-1], material=Plastic(color=ImageTexture(path="textures/cube.png")))
    scene = dataclasses.replace(scene, objects=(*scene.objects[:-1], cube), baked={"textures/cube.png": rows})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        dataset = write_traced_dataset(DATA, scene=scene, resolution=8)
        run(f"datagen add {DATA} --edit remove:ball")
        write_fit(dataset, Path("runs/one/fit-fitted"), ("ball",))
        run(f"datagen peel {DATA} --geometry fitted")
        run(f"{TRAIN} --out {RUN}")
        run(f"{TRAIN} --geometry fitted --out runs/one/fitted")
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(made, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    _load_surfaces.cache_clear()  # Commands are processes of their own, which have nothing left from training.


def edit(path: Path) -> None:
    """Changes a file as a person might: it stays a good one of its kind."""
    if path.suffix == ".json":
        path.write_text(path.read_text().replace('"ior": 1.5', '"ior": 1.7').replace('"truth"', '"fitted"'))
    elif path.suffix == ".ply":
        mesh, _ = read_ply(path)
        path.write_bytes(write_ply(dataclasses.replace(mesh, vertices=mesh.vertices * np.float32(1.01))))
    else:
        path.write_bytes(png_bytes(np.full((2, 2, 3), 200, np.uint8)))


def each(lines: tuple[str, ...], *names: str) -> Iterator[Any]:
    """Every command with every file; a quick run tries each command with one file, in turn."""
    for place, (line, name) in enumerate(itertools.product(lines, names)):
        turn, kind = divmod(place, len(names))
        yield pytest.param(line, name, marks=() if kind == turn % len(names) else pytest.mark.full)


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("line", "name"),
    [
        *each(READ_MATERIALS, "scene/scene.json", "scene/meshes/ball.ply", "scene/textures/cube.png"),
        *each(READ_FIT, "proxies/fitted/proxies.json", "proxies/fitted/meshes/ball.ply"),
        (f"model predict {RUN} --variant remove-ball --device cpu", "variants/remove-ball/scene/scene.json"),
    ],
)
def test_a_command_that_reads_an_edited_file_of_the_scene_or_of_fitted_glass_names_it(line: str, name: str) -> None:
    file = DATA / name
    edit(file)
    answer = call(line)
    assert answer.status == 1, answer.err
    assert f"{file}: " in answer.error or (line.startswith("datagen verify") and f"{file}: " in answer.out), answer.err
