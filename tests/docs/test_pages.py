"""Tests that the pages can be relied on: links lead somewhere, every page is listed, the example scene is one."""

import json
import re
import sys
import tomllib
from pathlib import Path

import pytest
import trimesh
from support.commands import call

from datagen.scene.folder import load_scene
from model.methods import table

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_within_the_repository_leads_to_a_file(page: Path) -> None:
    prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", prose)
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_the_site_lists_every_page() -> None:
    listed = re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text())
    assert sorted(listed) == sorted(
        path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")
    )


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


def test_the_complete_method_passes_the_checks_that_its_page_lists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs" / "adding-a-method.md").read_text()
    source, entry = (re.search(rf"```{kind}\n(.*?)```", page, flags=re.DOTALL) for kind in ("python", "toml"))
    assert source is not None and entry is not None
    (tmp_path / "alpha_blend.py").write_text(source[1])
    monkeypatch.syspath_prepend(tmp_path)
    ((name, record),) = tomllib.loads(entry[1])["project"]["entry-points"]["hyaline.methods"].items()
    monkeypatch.setitem(table.BUILT_IN, name, record)
    table.list_methods.cache_clear()
    answer = call(f"model check-method {name}")
    for known in (table.list_methods, table.find_method):
        known.cache_clear()
    sys.modules.pop("alpha_blend", None)
    lines = answer.out.splitlines()
    listed = re.findall(r"^\| ([^|]+) \|", page.partition("## The check")[2], flags=re.MULTILINE)[1:]
    assert answer.status == 0, answer.out + answer.err
    assert [re.sub(r"^(ok|skip) +|: .*", "", line) for line in lines] == listed
    assert [line.split()[0] for line in lines[:8]] == ["ok"] * 8
