"""Tests that the pages can be relied on: links lead somewhere, every page is listed, the example scene is one."""

import json
import re
from pathlib import Path

import pytest
import trimesh

from datagen.scene.folder import load_scene

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
