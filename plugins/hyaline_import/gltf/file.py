"""A glTF or GLB file: the parts of its JSON that are read, the bytes that it points to, and the arrays in them.

Source: glTF 2.0 sections 3.6, 4 and 5, and the READMEs of the extensions in KhronosGroup/glTF.
"""

import base64
import binascii
import re
import struct
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import unquote

import numpy as np
from msgspec import Meta, Struct, ValidationError, convert

from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import parse_json
from datagen.disk.storage import find_file
from hyaline_import.foreign import read_foreign

# ruff: noqa: D101  (the names are the format's own)


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


class Accessor(Entry):
    component_type: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Count
    type: str
    buffer_view: Index | None = None
    byte_offset: Index = 0
    normalized: bool = False
    sparse: Any = None


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


class Extension(Struct, rename="camel"):
    """What the extensions say, each some of it, with their defaults."""

    # KHR_texture_transform
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    rotation: float = 0.0
    tex_coord: Channel | None = None
    # EXT_texture_webp
    source: Index | None = None
    # KHR_materials_transmission, _volume
    transmission_factor: float = 0.0
    transmission_texture: Use | None = None
    thickness_factor: float = 0.0
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


class Mesh(Entry):
    primitives: Annotated[list[Primitive], Meta(min_length=1)]
    name: str = ""
    weights: list[float] = []


class Node(Entry):
    name: str = ""
    mesh: Index | None = None
    skin: Index | None = None
    weights: list[float] | None = None
    children: list[Index] = []
    matrix: Annotated[list[float], Meta(min_length=16, max_length=16)] | None = None
    rotation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    translation: Color = (0.0, 0.0, 0.0)
    scale: Color = WHITE


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
    images: list[Image] = []
    materials: list[Material] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = []
    samplers: list[Sampler] = []
    scenes: list[Scene] = []
    textures: list[Texture] = []
    extras: Any = None


LISTS = ("accessors", "buffer_views", "buffers", "images", "materials", "meshes", "nodes", "samplers",
         "scenes", "textures")  # fmt: skip
"""The lists of `Gltf` whose entries know their places."""


_JSON, _BIN = 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
READ_EXTENSIONS = {
    "EXT_mesh_features", "EXT_texture_webp", "KHR_lights_punctual", "KHR_mesh_quantization", "KHR_texture_transform",
    "KHR_xmp", "KHR_xmp_json_ld",
}  # fmt: skip
"""Extensions that a file may require, as it may those of materials: read, without effect, or left out with a remark."""
Listed = TypeVar("Listed", bound=Entry)


def unread(extensions: list[str]) -> list[str]:
    """The extensions that are not read, in order."""
    return sorted(name for name in {*extensions} - READ_EXTENSIONS if not name.startswith("KHR_materials_"))


class GltfFile:
    """The content of a file; its buffers and arrays are each read when they are first asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        data = read_foreign(path)
        text, self._binary = _split_glb(data, path) if data[:4] == b"glTF" else (data, None)
        self.root = read(Gltf, parse_json(text.removeprefix(b"\xef\xbb\xbf"), where=str(path)), where=str(path))
        for name in LISTS:
            for index, entry in enumerate(getattr(self.root, name)):
                entry.where = f"{path}: {name}[{index}]"
        if self.root.asset.version.split(".")[0] != "2":
            raise HyalineError(f"{path}: is glTF of version {shown(self.root.asset.version)}; expected version 2")
        if unknown := unread(self.root.extensions_required):
            raise HyalineError(f"{path}: requires {shown(unknown[0])}, which is not read; export it without that")
        self._buffers: dict[int, bytes] = {}
        self._arrays: dict[int, np.ndarray] = {}

    def item(self, listed: list[Listed], index: int, *, where: str) -> Listed:
        """One entry of a list of the file."""
        if index >= len(listed):
            raise HyalineError(f"{where}: names entry {index} of {len(listed)}; the file is damaged, export it again")
        return listed[index]

    def buffer_view(self, index: int, *, where: str) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride; 0 where it has none."""
        view = self.item(self.root.buffer_views, index, where=where)
        if "EXT_meshopt_compression" in view.extensions:
            raise HyalineError(f"{view.where}: is compressed by meshopt; export the file without that")
        buffer = self._buffer(view.buffer, where=view.where)
        end = view.byte_offset + view.byte_length
        if end > len(buffer):
            raise HyalineError(f"{view.where}: ends at byte {end:,} of {len(buffer):,}; export the file again")
        return memoryview(buffer)[view.byte_offset : end], view.byte_stride

    def uri(self, uri: str, *, where: str) -> bytes:
        """What a URI names: data inside of it, or a file in the folder of this one."""
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            if not head.endswith(";base64"):
                raise HyalineError(f"{where}: is {shown(uri)}; expected data in base64")
            try:
                return base64.b64decode(body, validate=True)
            except (binascii.Error, ValueError) as error:
                raise HyalineError(f"{where}: holds no base64 ({error}); export the file again") from None
        return read_foreign(self.beside(uri, where=where))

    def beside(self, uri: str, *, where: str) -> Path:
        """The file in the folder of this one that a URI names; it may not be there."""
        relative = unquote(uri).removeprefix("./")
        if ":" in relative.split("/")[0]:
            raise HyalineError(f"{where}: names {shown(uri)}; expected a file in the folder of {self.path.name}")
        return find_file(self.path.parent, relative, where=where)

    def _buffer(self, index: int, *, where: str) -> bytes:
        if index not in self._buffers:
            buffer = self.item(self.root.buffers, index, where=where)
            data = self._binary if buffer.uri is None else self.uri(buffer.uri, where=f"{buffer.where}.uri")
            if data is None or (index and buffer.uri is None):
                raise HyalineError(f"{buffer.where}: has no bytes in this file; export it again")
            if len(data) < buffer.byte_length:
                raise HyalineError(f"{buffer.where}: has {len(data):,} of {buffer.byte_length:,} bytes; it is cut off")
            self._buffers[index] = data[: buffer.byte_length]
        return self._buffers[index]

    def array(self, index: int, kind: str, *, where: str) -> np.ndarray:
        """The elements of an accessor: (n, width) of floats, normalised if it asks for it; or (n,) indices."""
        accessor = self.item(self.root.accessors, index, where=where)
        if accessor.type != kind:
            raise HyalineError(f"{accessor.where}: is of type {shown(accessor.type)}; expected {kind!r}")
        if index not in self._arrays:
            self._arrays[index] = self._decoded(accessor, WIDTHS[kind])
        return self._arrays[index]

    def _decoded(self, accessor: Accessor, width: int) -> np.ndarray:
        where, shape = accessor.where, (accessor.count, width)
        if accessor.buffer_view is None or accessor.sparse is not None:
            raise HyalineError(f"{where}: is a sparse array, which is not read; export the file without those")
        dtype = np.dtype(COMPONENTS[accessor.component_type])
        content, stride = self.buffer_view(accessor.buffer_view, where=where)
        size = width * dtype.itemsize
        stride = stride or size  # Each row begins that many bytes after the last one.
        end = accessor.byte_offset + (accessor.count - 1) * stride + size
        if stride < size or end > len(content):
            raise HyalineError(
                f"{where}: needs {end:,} of {len(content):,} bytes, {size} every {stride}; export the file again"
            )
        raw = np.ndarray(shape, dtype, content, accessor.byte_offset, (stride, dtype.itemsize))
        if dtype.kind == "f":
            with np.errstate(invalid="ignore"):  # Some kinds of NaN warn when they are cast.
                values = raw.astype(np.float64)
            if not np.isfinite(values).all():
                raise HyalineError(f"{where}: holds numbers that are not finite; export the file again")
            return values
        if width == 1 and not accessor.normalized:
            return raw[:, 0].astype(np.int64)
        largest = float(2 ** (8 * dtype.itemsize - (dtype.kind == "i")) - 1)
        return np.maximum(raw / largest, -1.0) if accessor.normalized else raw.astype(np.float64)


def _split_glb(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB."""
    version, length = struct.unpack_from("<II", data, 4) if len(data) >= 20 else (2, len(data) + 1)
    if version != 2:
        raise HyalineError(f"{path}: is a GLB of version {version}; expected version 2")
    chunks: list[tuple[int, bytes]] = []
    at = 12
    while at + 8 <= length <= len(data) and len(chunks) < 2:
        size, kind = struct.unpack_from("<II", data, at)
        chunks.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if max(at, length) > len(data):
        raise HyalineError(f"{path}: has {len(data):,} of {max(at, length):,} bytes; it is cut off, export it again")
    if not chunks or chunks[0][0] != _JSON:
        raise HyalineError(f"{path}: its first chunk is not JSON; expected a GLB, export it again")
    return chunks[0][1].rstrip(b" \0"), next((chunk for kind, chunk in chunks[1:] if kind == _BIN), None)
