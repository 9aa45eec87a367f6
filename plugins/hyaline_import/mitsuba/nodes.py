"""The nodes of a Mitsuba scene, parsed and not made: values by type, children, and files of the scene's folder.

Mitsuba's own parser follows includes to any file, and a nesting of 200,000 tags ends its process (3.9). So the XML is
looked at first: it must be XML, not be deep, declare no document type, and include no other file.
"""

import xml.parsers.expat
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import find_file
from datagen.scene.materials import Color
from hyaline_import.foreign import read_foreign

MAX_VALUE = 1e9
MAX_BYTES = 1 << 25
MAX_DEPTH = 32
MAX_TAGS = 200_000
REFUSED = ("path", "resources", "alias", "include")
"""Tags that name other folders, files and objects, which no scene needs that is complete in its folder."""
EQUAL_ENERGY = (1.20479, 0.948291, 0.908916)
"""Linear sRGB of light that is equally strong at all wavelengths, as Mitsuba 3.9 converts it."""


class Node:
    """One object of the scene: its plugin's name and its unused properties."""

    def __init__(self, scene: "NodeList", index: int) -> None:
        self.scene, self.index = scene, index
        props = scene.nodes[index].props
        self.plugin: str = props.plugin_name()
        self.name: str = props.id() or self.plugin
        self.where = f"{scene.path}: {self.plugin} {shown(self.name)}"
        self.props: dict[str, object] = {key: props[key] for key in props.keys()}  # noqa: SIM118
        self.kind: str = str(scene.nodes[index].type).rpartition(".")[2]

    def __contains__(self, key: str) -> bool:
        return key in self.props

    def number(self, key: str, default: float) -> float:
        """A finite number."""
        value = self.props.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_VALUE:
            raise HyalineError(f"{self.where}: {key} is {shown(value)}; expected a number")
        return float(value)

    def text(self, key: str, default: str) -> str:
        """A string."""
        value = self.props.get(key, default)
        if not isinstance(value, str):
            raise HyalineError(f"{self.where}: {key} is {shown(value)}; expected a word")
        return value

    def flag(self, key: str, default: bool = False) -> bool:
        """True or false."""
        return self.props.get(key, default) is True

    def color(self, key: str, default: float) -> Color:
        """A number, three, or a spectrum with one value, none below 0."""
        value = self.props.get(key, default)
        values = (value,) * 3 if isinstance(value, int | float) else self._listed(value)
        if getattr(value, "is_uniform", bool)():  # A spectrum. Its class in 3.9 is not `mi.Spectrum`.
            level, white = getattr(value, "values", (0.0,))[0], EQUAL_ENERGY if key == "radiance" else (1, 1, 1)
            values = [level * c for c in white]
        if values is None or len(values) != 3 or not all(0 <= c < MAX_VALUE for c in values):
            raise HyalineError(f"{self.where}: {key} is {shown(str(value))}; expected a colour of three numbers")
        red, green, blue = (float(c) for c in values)
        return red, green, blue

    def point(self, key: str, default: tuple[float, float, float]) -> np.ndarray:
        """Three finite numbers."""
        values = self._listed(self.props.get(key, list(default)))
        if values is None or len(values) != 3 or not np.isfinite(values).all():
            raise HyalineError(f"{self.where}: {key} is not a point; expected three numbers")
        return np.array(values, np.float64)

    def matrix(self, key: str) -> np.ndarray:
        """A transform (4, 4); the identity if missing."""
        if key not in self.props:
            return np.eye(4)
        matrix = np.array(getattr(self.props[key], "matrix", np.zeros((0, 0))), np.float64)
        if matrix.shape == (3, 3):  # Of a texture: in two dimensions.
            matrix = np.block([[matrix[:2, :2], np.zeros((2, 1)), matrix[:2, 2:]], [np.zeros((2, 2)), np.eye(2)]])
        if matrix.shape != (4, 4) or not (np.abs(matrix) < MAX_VALUE).all() or abs(np.linalg.det(matrix)) < 1e-30:
            raise HyalineError(f"{self.where}: {key} is not an invertible transform; expected one with finite numbers")
        return matrix

    def file(self, key: str) -> Path:
        """A file that it names, in the scene's folder."""
        name = self.text(key, "")
        found = find_file(self.scene.path.parent, name.replace("\\", "/").removeprefix("./"), where=self.where)
        if not found.exists():
            raise HyalineError(f"{self.where}: names {shown(name)}, which is not in the scene's folder")
        return found

    def child(self, key: str) -> "Node | None":
        """The object under a name; None if missing, or a plain value."""
        index = self.scene.index_of(self.props.get(key))
        return None if index is None else Node(self.scene, index)

    def children(self) -> list["Node"]:
        """All objects that it holds or refers to, but textures."""
        found = [self.child(key) for key in self.props]
        return [node for node in found if node is not None]

    def named(self, kind: str) -> "dict[str, Node]":
        """Its objects of a kind by the names that the file gives them here, or by their own."""
        children = {key: self.child(key) for key in self.props}
        found = ((key, node) for key, node in children.items() if node is not None and node.kind == kind)
        return {node.name if key.startswith("_arg_") else key: node for key, node in found}

    def inner(self, kind: str) -> "Node | None":
        """The first of its objects of a kind, such as BSDF."""
        return next((node for node in self.children() if node.kind == kind), None)

    @staticmethod
    def _listed(value: object) -> list[float] | None:
        try:
            return [float(item) for item in value]  # pyright: ignore[reportGeneralTypeIssues]
        except (TypeError, ValueError):
            return None


class NodeList:
    """All nodes of a scene file."""

    def __init__(self, path: Path) -> None:
        from datagen.machine.mitsuba_variant import use_parser

        check_text(path)
        use_parser()
        import mitsuba as mi

        self.path = path
        try:
            config = mi.parser.ParserConfig("scalar_rgb")
            state = mi.parser.parse_file(config, str(path))
            mi.parser.transform_upgrade(config, state)  # Scenes of Mitsuba 0.x: toWorld, intIOR, ...
        # The parser answers a broken file with several kinds of exception (RuntimeError, UnicodeDecodeError, ...).
        except Exception as error:
            reason = " ".join(str(error).replace(str(path), path.name).split())
            raise HyalineError(f"{path}: not a scene of Mitsuba 3 ({shown(reason[-300:])})") from None
        self.nodes = state.nodes
        self._by_name: dict[str, int] = dict(state.id_to_index)
        self.root = Node(self, 0)
        if self.root.kind != "Scene":
            raise HyalineError(f"{path}: holds a {self.root.kind}; expected a scene")

    def index_of(self, value: object) -> int | None:
        """The node that a property refers to, if it does."""
        import mitsuba as mi

        if isinstance(value, mi.Properties.ResolvedReference):
            return int(value.index())
        if isinstance(value, mi.Properties.Reference):
            name = str(value.id())
            if name not in self._by_name:
                raise HyalineError(f"{self.path}: refers to {shown(name)}, which is not there")
            return self._by_name[name]
        return None


def check_text(path: Path) -> None:
    """Refuses an XML file that Mitsuba's parser must not see."""
    depth = count = 0

    def begin(tag: str, _: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MAX_DEPTH or count > MAX_TAGS:
            raise HyalineError(f"{path}: has more than {MAX_DEPTH} levels or {MAX_TAGS:,} tags; expected fewer")
        if tag in REFUSED:
            raise HyalineError(f"{path}: has a tag <{tag}>, which is not read; remove it")

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
