"""Hooks of mkdocs: RESULTS.md, the API reference and the help of commands become pages, links to other files become
their paths, search works from disk."""

import importlib
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

RESULTS, OPTIONS = "RESULTS.md", "options.md"
REFERENCE = re.compile(r"^::: (.+)$", re.MULTILINE)
"""Names of `hyaline` in a page, whose reference takes their place."""
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((\.\./[^)#\s]*)(#[^)\s]*)?\)")


def on_files(files: Any, config: Any) -> None:
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

    text = (Path(config.docs_dir).parent / RESULTS).read_text()
    text = text.replace("[docs/results](docs/results)", "`docs/results`").replace("](docs/", "](")
    files.append(File.generated(config, RESULTS, content=text))
    files.append(File.generated(config, OPTIONS, content=_beside("options").every_option()))


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    return inside(REFERENCE.sub(lambda found: _reference(found[1]), markdown), page.file.src_uri)


def _reference(names: str) -> str:
    return "\n\n".join(map(_beside("reference").reference, names.split()))


def _beside(name: str) -> Any:
    """A module of this folder."""
    sys.path.insert(0, str(Path(__file__).parent))
    try:
        return importlib.import_module(name)
    finally:
        del sys.path[0]


def inside(markdown: str, page: str) -> str:
    """A page of docs/ without links to files outside it, which the site does not have."""
    folder = posixpath.dirname(posixpath.join("docs", page))

    def link(found: re.Match[str]) -> str:
        text, target, anchor = found[1], posixpath.normpath(posixpath.join(folder, found[2])), found[3] or ""
        if target.startswith("docs/"):
            return found[0]
        if target == RESULTS:
            return f"[{text}]({posixpath.relpath(posixpath.join('docs', RESULTS), folder)}{anchor})"
        return f"`{target}`" if target.endswith(text.strip("`/")) else f"{text} (`{target}`)"

    return LINK.sub(link, markdown)


def on_post_build(config: Any) -> None:
    search = Path(config.site_dir) / "search"
    index = (search / "search_index.json").read_text()
    (search / "search_index.js").write_text(f"const searchIndex = {index};\n")
