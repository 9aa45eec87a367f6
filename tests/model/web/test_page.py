"""Tests that the page of a trained scene draws in a browser what Python draws, edits included, and keeps to itself."""

import dataclasses
import re
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pytest
import torch
import trimesh
from support.browser import require_browser
from support.meshes import mesh_of
from support.synthetic import look_at, quad, synthetic_scene

from benchmarks.pages.browser import Watched, open_file, running_browser, watched_page
from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, DatasetConfig, SplitConfig
from datagen.data.dataset import Dataset, DatasetObject
from datagen.data.dataset_head import write_head
from datagen.data.meshes import Mesh, no_mesh
from datagen.data.paths import TRUTH
from datagen.data.png import png_bytes
from datagen.data.resolution import square
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene, SceneObject
from datagen.scene.edits import moved_mesh
from datagen.scene.folder import scene_files
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Plastic, RoughDielectric, ThinDielectric
from datagen.scene.materials.optics import Event, Surface

if TYPE_CHECKING:
    from playwright.sync_api import Browser

if use_mitsuba(quiet=True).startswith("scalar"):
    pytest.skip("light paths need a vectorised variant of Mitsuba", allow_module_level=True)

from datagen.trace.light_path import LightPathTracer
from datagen.trace.surface_tables import EVENTS
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import LightPathRenderer
from model.methods.light_path.pixels import LightPathPixels, load_light_path_pixels
from model.run.predict import predict_pixels
from model.web.export import fill, scene_page
from model.web.scene import check_exportable

SIZE = 40
VIEW = "interpolating/0"
STILL = png_bytes(np.full((4, 4, 3), 90, np.uint8))


def placed(shape: trimesh.Trimesh, *place: float) -> Mesh:
    """A shape where it is to stand, with uv that change slowly; normals are those of faces where there are edges."""
    if len(shape.faces) < 1000:
        shape.unmerge_vertices()
    mesh = mesh_of(shape.apply_translation(place))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return dataclasses.replace(mesh, uv=((mesh.vertices - low) / (high - low))[:, [0, 2]].copy())


def standing_pane() -> Mesh:
    flat = quad(0)
    vertices = flat.vertices[:, [0, 2, 1]] * np.float32(0.6) + np.float32([0, -0.7, 0.7])
    return dataclasses.replace(flat, vertices=vertices, normals=np.tile(np.float32([0, -1, 0]), (4, 1)))


def scene() -> Scene:
    """Every kind of surface: a drink in a glass whose wall it reaches into, a pane, metal, plastic, ice, floor."""
    grey = (0.5, 0.5, 0.5)
    tall = {"glass": (0.45, 0.9), "drink": (0.4, 0.7)}
    cups = {
        name: placed(trimesh.creation.cylinder(radius, height, sections=24), 0.2, 0.1, 0.5)
        for name, (radius, height) in tall.items()
    }
    drink = Dielectric(ior=1.33, absorption=(0.3, 2, 3), priority=1)
    objects = (
        SceneObject(name="floor", mesh=quad(0), material=Diffuse(color=grey)),
        SceneObject(name="glass", mesh=cups["glass"], material=Dielectric(ior=1.5, absorption=(0.2, 0.1, 0.3))),
        SceneObject(name="drink", mesh=cups["drink"], material=drink),
        SceneObject(name="pane", mesh=standing_pane(), material=ThinDielectric(ior=1.5, tint=(0.9, 0.8, 0.7))),
        SceneObject(
            name="metal",
            mesh=placed(trimesh.creation.icosphere(3, 0.3), -0.6, 0.3, 0.35),
            material=Conductor(color=(0.9, 0.7, 0.4), roughness=0.2),
        ),
        SceneObject(
            name="plastic",
            mesh=placed(trimesh.creation.icosphere(3, 0.25), -0.5, -0.4, 0.3),
            material=Plastic(color=grey, ior=1.5, roughness=0.1),
        ),
        SceneObject(
            name="ice",
            mesh=placed(trimesh.creation.icosphere(3, 0.2), 0.4, -0.9, 0.25),
            material=RoughDielectric(ior=1.31, roughness=0.15),
        ),
    )
    return dataclasses.replace(synthetic_scene(), objects=objects)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The scene with its cameras, without any picture."""
    few = SplitConfig(views=1, spp=4)
    config = DatasetConfig(
        scene="web", preset="tiny", resolution=square(SIZE), train=few, interpolating=few, extrapolating=few
    )
    pose = look_at(np.array([0.5, -2.2, 1.7]), np.array([-0.1, 0, 0.4]))
    cameras = Cameras(world_from_camera=pose[None], fov_x=np.radians(45), width=SIZE, height=SIZE)
    objects = tuple(DatasetObject(name=item.name, is_glass=item.material.is_glass) for item in scene().objects)
    root = tmp_path_factory.mktemp("web") / "data" / "web"
    return write_head(root, config, objects, dict.fromkeys(SPLITS, cameras), scene_files(scene()))


@pytest.fixture(scope="module")
def renderer(dataset: Dataset) -> LightPathRenderer:
    """Noise in all weights and texels: a wrong one shows."""
    torch.manual_seed(3)
    net = LightPathRenderer(
        LightPathConfig(
            texture_sizes=(40, 8, 8, 8, 24, 17, 8),
            texture_levels=2,
            hidden=18,
            stack_hidden=10,
            environment_size=6,
            sky_lobes=3,
            branches=5,
            render_samples=1,
            refined_samples=1,
        )
    )
    with torch.no_grad():
        for name, values in net.named_parameters():
            # The page sums all levels into one, which blurs the coarse one's noise; what is trained is smoother.
            scale = {"textures.0.table": 0.7, "textures.1.table": 0.15}.get(name, 0.35)
            values.copy_(torch.randn_like(values) * scale)
        net.environment.maps[-1].fill_(-2.0)  # Else all would be white,
        net.stack_net[-1].bias.fill_(2.0)  # and what the stack adds too dark to be seen.
    return net.eval()


def drawn_by_python(
    renderer: LightPathRenderer, dataset: Dataset, samples: int = 1, changed: dict[str, SceneObject] | None = None
) -> np.ndarray:
    """The product's own picture, (h, w, 3), of the scene with some objects changed."""
    config = dataclasses.replace(renderer.config, render_samples=samples)
    pixels = load_light_path_pixels(config, dataset, TRUTH, "interpolating", [0], False)
    if changed:
        objects = [changed.get(item.name, item) for item in scene().objects]
        tracer = LightPathTracer(tuple(item.mesh for item in objects), tuple(item.material for item in objects))
        pixels = dataclasses.replace(pixels, tracer=tracer)
    assert isinstance(pixels, LightPathPixels)
    return predict_pixels(renderer, pixels).reshape(SIZE, SIZE, 3)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(np.square((one.astype(float) - other) / 255).mean() + 1e-12))


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    require_browser()
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def page(
    browser: "Browser", renderer: LightPathRenderer, dataset: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Watched]:
    """The page that keeps every number as it is, opened."""
    file = tmp_path_factory.mktemp("page") / "exact.html"
    file.write_bytes(scene_page(renderer, dataset, TRUTH, "exact", label="noise", still=STILL))
    with watched_page(browser) as page:
        open_file(page, file)
        yield page


def test_a_page_draws_what_python_draws_with_one_ray_a_pixel(
    page: Watched, renderer: LightPathRenderer, dataset: Dataset
) -> None:
    truth = drawn_by_python(renderer, dataset)
    assert truth.std() > 20
    assert psnr(page.picture(VIEW, SIZE, 1), truth) >= 45


def test_a_page_draws_what_python_draws_with_sixteen_rays_a_pixel(
    page: Watched, renderer: LightPathRenderer, dataset: Dataset
) -> None:
    assert psnr(page.picture(VIEW, SIZE, 16), drawn_by_python(renderer, dataset, 16)) >= 50


def after(name: str, **change: Any) -> dict[str, SceneObject]:
    item = next(item for item in scene().objects if item.name == name)
    return {name: dataclasses.replace(item, **change)}


def turned(mesh: Mesh, angle: float) -> Mesh:
    """The mesh, turned about the middle of its box around the vertical."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], np.float32)
    return dataclasses.replace(mesh, vertices=(mesh.vertices - middle) @ turn.T + middle, normals=mesh.normals @ turn.T)


PANE = next(item.mesh for item in scene().objects if item.name == "pane")
METAL = next(item.mesh for item in scene().objects if item.name == "metal")


@pytest.mark.parametrize(
    ("edits", "changed"),
    [
        ({"glass": {"shown": False}}, after("glass", mesh=no_mesh())),
        ({"metal": {"offset": [0.3, -0.5, 0.2]}}, after("metal", mesh=moved_mesh(METAL, (0.3, -0.5, 0.2)))),
        ({"pane": {"angle": 0.6}}, after("pane", mesh=turned(PANE, 0.6))),
        (
            {"drink": {"mediumIor": 1.8, "absorption": [3, 0, 0]}},
            after("drink", material=Dielectric(ior=1.8, absorption=(3, 0, 0), priority=1)),
        ),
    ],
    ids=["removed", "moved", "turned", "another index"],
)
def test_an_edited_scene_is_that_of_python(
    page: Watched, renderer: LightPathRenderer, dataset: Dataset, edits: dict[str, Any], changed: dict[str, SceneObject]
) -> None:
    drawn = page.picture(VIEW, SIZE, 1, edits)
    assert psnr(drawn, drawn_by_python(renderer, dataset, changed=changed)) >= 45
    assert psnr(drawn, drawn_by_python(renderer, dataset)) < 35


def test_a_page_asks_for_nothing_and_complains_of_nothing(page: Watched) -> None:
    page.picture(VIEW, SIZE, 1)
    assert [address.partition("?")[0].rpartition("/")[2] for address in page.requests] == ["exact.html"]
    assert page.complaints == []
    blocked = page.page.evaluate("async () => { try { await fetch('data:,x'); } catch (error) { return 'refused'; } }")
    assert blocked == "refused"
    page.complaints.clear()  # The policy's complaint of this test's own request.


def test_a_page_that_lost_its_graphics_processor_draws_as_before(page: Watched) -> None:
    before = page.picture(VIEW, SIZE, 1)
    page.evaluate(
        """async () => {
            const { gl, canvas } = await hyaline, lost = gl.getExtension("WEBGL_lose_context");
            const heard = (name) => new Promise((resolve) => canvas.addEventListener(name, resolve, { once: true }));
            const gone = heard("webglcontextlost");
            lost.loseContext();
            await gone;
            await new Promise((resolve) => setTimeout(resolve, 100));
            const back = heard("webglcontextrestored");
            lost.restoreContext();
            await back;
        }"""
    )
    page.page.wait_for_function("async () => !(await hyaline).frames.held")
    assert np.array_equal(page.picture(VIEW, SIZE, 1), before)
    page.complaints.clear()  # The browser says that it lost it.


def test_a_link_brings_back_camera_and_edits(page: Watched) -> None:
    shown = page.page
    shown.focus("#view")
    shown.keyboard.press("ArrowLeft")
    shown.keyboard.press("+")
    shown.get_by_label("Show glass").uncheck()
    shown.get_by_role("button", name="drink").click()
    shown.get_by_label("Refractive index").fill("1.7")
    link = shown.url
    state = "async () => { const page = await hyaline; return [page.camera.matrix, page.objects]; }"
    camera, objects = shown.evaluate(state)
    assert not objects[1]["shown"]
    assert objects[2]["mediumIor"] == 1.7
    shown.get_by_role("button", name="Reset").click()
    assert shown.evaluate(state)[1][1]["shown"]
    shown.goto(link)
    shown.wait_for_function("async () => !(await hyaline).objects[1].shown")
    restored = shown.evaluate(state)
    assert restored[1] == objects
    assert np.allclose(restored[0], camera, atol=1e-4)


def test_a_small_page_is_close_to_python(
    browser: "Browser", renderer: LightPathRenderer, dataset: Dataset, tmp_path: Path
) -> None:
    data = scene_page(renderer, dataset, TRUTH, "small", label="noise", still=STILL)
    assert data == scene_page(renderer, dataset, TRUTH, "small", label="noise", still=STILL)
    (tmp_path / "small.html").write_bytes(data)
    with watched_page(browser, width=120, height=90) as page:
        open_file(page, tmp_path / "small.html")
        assert psnr(page.picture(VIEW, SIZE, 1), drawn_by_python(renderer, dataset)) >= 42
        page.evaluate("async () => (await hyaline).frames.still(2)")
        assert re.match(r"120 .+, 2 rays a pixel", page.page.inner_text("#status"))


def test_a_browser_without_webgl_says_so_and_shows_a_still_picture(
    browser: "Browser", renderer: LightPathRenderer, dataset: Dataset, tmp_path: Path
) -> None:
    file = tmp_path / "page.html"
    file.write_bytes(scene_page(renderer, dataset, TRUTH, "small", label="noise", still=STILL))
    with watched_page(browser) as watched:
        watched.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        watched.page.goto(file.as_uri())
        message = watched.page.get_by_role("alert")
        message.wait_for(state="visible")
        assert re.search(r"no WebGL 2.*still picture", message.inner_text())
        assert watched.page.evaluate("document.getElementById('still').naturalWidth") == 4


def test_what_the_page_cannot_draw_is_refused() -> None:
    for change in ({"straight_layers": 2}, {"relief": "on"}, {"shells": 2}):
        with pytest.raises(HyalineError, match="expected light-path on the true geometry"):
            check_exportable(LightPathConfig(texture_sizes=(8,), **change))


def test_the_page_knows_all_that_a_surface_may_do_to_light() -> None:
    listed = re.search(r"EVENTS = \{(.*?)\}", (resources.files("model.web") / "tracer.js").read_text())
    assert listed is not None
    known = dict(re.findall(r"(\w+): (\d)", listed[1]))
    assert {name: int(number) for name, number in known.items()} == EVENTS
    assert EVENTS.keys() == set(get_args(Event))
    # What a surface is told of beside this needs a line in the shader.
    assert {field.name for field in dataclasses.fields(Surface)} == {"event", "ior", "roughness", "color"}


def test_a_template_whose_places_are_not_those_of_the_parts_is_no_page() -> None:
    assert fill("a {{b}} {{c}}", {"b": "{{c}}", "c": "d"}) == "a {{c}} d"
    for parts in ({"b": "x"}, {"b": "x", "c": "y", "d": "z"}):
        with pytest.raises(AssertionError):
            fill("{{b}}{{c}}", parts)
    with pytest.raises(AssertionError):
        fill("{{b}}{{b}}", {"b": "x"})
