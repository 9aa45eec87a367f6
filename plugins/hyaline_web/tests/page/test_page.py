"""Tests that the page of a trained scene draws in a browser what Python draws, edited or not, and keeps to itself."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.browser import wait_until
from support.meshes import box
from support.reference import fresnel_reflectance
from support.synthetic import look_at
from support.web_scenes import (
    SHAPE,
    STILL,
    VIEW,
    drawn_by_python,
    every_surface,
    noisy_light_path,
    opened_page,
    post,
    psnr,
    solid_surfaces,
    write_scene,
)

from benchmarks.browser import Watched, open_file, watched_page
from benchmarks.compare import page_edits
from datagen.data.dataset import Dataset
from datagen.data.meshes import Mesh, no_mesh
from datagen.data.paths import TRUTH
from datagen.pages.html import lossless_uri
from datagen.scene.description import Scene, SceneObject
from datagen.scene.edits import edit_scene, moved_mesh, parse_edit
from datagen.scene.materials import Conductor, Dielectric, Event, Medium, Surface
from datagen.scene.modelling import transformed
from hyaline_web.page.export import scene_page
from model.methods.light_path.net import LightPathRenderer
from model.methods.page import package_text
from model.nets.texture import NeuralTextures
from model.run.predict import with_copies

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.mark.parametrize(("samples", "least"), [(1, 45), (16, 50)])
def test_a_page_draws_what_python_draws(
    page: Watched, renderer: LightPathRenderer, dataset: Dataset, samples: int, least: float
) -> None:
    truth = drawn_by_python(renderer, dataset, samples)
    assert truth.std() > 20
    assert psnr(page.picture(VIEW, SHAPE, samples), truth) >= least


def with_other(*names: str, scene: Scene | None = None, **change: Any) -> Scene:
    """The scene with another mesh or material for some objects."""
    scene = scene or every_surface()
    objects = (dataclasses.replace(item, **change) if item.name in names else item for item in scene.objects)
    return dataclasses.replace(scene, objects=tuple(objects))


# Rounding gives level normals, which a page keeps as directions on an octahedron, a slight lean up or down.
ROUGH_WALLS = with_other("metal", mesh=post(0.28, 0.6, -0.6, 0.3, 0.35))
PROXY = {"straight_layers": 7, "shells": 3, "relief": True, "directions": True, "stack_hidden": 12}


@pytest.mark.parametrize(
    ("scene", "change", "quality", "least"),
    [
        pytest.param(ROUGH_WALLS, {}, "exact", 45, id="facets of upright rough walls"),
        pytest.param(every_surface(), {"branches": 1}, "exact", 45, id="a stack of one branch", marks=pytest.mark.full),
        pytest.param(solid_surfaces(), PROXY, "exact", 45, id="straight layers, shells and relief"),
        pytest.param(solid_surfaces(), PROXY, "small", 42, id="the same, small", marks=pytest.mark.full),
    ],
)
def test_other_scenes_and_renderers_are_drawn_as_by_python(
    browser: "Browser", tmp_path: Path, scene: Scene, change: dict[str, Any], quality: str, least: float
) -> None:
    dataset, renderer = write_scene(tmp_path / "data" / "web", scene), noisy_light_path(**change)
    truth = drawn_by_python(renderer, dataset)
    assert truth.std() > 15
    with opened_page(browser, tmp_path, renderer, dataset, quality) as page:
        assert psnr(page.picture(VIEW, SHAPE, 1), truth) >= least
        assert page.complaints == []


@pytest.mark.parametrize(
    ("thickness", "place"),
    [
        # The thinnest that float32 resolves at each place decide; thicker ones are easier.
        *(pytest.param(thickness, (0.0, 0.0, 0.0), marks=pytest.mark.full) for thickness in (1e-2, 1e-4)),
        (1e-6, (0.0, 0.0, 0.0)),
        pytest.param(1e-2, (100.0, -50.0, 30.0), marks=pytest.mark.full),
        pytest.param(1e-4, (100.0, -50.0, 30.0), marks=pytest.mark.full),
    ],
)
def test_the_page_follows_light_through_a_thin_plate_as_the_closed_form_says(
    browser: "Browser", tmp_path: Path, thickness: float, place: tuple[float, float, float]
) -> None:
    turn = trimesh.transformations.rotation_matrix(0.4, (1, 2, 0.5))[:3, :3]
    mesh = transformed(box((1, 1, thickness)), turn, place)
    plate = SceneObject(name="plate", mesh=mesh, material=Dielectric(ior=1.5, absorption=(0.5 / thickness,) * 3))
    scene = dataclasses.replace(every_surface(), objects=(plate,), baked={})
    pose = look_at(np.add(place, (0.3, -0.5, 1.2)), np.array(place))
    dataset = write_scene(tmp_path / "data" / "web", scene, pose)
    renderer = noisy_light_path(stack_hidden=0)
    with opened_page(browser, tmp_path, renderer, dataset) as page:
        script = (
            "async (at) => { const { tracer, camera } = await hyaline; return tracer.lightPath(camera, 32, ...at); }"
        )
        for at in ([20, 20, 40, 40], [15, 22, 40, 40], [24, 17, 40, 40]):
            segments = page.evaluate(script, at)
            ends = [segment for segment in segments if segment["object"] < 0]
            d = np.array(segments[0]["to"]) - segments[0]["from"]
            cosine = abs(d @ turn[:, 2]) / np.linalg.norm(d)
            r, inner = fresnel_reflectance(cosine, 1.5), np.sqrt(1 - (1 - cosine**2) / 1.5**2)
            height = mesh.vertices.astype(np.float64) @ turn[:, 2]
            middle = np.median(height)
            tau = np.exp(-0.5 / thickness * (height[height > middle].mean() - height[height < middle].mean()) / inner)
            # Straight through; off the first face; off the second.
            shares = [(1 - r) ** 2 * tau, r, (1 - r) ** 2 * r * tau**2]
            assert [segment["share"] for segment in ends[:3]] == pytest.approx(shares, rel=0.06)


def test_a_page_asks_for_nothing_and_complains_of_nothing(page: Watched) -> None:
    page.picture(VIEW, SHAPE, 1)
    assert [address.partition("?")[0].rpartition("/")[2] for address in page.requests] == ["page.html"]
    assert page.complaints == []
    blocked = page.page.evaluate("async () => { try { await fetch('data:,x'); } catch (error) { return 'refused'; } }")
    assert blocked == "refused"
    page.complaints.clear()  # The policy's complaint of this test's own request.


def test_a_page_that_lost_its_graphics_processor_draws_as_before(page: Watched) -> None:
    before = page.picture(VIEW, SHAPE, 1)
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
    wait_until(page.page, "async () => !(await hyaline).frames.held")
    assert np.array_equal(page.picture(VIEW, SHAPE, 1), before)
    page.complaints.clear()  # The browser says that it lost it.


def test_glass_that_parts_colours_is_drawn_as_by_python(
    browser: "Browser", renderer: LightPathRenderer, tmp_path: Path
) -> None:
    prism = Dielectric(ior=1.6, dispersion=3.0)
    dataset = write_scene(tmp_path / "data" / "web", with_other("metal", "ice", material=prism))
    with opened_page(browser, tmp_path, renderer, dataset) as page:
        drawn = page.picture(VIEW, SHAPE, 1)
    assert psnr(drawn, drawn_by_python(renderer, dataset)) >= 45
    even = with_other("metal", "ice", material=Dielectric(ior=1.6)).objects
    # Colours that went one way would not be found out above 45.
    assert psnr(drawn, drawn_by_python(renderer, dataset, objects=even)) < 42


def test_a_small_page_is_close_to_python(
    browser: "Browser", renderer: LightPathRenderer, dataset: Dataset, tmp_path: Path
) -> None:
    data = scene_page(renderer, renderer.config, dataset, TRUTH, "small", label="noise", still=STILL)
    assert data == scene_page(renderer, renderer.config, dataset, TRUTH, "small", label="noise", still=STILL)
    (tmp_path / "small.html").write_bytes(data)
    with watched_page(browser, width=60, height=45) as page:
        open_file(page, tmp_path / "small.html")
        assert psnr(page.picture(VIEW, SHAPE, 1), drawn_by_python(renderer, dataset)) >= 42
        page.evaluate("async () => (await hyaline).frames.still(2)")
        assert re.match(r"60 .+, 2 rays a pixel", page.page.inner_text("#status"))
        assert page.page.get_attribute("#status", "aria-live") == "off"  # Else each frame would be read aloud.
        page.evaluate("async () => (await hyaline).show('A message.')")
        assert page.page.get_attribute("#status", "aria-live") == "polite"


def test_a_page_shows_how_far_a_view_is_from_its_truth(page: Watched) -> None:
    samples = page.evaluate("async () => (await hyaline).scene.manifest.samples")
    drawn = page.picture(VIEW, SHAPE, samples)
    uri = lossless_uri(np.where(drawn > 127, drawn - 3, drawn + 3).astype(np.uint8))
    page.evaluate("async (truth) => Object.assign((await hyaline).scene.manifest, { truth })", {VIEW: uri})
    page.evaluate("async (view) => (await hyaline).goTo(view)", VIEW)
    page.evaluate("async () => document.getElementById('error').click()")
    wait_until(page.page, "async () => document.getElementById('score').textContent.endsWith('dB')")
    assert page.page.inner_text("#score") == f"{20 * np.log10(255 / 3):.2f} dB"
    canvas = "document.getElementById('difference')"
    shown = page.evaluate(f"async () => [...{canvas}.getContext('2d').getImageData(0, 0, {SHAPE[1]}, {SHAPE[0]}).data]")
    assert set(shown) == {8 * 3, 255}
    page.evaluate("async () => (await hyaline).moved()")
    assert page.evaluate(f"async () => {canvas}.hidden")


def test_a_browser_without_webgl_says_so_and_shows_a_still_picture(
    browser: "Browser", renderer: LightPathRenderer, dataset: Dataset, tmp_path: Path
) -> None:
    file = tmp_path / "page.html"
    file.write_bytes(scene_page(renderer, renderer.config, dataset, TRUTH, "small", label="noise", still=STILL))
    with watched_page(browser) as watched:
        watched.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        watched.page.goto(file.as_uri())
        message = watched.page.get_by_role("alert")
        message.wait_for(state="visible")
        assert re.search(r"no WebGL 2.*still picture", message.inner_text())
        assert watched.page.evaluate("document.getElementById('still').naturalWidth") == 4


def test_the_page_knows_all_that_a_surface_may_do_to_light() -> None:
    followed = package_text("model.methods.light_path", "light_path.glsl")
    assert all(re.search(rf"\b{event.upper()}\b", followed) for event in get_args(Event))
    # What a surface is told of beside this needs a line in the shader.
    assert {field.name for field in dataclasses.fields(Surface)} == {"event", "ior", "roughness", "color", "texture"}
    assert {field.name for field in dataclasses.fields(Medium)} == {"iors", "absorption", "priority"}


# Edits


Objects = tuple[SceneObject, ...]


def after(name: str, **change: Any) -> Callable[[], Objects]:
    """The scene with another object of a name."""
    return lambda: with_other(name, **change).objects


def turned(mesh: Mesh, angles: tuple[float, float, float]) -> Mesh:
    """The mesh, turned about the middle of its box by degrees around x, then y, then z."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix().astype(np.float32)
    return dataclasses.replace(mesh, vertices=(mesh.vertices - middle) @ turn.T + middle, normals=mesh.normals @ turn.T)


def named(name: str) -> SceneObject:
    return next(item for item in every_surface().objects if item.name == name)


def with_a_copy() -> LightPathRenderer:
    """The renderer, whose eighth object looks up the texels of the metal."""
    net = noisy_light_path()
    for part in net.modules():
        if isinstance(part, NeuralTextures):
            part.layout = with_copies(part.layout, [4], 7)
    return net


METAL, GLASS = (named(name).mesh for name in ("metal", "glass"))
DENSE = Dielectric(ior=1.8, absorption=(6, 0, 0), priority=1)
COLORED = Conductor(color=(0.9, 0.7, 0.4), roughness=0.2)


@pytest.mark.parametrize(
    ("name", "edit", "objects"),
    [
        ("glass", {"shown": False}, after("glass", mesh=no_mesh())),
        ("metal", {"offset": [0.3, -0.5, 0.2]}, after("metal", mesh=moved_mesh(METAL, (0.3, -0.5, 0.2)))),
        ("glass", {"turn": [25, 10, 40]}, after("glass", mesh=turned(GLASS, (25, 10, 40)))),
        ("drink", {"mediumIor": 1.8, "absorption": [6, 0, 0]}, after("drink", material=DENSE)),
        ("metal", {"material": "ice"}, after("metal", material=named("ice").material)),
        ("metal", {"tint": None, "color": [0.9, 0.7, 0.4]}, after("metal", material=COLORED)),
    ],
)
def test_an_edited_scene_is_that_of_python(
    page: Watched,
    renderer: LightPathRenderer,
    dataset: Dataset,
    name: str,
    edit: dict[str, Any],
    objects: Callable[[], Objects],
) -> None:
    drawn = page.picture(VIEW, SHAPE, 1, {name: edit})
    # In a few of the 1,584 pixels a ray meets the other one of two faces that share an edge.
    assert psnr(drawn, drawn_by_python(renderer, dataset, objects=objects())) >= 42
    assert psnr(drawn, drawn_by_python(renderer, dataset)) < 35


COPY = ("duplicate:metal:0.7,-0.6,0.1", "move:metal:0,0,0.2", "remove:pane", "glass:plastic")


@pytest.mark.parametrize(("edits", "make"), [(COPY, with_a_copy), (("swap:metal:ice",), noisy_light_path)])
def test_copies_and_objects_that_trade_places_are_those_of_python(
    page: Watched, dataset: Dataset, edits: tuple[str, ...], make: Callable[[], LightPathRenderer]
) -> None:
    parsed = tuple(map(parse_edit, edits))
    drawn = page.picture(VIEW, SHAPE, 1, page_edits(dataset, parsed, knows_materials=True))
    objects = edit_scene(every_surface(), parsed).scene.objects
    assert psnr(drawn, drawn_by_python(make(), dataset, objects=objects)) >= 45
    assert psnr(drawn, drawn_by_python(noisy_light_path(), dataset)) < 35
