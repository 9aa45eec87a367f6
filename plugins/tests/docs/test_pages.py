"""Tests that the pages can be relied on: links lead somewhere, every page is listed, the example scene is one."""

import json
import re
import subprocess
import sys
import textwrap
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
import trimesh
from support.commands import call, parsed, run
from support.plugins import guide_to
from support.synthetic import write_synthetic_dataset

import hyaline
from datagen.disk.errors import UsageError
from datagen.scene.folder import load_scene
from model.methods import protocol

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def prose_of(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)


def anchors_of(page: Path) -> set[str]:
    """What the headings of a page are called in addresses, on GitHub and on the site."""
    headings = re.findall(r"^#+ (.+)$", prose_of(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_within_the_repository_leads_to_a_file_or_heading(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", prose_of(page))
    missing = []
    for link in (link for link in links if "://" not in link):
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if not target.exists() or (anchor and anchor not in anchors_of(target)):
            missing.append(link)
    assert not missing


def test_the_site_lists_every_page() -> None:
    listed = re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text())
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted(["RESULTS.md", "options.md", *pages])


def test_every_promise_is_kept_by_the_tests_that_its_table_names() -> None:
    page = ROOT / "docs" / "reliability.md"
    rows = re.findall(r"^\| (R\d+) \| (.*?) \|", page.read_text(), flags=re.MULTILINE)
    told = {name: {(page.parent / link).resolve() for link in re.findall(r"\]\((.*?)\)", cell)} for name, cell in rows}
    found: dict[str, set[Path]] = {name: set() for name in re.findall(r"\*\*(R\d+)\.", page.read_text())}
    for path in (*(ROOT / "tests").rglob("test_*.py"), *(ROOT / "plugins").rglob("test_*.py")):
        for names in re.findall(r"mark\.promise\((.*?)\)", path.read_text()):
            for name in re.findall(r"R\d+", names):
                found[name].add(path)
    assert told == found


class Links(HTMLParser):
    """What a page of the site refers to, and the places in it that others may refer to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.followed: list[str] = []
        self.loaded: list[str] = []
        self.ids: set[str] = set()
        self.feed(page.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.ids.add(values.get("id", ""))
        self.followed += [values["href"]] if tag == "a" and "href" in values else []
        self.loaded += [values[name] for name in ("src", "href") if name in values and tag != "a"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason='mkdocs: not installed; `pip install -e ".[docs]"` brings it')
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-W", "ignore", "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True)
    return folder


def test_the_site_has_no_broken_link_and_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = {page: Links(page) for page in site.rglob("*.html") if page.name not in ("404.html", "search.html")}
    assert len(pages) == len(list((ROOT / "docs").rglob("*.md"))) + 2
    broken = []
    for page, links in pages.items():
        for link in [*links.loaded, *(link for link in links.followed if not link.startswith("https://"))]:
            name, _, anchor = unquote(link).partition("#")
            target = (page.parent / name).resolve() if name else page
            if not target.is_file() or (anchor and anchor not in pages[target].ids):
                broken.append(f"{page.name}: {link}")
    assert not broken


def test_the_site_has_every_option_and_the_reference_every_public_name(site: Path) -> None:
    listed = re.findall(r"^::: (.+)$", (ROOT / "docs" / "api.md").read_text(), flags=re.MULTILINE)
    names = " ".join(listed).split()
    assert sorted(names) == sorted(set(hyaline.__all__) - {"__version__"})
    page = Links(site / "api.html")
    assert {name.lower() for name in names} <= page.ids and "datasetview" in page.ids
    text = re.sub("<[^>]+>", "", (site / "api.html").read_text() + (site / "options.html").read_text())
    assert all(part in text for part in ("Absolute index of refraction", "folder: Path | str | None=None", "--preset"))


def test_the_example_of_a_scene_is_a_scene(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "scenes.md").read_text()
    found = re.search(r"```json\n(.*?)```", page, flags=re.DOTALL)
    assert found is not None
    (tmp_path / "scene.json").write_text(json.dumps(json.loads(found[1])))
    for name, size, place in (("floor", (6, 6, 0.1), (0, 0, -0.05)), ("vase", (0.3, 0.3, 0.6), (0, 0, 0.5))):
        shape = trimesh.creation.box(size)
        shape.apply_translation(place)
        (tmp_path / "meshes").mkdir(exist_ok=True)
        shape.export(tmp_path / "meshes" / f"{name}.ply")
    scene = load_scene(tmp_path)
    assert [item.name for item in scene.objects] == ["floor", "vase"]
    assert scene.objects[1].material.is_glass


PROGRAMS = "(?<=`)hyaline|datagen|proxies|model|report|eval report|hyaline-bench|python -m benchmarks"
COMMAND = re.compile(rf"(?:`|^)((?:{PROGRAMS}) (?!= )[^`\n#|;&>()]+)", re.MULTILINE)
UNFINISHED = re.compile(
    r"^\S+: Missing |: Missing (value|from)|no \w+ command 'NAME'"
    r"|no \w+ train method '(METHOD|NAME|alpha-blend|first-surface|-)"
)


@pytest.mark.parametrize("page", [page for page in PAGES if "notes" not in page.parts], ids=lambda page: page.name)
def test_every_command_of_a_page_is_one(page: Path) -> None:
    """Its words are today's; that some are left out, or stand for others, is fine."""
    if page.name == "CHANGELOG.md" or page.parent.name == "results":
        return  # What was typed then.
    for line in COMMAND.findall(re.sub(r"\\\n *", "", page.read_text())):
        if line.count("'") % 2 or line.count('"') % 2 or "$run" in line:
            continue  # Cut at a sign inside of quotes; of an experiment.
        line = re.sub(r"\{([^{},]*),[^{}]*\}", r"\1", line)  # One line of a grid.
        try:
            parsed(line.strip())
        except SystemExit:
            continue  # Help.
        except UsageError as error:
            assert UNFINISHED.search(str(error)), f"{line}: {error}"


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small dataset and a short run by the names that the pages use, below the working folder."""
    write_synthetic_dataset(tmp_path / "data" / "glass_table")
    monkeypatch.chdir(tmp_path)
    small = "--steps 2 --batch 64 --texture-size 16 --hidden 32"
    run(f"model train paper glass_table --out runs/glass_table/light-path {small}")


def python_of(text: str) -> str:
    """All code of a text in Python, also where it is part of a list."""
    blocks = re.findall(r"^ *```python\n(.*?)```", text, flags=re.DOTALL | re.MULTILINE)
    return "\n".join(map(textwrap.dedent, blocks))


@pytest.mark.usefixtures("demo")
@pytest.mark.parametrize("page", ["README.md", "docs/python.md", "docs/datasets.md", "docs/labels.md"])
def test_the_python_of_a_page_runs_from_top_to_bottom(page: str) -> None:
    source = python_of((ROOT / page).read_text())
    if page == "docs/labels.md":  # Its commands make what its lines open.
        found = re.findall("datagen (?:add|export|film|look) glass_table[^`\n]+", (ROOT / page).read_text())
        for line in dict.fromkeys(["datagen add glass_table --stereo 0.06", *found]):
            run(line.replace("--frames 48", "--frames 2 --spp 2"))
    for usual, small in {
        'open_dataset("demo")': 'open_dataset("glass_table")',
        "demo/light-path-400-steps": "glass_table/light-path",
        "width=320, height=180": "width=32, height=18",
        "views=96": "views=5, test_views=1",
        'preset="demo"': 'preset="tiny", resolution=16, spp=4, test_spp=4',
        "steps=500": "steps=2, batch=32, texture_size=16",
        "=24": "=2",
        "=48": "=2",
        '"interpolating", 3)': '"interpolating", 0)',
    }.items():
        source = source.replace(usual, small)
    names: dict[str, Any] = {"my_method": lambda camera: np.zeros((camera.height, camera.width, 3), np.uint8)}
    with np.errstate(all="ignore"):  # The dataset's glass has no thickness, by which one page divides.
        exec(compile(source, page, "exec"), names)
    assert names["view"].image.shape == (32, 32, 3)


def test_the_material_of_its_page_is_one() -> None:
    names: dict[str, Any] = {}
    exec(python_of(guide_to("A material")).partition("Material = ")[0], names)
    material = names["AirGap"]()
    assert material.is_glass and material.surface().ior == 1
    assert material.bsdf(lambda reflectance: {}) == {"type": "null"}


def test_the_proxy_of_its_page_encloses_the_object_with_its_padding() -> None:
    names: dict[str, Any] = {}
    exec(python_of(guide_to("A kind of proxy")), names)
    box = trimesh.creation.box((0.1, 0.2, 0.6))
    solid = SimpleNamespace(hull_points=np.array(box.vertices))
    ball = names["fit_ball"](solid, padding=0.01)
    mesh = trimesh.Trimesh(ball.vertices, ball.faces)
    assert mesh.is_watertight and mesh.volume > 0
    ahead = np.einsum("fvi,fi->fv", mesh.triangles_center[:, None] - box.vertices, mesh.face_normals)
    assert 0.01 - 1e-6 <= ahead.min() < 0.02


def test_the_complete_method_passes_the_checks_that_its_page_lists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = guide_to("A method")
    source, entry = (re.search(rf"```{kind}\n(.*?)```", page, flags=re.DOTALL) for kind in ("python", "toml"))
    assert source is not None and entry is not None
    (tmp_path / "alpha_blend.py").write_text(source[1])
    monkeypatch.syspath_prepend(tmp_path)
    ((name, record),) = tomllib.loads(entry[1])["project"]["entry-points"]["hyaline.methods"].items()
    monkeypatch.setitem(protocol.BUILT_IN, name, record)
    answer = call(f"model check-method {name}")
    sys.modules.pop("alpha_blend", None)
    lines = answer.out.splitlines()
    listed = re.findall(r"^\| ([^|]+) \|", page.partition("### The check")[2], flags=re.MULTILINE)[1:]
    assert answer.status == 0, answer.out + answer.err
    assert [re.sub(r"^(ok|skip) +|: .*", "", line) for line in lines] == listed
    assert [line.split()[0] for line in lines[:8]] == ["ok"] * 8
