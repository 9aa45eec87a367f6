"""The nodes of a Mitsuba scene, parsed and not made: values by type, children, files of the scene's folder; and its
BSDFs in the terms of foreign materials.

Mitsuba's own parser follows includes to any file (3.9). So the XML is looked at first: it must be XML, declare no
document type, and include no other file. A nesting of 200,000 tags ends the process, which is made for that.
"""

import math
import xml.parsers.expat
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import find_file
from datagen.scene.materials import Color
from hyaline_import.foreign import ForeignImage, ForeignMaterial, clipped, clipped_color, read_foreign
from hyaline_import.gltf.materials import REPEATS
from hyaline_import.pictures import stored
from hyaline_import.remarks import Remarks

MAX_VALUE = 1e9
MAX_BYTES = 1 << 25
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

    def begin(tag: str, _: dict[str, str]) -> None:
        if tag in REFUSED:
            raise HyalineError(f"{path}: has a tag <{tag}>, which is not read; remove it")

    def refuse(*_: object) -> None:
        raise HyalineError(f"{path}: declares a document type; expected none in a scene")

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler, parser.StartDoctypeDeclHandler = begin, refuse
    try:
        parser.Parse(read_foreign(path, at_most=MAX_BYTES), True)
    except (xml.parsers.expat.ExpatError, ValueError, LookupError) as error:
        raise HyalineError(f"{path}: not XML that can be read ({error})") from None


# BSDFs

IORS = {
    "vacuum": 1.0, "helium": 1.000036, "hydrogen": 1.000132, "air": 1.000277, "carbon dioxide": 1.00045,
    "water": 1.3330, "acetone": 1.36, "ethanol": 1.361, "carbon tetrachloride": 1.461, "glycerol": 1.4729,
    "benzene": 1.501, "silicone oil": 1.52045, "bromine": 1.661, "water ice": 1.31, "fused quartz": 1.458,
    "pyrex": 1.470, "acrylic glass": 1.49, "polypropylene": 1.49, "bk7": 1.5046, "sodium chloride": 1.544,
    "amber": 1.55, "pet": 1.5750, "diamond": 2.419,
}  # fmt: skip
"""Source: Mitsuba 3's documentation of `dielectric`."""

METALS: dict[str, Color] = {
    "none": (1.0, 1.0, 1.0),
    "Au": (1.0, 0.78, 0.34),
    "Ag": (0.97, 0.96, 0.91),
    "Al": (0.91, 0.92, 0.92),
    "Cu": (0.96, 0.64, 0.54),
    "Cr": (0.55, 0.55, 0.55),
}
"""Reflectance at normal incidence."""

WRAPPERS = ("twosided", "mask", "bumpmap", "normalmap")
"""BSDFs around another one."""
MAX_NESTED = 8
"""BSDFs within BSDFs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundMaterial:
    """A material, and how its image lies: (4, 4), from uv of the mesh to uv of the image."""

    material: ForeignMaterial
    image_from_uv: np.ndarray = field(default_factory=lambda: np.eye(4))


def read_bsdf(node: Node, remarks: Remarks, *, depth: int = 0) -> FoundMaterial:
    """The material of a BSDF."""
    if node.plugin in WRAPPERS:
        inner = node.inner("BSDF")
        if inner is None or depth > MAX_NESTED:
            raise HyalineError(
                f"{node.where}: holds no BSDF, itself, or more than {MAX_NESTED} others; expected a BSDF"
            )
        if node.plugin != "twosided":
            remarks.approximate(node.name, f"is a {node.plugin}; only the material inside it is drawn")
        return read_bsdf(inner, remarks, depth=depth + 1)
    if node.plugin not in READERS:
        known = ", ".join(sorted([*READERS, *WRAPPERS]))
        raise HyalineError(f"{node.where}: is of a kind that is not read; known are {known}")
    return READERS[node.plugin](node, remarks)


def _ior(node: Node, key: str, default: str) -> float:
    if key not in node or isinstance(node.props[key], str):
        name = node.text(key, default)
        if name not in IORS:
            raise HyalineError(f"{node.where}: {key} is {shown(name)}; expected a number, or one of {', '.join(IORS)}")
        return IORS[name]
    return node.number(key, 1.5)


def _ratio(node: Node, inside: str = "bk7") -> float:
    int_ior, ext_ior = _ior(node, "int_ior", inside), _ior(node, "ext_ior", "air")
    if not 1 <= int_ior / max(ext_ior, 1e-9) < 10:
        raise HyalineError(
            f"{node.where}: has int_ior {int_ior:g} and ext_ior {ext_ior:g}; expected a ratio of 1 to 10: make each "
            "medium a closed mesh with ext_ior 1, the inner one in the outer one, where it fills the space"
        )
    return int_ior / ext_ior


def _facets(node: Node, remarks: Remarks) -> float:
    """The perceptual roughness of GGX facets."""
    if (name := node.text("distribution", "beckmann")) != "ggx":
        remarks.approximate(node.name, f"has facets of the distribution {name}; drawn with GGX of the same alpha")
    if "alpha_u" in node:
        remarks.approximate(node.name, "has a grain (alpha_u, alpha_v); drawn without one")
        return clipped(node.number("alpha_u", 0.1) * node.number("alpha_v", 0.1)) ** 0.25
    if (texture := node.child("alpha")) is None:
        return math.sqrt(clipped(node.number("alpha", 0.1)))
    if texture.plugin != "bitmap":
        raise HyalineError(f"{texture.where}: is roughness of a kind that is not read; known is bitmap")
    image = ForeignImage(name=node.name, data=read_foreign(texture.file("filename")))
    mean = float(stored(image)[..., :3].mean()) / 255
    remarks.approximate(node.name, f"has an image of roughness; drawn with its mean, alpha {mean:.2f}")
    return math.sqrt(mean)


def _remark_on_scale(node: Node, key: str, remarks: Remarks) -> None:
    """A line for a reflectance or transmittance that the file scales."""
    if node.child(key) is not None or node.color(key, 1.0) != (1, 1, 1):
        remarks.approximate(node.name, f"scales its {key.removeprefix('specular_')}, which is left out")


def _glass(node: Node, remarks: Remarks) -> FoundMaterial:
    key, is_thin, color = "specular_transmittance", node.plugin == "thindielectric", (1.0, 1.0, 1.0)
    _remark_on_scale(node, "specular_reflectance", remarks)
    if node.child(key) is None:
        color = clipped_color(node.color(key, 1.0))
    else:
        _remark_on_scale(node, key, remarks)
    material = ForeignMaterial(
        name=node.name,
        # What passes both surfaces of a solid is its colour.
        base_color=color if is_thin else clipped_color(c**2 for c in color),
        transmission=1.0,
        ior=_ratio(node),
        is_volume=not is_thin,
        is_thin=is_thin,
        roughness=_facets(node, remarks) if node.plugin == "roughdielectric" else 0.0,
    )
    return FoundMaterial(material=material)


def _diffuse(node: Node, remarks: Remarks) -> FoundMaterial:
    return _colored(ForeignMaterial(name=node.name, roughness=1.0, ior=1.0), node, "reflectance", 0.5, remarks)


def _plastic(node: Node, remarks: Remarks) -> FoundMaterial:
    if not node.flag("nonlinear"):
        remarks.approximate(node.name, "has a base without colour shifts from light below its coat; drawn with them")
    _remark_on_scale(node, "specular_reflectance", remarks)
    roughness = _facets(node, remarks) if node.plugin == "roughplastic" else 0.0
    ior = max(_ratio(node, "polypropylene"), 1.0001)
    material = ForeignMaterial(name=node.name, roughness=roughness, ior=ior, is_base=True)
    return _colored(material, node, "diffuse_reflectance", 0.5, remarks)


def _conductor(node: Node, remarks: Remarks) -> FoundMaterial:
    name = node.text("material", "none")
    if name not in METALS:
        raise HyalineError(f"{node.where}: is the metal {shown(name)}; expected one of {', '.join(METALS)}")
    color = METALS[name]
    if "eta" in node:
        # Fresnel's reflectance of a metal at normal incidence.
        eta, k = np.array(node.color("eta", 0.0)), np.array(node.color("k", 1.0))
        color = (((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)).tolist()
    if "eta" in node or name != "none":
        remarks.approximate(node.name, "is a metal; drawn with its reflectance at normal incidence at all angles")
    key, roughness = "specular_reflectance", _facets(node, remarks) if node.plugin == "roughconductor" else 0.0
    metal = ForeignMaterial(name=node.name, base_color=clipped_color(color), metallic=1.0, roughness=roughness)
    found = _colored(metal, node, key, 1.0, remarks)
    if node.child(key) is None:
        color = (a * b for a, b in zip(color, found.material.base_color, strict=True))
    return replace(found, material=replace(found.material, base_color=clipped_color(color)))


def _principled(node: Node, remarks: Remarks) -> FoundMaterial:
    for key in ("clearcoat", "sheen", "flatness", "anisotropic", "spec_tint"):
        if key in node and (node.child(key) is not None or node.number(key, 0.0) > 0):
            remarks.approximate(node.name, f"has {key}, which is left out")
    specular = min(max(node.number("specular", 0.5), 1e-3), 1.0)
    eta = node.number("eta", 2 / (1 - math.sqrt(0.08 * specular)) - 1)
    material = ForeignMaterial(
        name=node.name,
        metallic=clipped(node.number("metallic", 0.0)),
        roughness=clipped(node.number("roughness", 0.5)),
        transmission=clipped(node.number("spec_trans", 0.0)),
        is_volume=True,
        ior=min(max(eta, 1.0), 9.0),
    )
    return _colored(material, node, "base_color", 0.5, remarks)


READERS = {
    "dielectric": _glass, "roughdielectric": _glass, "thindielectric": _glass, "diffuse": _diffuse,
    "plastic": _plastic, "roughplastic": _plastic, "conductor": _conductor, "roughconductor": _conductor,
    "principled": _principled,
}  # fmt: skip


def absorption_of(medium: Node | None) -> Color:
    """What a homogeneous medium takes away, per unit of length."""
    if medium is None:
        return (0.0, 0.0, 0.0)
    if medium.plugin != "homogeneous":
        raise HyalineError(f"{medium.where}: is not a homogeneous medium; expected one, or none")
    if max(medium.color("albedo", 0.75)) > 0:
        raise HyalineError(f"{medium.where}: scatters light; expected an albedo of 0, which only absorbs")
    scale = medium.number("scale", 1.0)
    red, green, blue = (scale * c for c in medium.color("sigma_t", 1.0))
    return red, green, blue


def _colored(material: ForeignMaterial, node: Node, key: str, default: float, remarks: Remarks) -> FoundMaterial:
    """The material with a colour, or the image of a texture."""
    texture = node.child(key)
    if texture is None:
        return FoundMaterial(material=replace(material, base_color=clipped_color(node.color(key, default))))
    if texture.plugin != "bitmap":
        raise HyalineError(f"{texture.where}: is of a kind that is not read; known is bitmap")
    if texture.flag("raw"):
        remarks.approximate(node.name, "has an image of linear values; drawn as sRGB")
    image = ForeignImage(name=node.name, data=read_foreign(texture.file("filename")))
    if texture.text("wrap_mode", "repeat") != "repeat":
        remarks.approximate(node.name, REPEATS)
    return FoundMaterial(material=replace(material, image=image), image_from_uv=texture.matrix("to_uv"))
