"""Pages as a browser would take them: what their markup holds, and whether it is whole."""

import base64
import hashlib
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser

from datagen.pages.html import VOID

ADDRESSES = ("src", "href", "action", "data", "poster", "srcset", "xlink:href", "formaction")


@dataclass
class Element:
    """One element of a page, in order of its opening."""

    name: str
    attributes: dict[str, str | None]
    text: str = ""


@dataclass
class ReadPage(HTMLParser):
    """A page that was read to its end; `check_whole` says what is wrong with it."""

    source: str
    elements: list[Element] = field(default_factory=list)
    open_: list[Element] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.feed(self.source)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len({name for name, _ in attrs}) == len(attrs), f"<{tag}> names an attribute twice"
        element = Element(tag, dict(attrs))
        self.elements.append(element)
        if tag not in VOID:
            self.open_.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(Element(tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open_ and self.open_[-1].name == tag, f"</{tag}> ends what is not open"
        self.open_.pop()

    def handle_data(self, data: str) -> None:
        for element in self.open_:
            element.text += data

    def all(self, name: str) -> list[Element]:
        return [element for element in self.elements if element.name == name]


def read_page(data: bytes) -> ReadPage:
    """The page, when it is whole, asks for nothing outside of it, and lets nothing run but its own script.

    Raises:
        AssertionError: saying what is wrong.
    """
    page = ReadPage(data.decode())
    assert not page.open_, f"<{page.open_[-1].name}> is never closed"
    ids = [element.attributes["id"] for element in page.elements if "id" in element.attributes]
    assert len(set(ids)) == len(ids), "two elements have one id"
    for element in page.elements:
        assert not any(name.startswith("on") for name in element.attributes), f"<{element.name}> runs a script"
        assert "style" not in element.attributes, "the policy lets no style stand in an attribute"
        for name in ADDRESSES:
            if (address := element.attributes.get(name)) is not None:
                assert address.startswith(("#", "data:image/")) or element.name == "a", f"asks for {address[:80]}"
                assert not address.startswith("#") or address[1:] in ids, f"{address} leads nowhere"
    for name in ("aria-labelledby", "for"):
        assert all(element.attributes[name] in ids for element in page.elements if name in element.attributes)
    _check_policy(page)
    return page


def _check_policy(page: ReadPage) -> None:
    (policy,) = [
        element.attributes["content"] or ""
        for element in page.all("meta")
        if element.attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert (rules["default-src"], rules["img-src"]) == ("'none'", "data:")
    for name, rule in (("style", "style-src"), ("script", "script-src")):
        (element,) = page.all(name)
        digest = base64.b64encode(hashlib.sha256(element.text.encode()).digest()).decode()
        assert rules[rule] == f"'sha256-{digest}'"
    assert not re.search(r"@import|url\(", page.all("style")[0].text)
