# ruff: noqa: D101  (the names are the format's own)
"""The parts of a glTF file's JSON and of its extensions that are read; everything else is passed over.

Source: glTF 2.0 section 5, and the READMEs of the extensions in KhronosGroup/glTF.
"""

import re
from typing import Annotated, Any, Literal, TypeVar

from msgspec import Meta, Struct, ValidationError, convert

from datagen.disk.errors import HyalineError

Index = Annotated[int, Meta(ge=0, le=1 << 40)]
Count = Annotated[int, Meta(ge=1, le=1 << 40)]
Positive = Annotated[float, Meta(gt=0)]
Channel = Annotated[int, Meta(ge=0, le=31)]
Color = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
WHITE = (1.0, 1.0, 1.0)
T = TypeVar("T")


def read(kind: type[T], data: object, *, where: str) -> T:
    """The record that JSON describes.

    Raises:
        HyalineError: a value is missing or of the wrong type, named by its place.
    """
    try:
        return convert(data, kind, strict=False)  # Exporters write 3.0 for a count of 3.
    except ValidationError as error:
        what, _, place = str(error).partition(" - at `$")
        inside = re.sub(r"^\.|`$", "", place)
        raise HyalineError(f"{where}{f': {inside}' if inside else ''}: {what}; export the file again") from None


class Entry(Struct, rename="camel", kw_only=True):
    """An object of the file that may have extensions."""

    extensions: dict[str, Any] = {}
    where: str = ""
    """Its place in the file, for errors."""

    def extension(self, name: str) -> "Extension":
        """What an extension says; its defaults where it is missing."""
        return read(Extension, self.extensions.get(name, {}), where=f"{self.where}.extensions.{name}")


class Asset(Entry):
    version: str
    copyright: Any = None
    extras: Any = None


class Part(Struct, rename="camel"):
    """Where the places or the values of a sparse array are."""

    buffer_view: Index
    byte_offset: Index = 0
    component_type: Literal[5121, 5123, 5125] = 5123


class Sparse(Struct, rename="camel"):
    """The elements of an array that differ from its base."""

    count: Count
    indices: Part
    values: Part


class Accessor(Entry):
    component_type: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Count
    type: str
    buffer_view: Index | None = None
    """None for an array of zeros."""
    byte_offset: Index = 0
    normalized: bool = False
    sparse: Sparse | None = None


class BufferView(Entry):
    buffer: Index
    byte_length: Count
    byte_offset: Index = 0
    byte_stride: Annotated[int, Meta(ge=0, le=252)] = 0


class Buffer(Entry):
    byte_length: Index
    uri: str | None = None


class Image(Entry):
    uri: str | None = None
    buffer_view: Index | None = None


class Sampler(Entry):
    wrap_s: int = 10497
    wrap_t: int = 10497


class Texture(Entry):
    source: Index | None = None
    sampler: Index | None = None


class Use(Entry):
    """A texture as a material uses it."""

    index: Index
    tex_coord: Channel = 0


class Metallic(Struct, rename="camel", frozen=True):
    base_color_factor: Quaternion = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: Use | None = None
    metallic_factor: float | None = None
    """1 if it is missing."""
    roughness_factor: float = 1.0
    metallic_roughness_texture: Use | None = None


class Material(Entry):
    name: str = ""
    pbr_metallic_roughness: Metallic = Metallic()
    normal_texture: Any = None
    occlusion_texture: Any = None
    emissive_texture: Any = None
    emissive_factor: Color = (0.0, 0.0, 0.0)
    alpha_mode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alpha_cutoff: float = 0.5
    extras: Any = None


class Extras(Struct):
    """What a user may add to a material."""

    priority: Annotated[int, Meta(ge=-9, le=9)] = 0


class Extension(Struct, rename="camel"):
    """What the extensions say, each some of it, with their defaults."""

    # KHR_texture_transform
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    rotation: float = 0.0
    tex_coord: Channel | None = None
    # EXT_texture_webp
    source: Index | None = None
    # KHR_materials_pbrSpecularGlossiness
    diffuse_factor: Quaternion = (1.0, 1.0, 1.0, 1.0)
    diffuse_texture: Use | None = None
    specular_factor: Color = WHITE
    glossiness_factor: float = 1.0
    specular_glossiness_texture: Use | None = None
    # KHR_materials_transmission, _volume
    transmission_factor: float = 0.0
    transmission_texture: Use | None = None
    thickness_factor: float = 0.0
    thickness_texture: Any = None
    attenuation_color: Color = WHITE
    attenuation_distance: Positive | None = None
    # KHR_materials_ior (0 mirrors everything), _dispersion, _emissive_strength
    ior: float = 1.5
    dispersion: float = 0.0
    emissive_strength: float = 1.0


class Primitive(Entry):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Meta(ge=0, le=6)] = 4
    targets: list[dict[str, Index]] = []


class Mesh(Entry):
    primitives: Annotated[list[Primitive], Meta(min_length=1)]
    name: str = ""
    weights: tuple[float, ...] = ()
    """The weights of its morph targets."""


class Skin(Entry):
    joints: Annotated[list[Index], Meta(min_length=1)]
    inverse_bind_matrices: Index | None = None


class Node(Entry):
    name: str = ""
    mesh: Index | None = None
    camera: Index | None = None
    skin: Index | None = None
    weights: tuple[float, ...] | None = None
    children: list[Index] = []
    matrix: Annotated[list[float], Meta(min_length=16, max_length=16)] | None = None
    rotation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    translation: Color = (0.0, 0.0, 0.0)
    scale: Color = WHITE


class Perspective(Struct, rename="camel"):
    yfov: Annotated[float, Meta(gt=0, lt=3.14159)]
    aspect_ratio: Annotated[float, Meta(gt=0, lt=1000)] = 1.0


class Camera(Entry):
    type: str = "perspective"
    name: str = ""
    perspective: Perspective | None = None


class Scene(Entry):
    nodes: list[Index] = []


class Gltf(Entry):
    """A whole file."""

    asset: Asset
    extensions_used: list[str] = []
    extensions_required: list[str] = []
    scene: Index = 0
    accessors: list[Accessor] = []
    animations: Any = None
    buffer_views: list[BufferView] = []
    buffers: list[Buffer] = []
    cameras: list[Camera] = []
    images: list[Image] = []
    materials: list[Material] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = []
    samplers: list[Sampler] = []
    scenes: list[Scene] = []
    skins: list[Skin] = []
    textures: list[Texture] = []
    extras: Any = None


LISTS = ("accessors", "buffer_views", "buffers", "cameras", "images", "materials", "meshes", "nodes", "samplers",
         "scenes", "skins", "textures")  # fmt: skip
"""The lists of `Gltf` whose entries know their places."""
