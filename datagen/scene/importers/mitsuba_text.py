"""A look at a Mitsuba XML before Mitsuba's own parser gets it: that parser follows includes to any file, and nests.

Only this is read here: that the XML is one, is not deep, declares no document type, and includes files of its own
folder alone. Source: the parser of Mitsuba 3.9 follows `include`, and a nesting of 200,000 tags ends the process.
"""

import xml.parsers.expat
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.disk.records import shown
from datagen.scene.importers.foreign import read_foreign

MAX_BYTES = 1 << 25
MAX_DEPTH = 32
MAX_TAGS = 200_000
MAX_INCLUDES = 32
REFUSED = {
    "path": "names folders in which plugins are looked for",
    "resources": "names folders in which plugins are looked for",
    "alias": "gives a second name to an object",
}
"""Tags that no scene needs which is complete in its folder."""


def check_text(path: Path) -> None:
    """Refuses an XML file, and what it includes, that Mitsuba's parser must not see.

    Raises:
        HyalineError: naming what it is.
    """
    waiting, seen = [path], {path.resolve()}
    while waiting:
        for included in _includes(waiting.pop(), path.parent):
            if included.resolve() in seen or len(seen) > MAX_INCLUDES:
                raise HyalineError(
                    f"{path}: includes {included.name} again; expected at most {MAX_INCLUDES} files, once"
                )
            seen.add(included.resolve())
            waiting.append(included)


def _includes(path: Path, root: Path) -> list[Path]:
    """The files that one file includes, after all of it was looked at."""
    included: list[Path] = []
    depth = count = 0

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MAX_DEPTH or count > MAX_TAGS:
            raise HyalineError(
                f"{path}: has more than {MAX_DEPTH} levels or {MAX_TAGS:,} tags; expected a smaller scene"
            )
        if tag in REFUSED:
            raise HyalineError(f"{path}: has a tag <{tag}>, which {REFUSED[tag]}; remove it")
        if tag == "include":
            name = attributes.get("filename", "")
            found = find_file(root, name.removeprefix("./"), where=f"{path}: include")
            if "$" in name or not found.exists():
                raise HyalineError(f"{path}: includes {shown(name)}, which is not in its folder")
            included.append(found)

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def refuse(*_: object) -> None:
        raise HyalineError(f"{path}: declares a document type; expected none in a scene")

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = begin, end, refuse
    try:
        parser.Parse(read_foreign(path, at_most=MAX_BYTES), True)
    except (xml.parsers.expat.ExpatError, ValueError, LookupError) as error:
        raise HyalineError(f"{path}: not XML that can be read ({error})") from None
    return included
