"""Tests what Python makes: scenes of meshes from anywhere, datasets, proxies, runs and reports of them."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
import trimesh
from support.checked import unchecked
from support.commands import call

import datagen.builder.build
import hyaline as hy
from datagen.data.images import read_png
from datagen.disk.records import to_json
from datagen.terminal.command import track
from model.batches.rays import PlainRayPixels, PlainRays, load_views_of, rays_of
from model.methods.protocol import Inputs, MethodConfig
from model.methods.renderer import Renderer

SIZE: dict[str, Any] = {"preset": "tiny", "resolution": 16, "spp": 4, "test_spp": 4}
TINY: dict[str, Any] = {"steps": 2, "batch": 32, "device": "cpu"}


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2, radius=0.1)


def scene_of(mesh: Any) -> hy.Scene:
    floor = trimesh.creation.box((1.0, 1.0, 0.02))
    floor.apply_translation((0, 0, -0.2))
    arrays = np.asarray(floor.vertices), np.asarray(floor.faces)
    return hy.Scene(
        objects=[
            hy.Object("ball", mesh, hy.Dielectric(ior=1.5)),
            hy.Object("floor", arrays, hy.Diffuse(color=(1, 0, 0))),
        ],
        cameras=hy.Hemisphere(views=4, test_views=1),
        name="marble",
    )


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def dataset(home: Path) -> hy.Dataset:
    """The dataset of a scene, whose first building was interrupted after two pictures."""

    def interrupted(items: Any, **about: Any) -> Any:
        for count, item in enumerate(track(items, **about)):
            if count == 2:
                raise KeyboardInterrupt
            yield item

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datagen.builder.build, "track", interrupted)
        with pytest.raises(KeyboardInterrupt):
            hy.build(scene_of(ball()), home / "data" / "marble", **SIZE)
    assert sum(view.is_built for view in hy.open_dataset(home / "data" / "marble").views("train")) in (1, 2, 3)
    return hy.build(scene_of(ball()), home / "data" / "marble", **SIZE)


def test_an_interrupted_build_goes_on_and_a_finished_one_stays(
    dataset: hy.Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    assert dataset.num_views == {"train": 4, "interpolating": 1, "extrapolating": 1}
    assert all(view.is_built for split in dataset.splits for view in dataset.views(split))
    assert dataset.view("interpolating", 0).mask("glass").any()
    again = hy.build(scene_of(ball()), dataset.root, **SIZE)
    assert again.seal == dataset.seal and "rendering" not in capsys.readouterr().err


def test_a_mesh_is_the_same_as_arrays_and_from_trimesh() -> None:
    expected = scene_of((np.asarray(ball().vertices), np.asarray(ball().faces))).described().objects[0].mesh
    mesh = scene_of(ball()).described().objects[0].mesh
    corners, others = (np.sort(item.vertices[item.faces].reshape(-1, 9), axis=0) for item in (mesh, expected))
    assert np.allclose(corners, others, atol=1e-6)
    assert mesh.uv.any() and np.allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-5)
    directions = mesh.vertices / np.linalg.norm(mesh.vertices, axis=-1, keepdims=True)
    assert (np.sum(directions * mesh.normals, axis=-1) > 0.95).all()  # Smooth, and outward.


def test_what_cannot_be_a_scene_is_refused_in_one_line() -> None:
    hole = ball()
    hole.update_faces(np.arange(len(hole.faces)) > 5)
    vertices, faces = np.asarray(ball().vertices), np.asarray(ball().faces)
    for wrong, said in (
        (hole, "open edges"),
        ((vertices, faces + 100), "expected 0 to 161"),
        (SimpleNamespace(vertices=vertices[:, :2], faces=faces), r"vertices are float64 of shape \(162, 2\)"),
        ((vertices * np.nan, faces), "not all finite"),
        (trimesh.Scene([ball()]), "mesh: is <trimesh.Scene.*expected Triangles"),
    ):
        with unchecked(), pytest.raises(hy.HyalineError, match=said) as caught:
            scene_of(wrong).described()
        assert "\n" not in str(caught.value)


def test_numbers_of_numpy_describe_a_scene() -> None:
    with unchecked():
        glass, floor = hy.Dielectric(ior=np.float32(1.5)), hy.Diffuse(color=np.array([0.1, 0.2, 0.3]))  # pyright: ignore
        clear = hy.Dielectric(absorption=tuple(np.array([0.1, 0.2, 0.3])))  # Of float64, which is a float.
    assert to_json(glass)["ior"] == 1.5 and to_json(floor)["color"] == [0.1, 0.2, 0.3]
    assert {type(value) for value in to_json(clear)["absorption"]} == {float}


def test_a_view_has_the_layers_that_its_camera_has(dataset: hy.Dataset) -> None:
    view = dataset.view("extrapolating", 0)
    stored, traced = view.layers(), hy.layers(dataset, view.camera)
    for name in ("uv", "object_id", "depth"):
        assert np.array_equal(getattr(stored, name), getattr(traced, name))
    with pytest.raises(hy.HyalineError, match="num_layers: is 0; expected 1 to 255"):
        hy.layers(dataset, view.camera, num_layers=0)
    fewer = hy.layers(dataset, hy.orbit(view.camera, (0, 0, 0), count=3)[1], num_layers=2)
    assert fewer.object_id.shape == (2, 16, 16) and (fewer.object_id[0] == 1).any()


@pytest.fixture(scope="module")
def proxies(dataset: hy.Dataset) -> hy.Proxies:
    return hy.make_proxies(dataset, "box")


@pytest.fixture(scope="module")
def run(dataset: hy.Dataset, home: Path, proxies: hy.Proxies) -> hy.Run:
    out = home / "runs" / "marble" / "boxes"
    return hy.train("paper", dataset, geometry=proxies.geometry, out=out, texture_size=24, **TINY)


def test_a_run_has_the_settings_that_were_asked_for_and_is_trained_once(
    run: hy.Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (run.method, run.geometry, run.last_step, run.config.batch) == ("paper", "box", 2, 32)
    assert run.record.flags["geometry"] == "box" and "texture-size" in run.record.flags
    again = hy.train("paper", run.dataset, geometry="box", out=run.folder, texture_size=24, **TINY)
    assert again.record == run.record and "nothing to do" in capsys.readouterr().err
    view = run.dataset.view("interpolating", 0)
    assert run.render(view.camera).shape == view.image.shape


class Sky(Renderer[PlainRayPixels]):
    def __init__(self) -> None:
        super().__init__()
        self.colors = torch.nn.Linear(3, 3)

    def forward(self, rays: PlainRays, *, rng: np.random.Generator | None = None) -> torch.Tensor:
        assert rays.origins.shape == rays.directions.shape
        return torch.sigmoid(self.colors(rays.directions))


@dataclass(frozen=True, kw_only=True)
class PlainSkyConfig(MethodConfig):
    """A colour for each direction."""

    uses_geometry: ClassVar[bool] = False
    knowledge: ClassVar[str] = "cameras only"
    draws_cameras: ClassVar[bool] = True
    brightness: float = 0.5

    def build(self, inputs: Inputs) -> Sky:
        return Sky()

    def load_cameras(self, inputs: Inputs, cameras: hy.Cameras) -> PlainRayPixels:
        return rays_of(cameras)


def test_a_method_may_be_an_object_of_ones_own_that_sees_rays_alone(dataset: hy.Dataset, home: Path) -> None:
    out = home / "runs" / "marble" / "sky"
    run = hy.train(PlainSkyConfig(brightness=0.25), dataset, out=out, lr=0.1, **TINY)
    assert (run.method, run.config.net) == ("plain-sky", PlainSkyConfig(brightness=0.25))
    assert hy.open_run(out).config.lr == 0.1
    view = dataset.view("interpolating", 0)
    drawn = read_png(out / "predictions" / "interpolating" / "0000.png")
    assert np.array_equal(run.render(view.camera), drawn)
    origin, directions = view.camera.rays()
    rays = load_views_of(rays_of, dataset, "interpolating", [0], with_images=True).take(torch.arange(256), None)
    assert np.allclose(rays.directions.numpy(), directions.reshape(-1, 3), atol=1e-6)
    assert np.allclose(rays.origins.numpy(), origin)
    listed = " ".join(call("model train --help").out.split())  # Another test may find it there, too.
    assert "plain-sky A colour for each direction. Brought by this process." in listed


def test_a_report_is_a_table_rows_and_a_page(run: hy.Run, home: Path, tmp_path: Path) -> None:
    shutil.copytree(run.folder / "predictions", tmp_path / run.dataset.name / "foreign" / "predictions")
    shutil.copytree(run.folder, tmp_path / run.dataset.name / "boxes")
    report = hy.report(root=tmp_path, data=home / "data")
    assert report.page == tmp_path / "report" / "index.html"
    assert [row["run"] for row in report.rows] == ["boxes", "foreign"]
    with pytest.raises(hy.HyalineError, match="nothing: has no predictions"):
        hy.report("nothing", home / "report")
    report = hy.report(run, home / "report")
    assert report.page == home / "report" / "index.html" and "boxes" in report.page.read_text()
    assert [row["run"] for row in report.rows] == ["boxes"]
    view = run.dataset.view("interpolating", 0)
    score = hy.score(run.render(view.camera), view.image)
    assert float(report.rows[0]["psnr_db_interpolating"]) == pytest.approx(score.psnr_db)
    assert "<table" in report._repr_html_() and "boxes" in report._repr_html_()


def test_all_of_it_shows_itself(dataset: hy.Dataset, run: hy.Run) -> None:
    for shown in (scene_of(ball()), dataset, dataset.view("train", 0), run):
        picture = np.asarray(hy.show(shown))
        assert picture.shape[0] >= 256 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
