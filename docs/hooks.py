"""Hooks of mkdocs: RESULTS.md and the API reference become pages, links to other files become their paths, search works
from disk."""

import posixpath
import re
import sys
from pathlib import Path
from typing import Any

RESULTS = "RESULTS.md"
REFERENCE = re.compile(r"^::: (.+)$", re.MULTILINE)
"""Names of `hyaline` in a page, whose reference takes their place."""
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((\.\./[^)#\s]*)(#[^)\s]*)?\)")


def on_files(files: Any, config: Any) -> None:
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

    text = (Path(config.docs_dir).parent / RESULTS).read_text()
    text = text.replace("[docs/results](docs/results)", "`docs/results`").replace("](docs/", "](")
    files.append(File.generated(config, RESULTS, content=text))


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    return inside(REFERENCE.sub(lambda found: _reference(found[1]), markdown), page.file.src_uri)


def _reference(names: str) -> str:
    sys.path.insert(0, str(Path(__file__).parent))
    try:
        from reference import reference  # pyright: ignore[reportMissingImports]
    finally:
        del sys.path[0]
    return "\n\n".join(map(reference, names.split()))


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
