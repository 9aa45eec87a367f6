"""A glTF or GLB file: its JSON, the bytes that it points to, inside the file or beside it, and the arrays in them.

Source: glTF 2.0 sections 3.6 and 4, KHR_draco_mesh_compression.
"""

import base64
import binascii
import importlib.util
import struct
import sys
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.disk.records import parse_json, shown
from datagen.machine.processes import ChildError, arrays_from_child
from datagen.terminal.distribution import install_command
from hyaline_import.fields import Fields
from hyaline_import.foreign import read_foreign

_JSON, _BIN = 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MAX_VALUES = 1 << 27
"""Numbers in one array."""
TIMEOUT_S = 60
"""Time limit of the child process that decodes Draco, in seconds."""
MAX_JSON_BYTES = 1 << 28
"""A .gltf may hold its buffers as base64."""
READ_EXTENSIONS = {
    "EXT_mesh_features",
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_draco_mesh_compression",
    "KHR_lights_punctual",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_diffuse_transmission",
    "KHR_materials_dispersion",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_variants",
    "KHR_materials_volume",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_xmp",
    "KHR_xmp_json_ld",
}
"""Extensions that a file may require: read, or left out with a remark of their own."""


class GltfFile:
    """The JSON of a file, and its buffers, each read when it is first asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        data = read_foreign(path)
        text, self._binary = _split_glb(data, path) if data[:4] == b"glTF" else (data, None)
        if len(text) > MAX_JSON_BYTES:
            raise HyalineError(f"{path}: its JSON has {len(text):,} bytes; expected at most {MAX_JSON_BYTES:,}")
        self.root = Fields(parse_json(text.removeprefix(b"\xef\xbb\xbf"), where=str(path)), str(path))
        self._buffers: dict[int, bytes] = {}
        _check_version(self.root)
        self.lists = {
            name: self.root.listed(name)
            for name in (
                "accessors",
                "bufferViews",
                "buffers",
                "cameras",
                "images",
                "materials",
                "meshes",
                "nodes",
                "scenes",
                "textures",
                "samplers",
            )
        }

    def item(self, name: str, index: int, *, where: str) -> Fields:
        """One item of a top-level list."""
        if index >= len(self.lists[name]):
            raise HyalineError(f"{where}: names {name}[{index}]; the file has {len(self.lists[name])}")
        return self.lists[name][index]

    def buffer_view(self, index: int, *, where: str) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride; 0 where it has none."""
        view = self.item("bufferViews", index, where=where)
        if view.extension("EXT_meshopt_compression") is not None:
            raise HyalineError(f"{view.where}: is compressed by meshopt; export the file without that")
        buffer = self._buffer(view.integer("buffer"), where=view.where)
        start, length = view.integer("byteOffset", 0), view.integer("byteLength", low=1)
        if start + length > len(buffer):
            raise HyalineError(
                f"{view.where}: spans bytes {start:,} to {start + length:,} of a buffer of {len(buffer):,}; "
                "the file is damaged, export it again"
            )
        stride = view.integer("byteStride", 0, high=252)
        return memoryview(buffer)[start : start + length], stride

    def uri(self, uri: str, *, where: str) -> bytes:
        """What a URI names: data inside of it, or a file in the folder of this one."""
        if uri.startswith("data:"):
            head, comma, body = uri.partition(",")
            if not comma or not head.endswith(";base64"):
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
            buffer = self.item("buffers", index, where=where)
            data = self.uri(buffer.text("uri"), where=f"{buffer.where}.uri") if "uri" in buffer else self._binary
            length = buffer.integer("byteLength")
            if data is None or (index and "uri" not in buffer):
                raise HyalineError(f"{buffer.where}: has no bytes in this file; export it again")
            if len(data) < length:
                raise HyalineError(
                    f"{buffer.where}: has {len(data):,} bytes, and {length:,} are promised; "
                    "the file is cut off, export it again"
                )
            self._buffers[index] = data[:length]
        return self._buffers[index]


def _split_glb(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB."""
    if len(data) < 20:
        raise HyalineError(f"{path}: is cut off after {len(data)} bytes; expected a GLB, export it again")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise HyalineError(f"{path}: is a GLB of version {version}; expected version 2")
    if length > len(data):
        raise HyalineError(f"{path}: has {len(data):,} of {length:,} bytes; it is cut off, export it again")
    chunks: list[tuple[int, bytes]] = []
    at = 12
    while at + 8 <= length and len(chunks) < 2:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise HyalineError(f"{path}: a chunk of {size:,} bytes is cut off; export it again")
        chunks.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if not chunks or chunks[0][0] != _JSON:
        raise HyalineError(f"{path}: its first chunk is not JSON; expected a GLB, export it again")
    return chunks[0][1].rstrip(b" \0"), next((chunk for kind, chunk in chunks[1:] if kind == _BIN), None)


def _check_version(root: Fields) -> None:
    version = root.fields("asset").text("version")
    if version.split(".")[0] != "2":
        raise HyalineError(f"{root.where}: is glTF of version {shown(version)}; expected version 2, export it again")
    if unknown := unread_extensions(root, "extensionsRequired"):
        raise HyalineError(f"{root.where}: requires {shown(unknown[0])}, which is not read; export it without that")


def unread_extensions(root: Fields, key: str) -> list[str]:
    """The names in a file's list of extensions, used or required, that are not read."""
    listed = root.data.get(key, [])
    names = {name for name in listed if isinstance(name, str)} if isinstance(listed, list) else set()
    return sorted(names - READ_EXTENSIONS)


class GltfArrays:
    """The arrays of a file, each decoded once."""

    def __init__(self, file: GltfFile) -> None:
        self.file = file
        self._made: dict[int, np.ndarray] = {}

    def count(self, index: int, *, where: str) -> int:
        """How many elements an accessor promises."""
        accessor = self.file.item("accessors", index, where=where)
        return accessor.integer("count", low=1)

    def array(self, index: int, kind: str, *, where: str) -> np.ndarray:
        """The elements of an accessor: (n, width) of floats, normalised if it asks for it; or (n,) indices."""
        accessor = self.file.item("accessors", index, where=where)
        found = accessor.text("type")
        if found != kind:
            raise HyalineError(f"{accessor.where}: is of type {found!r}; expected {kind!r}")
        if index not in self._made:
            self._made[index] = self._decode(accessor, WIDTHS[kind])
        return self._made[index]

    def _decode(self, accessor: Fields, width: int) -> np.ndarray:
        component = accessor.integer("componentType")
        if component not in COMPONENTS:
            raise HyalineError(f"{accessor.where}.componentType: is {component}; expected one of {[*COMPONENTS]}")
        dtype = np.dtype(COMPONENTS[component])
        count = accessor.integer("count", low=1)
        if count * width > MAX_VALUES:
            raise HyalineError(f"{accessor.where}: promises {count:,} elements; expected at most {MAX_VALUES // width}")
        raw: np.ndarray
        if "bufferView" in accessor:
            view, stride = self.file.buffer_view(accessor.integer("bufferView"), where=accessor.where)
            raw = _strided(view, accessor.integer("byteOffset", 0), count, width, dtype, stride, where=accessor.where)
        else:
            raw = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            raw = self._with_sparse(raw.copy(), accessor.fields("sparse"), dtype)
        if dtype.kind == "f":
            with np.errstate(invalid="ignore"):  # Some kinds of NaN warn when they are cast.
                values = raw.astype(np.float64)
            if not np.isfinite(values).all():
                raise HyalineError(f"{accessor.where}: holds numbers that are not finite; export the file again")
            return values
        if width == 1 and not accessor.flag("normalized"):
            return raw[:, 0].astype(np.int64)
        largest = float(2 ** (8 * dtype.itemsize - (dtype.kind == "i")) - 1)
        return np.maximum(raw / largest, -1.0) if accessor.flag("normalized") else raw.astype(np.float64)

    def _with_sparse(self, raw: np.ndarray, sparse: Fields, dtype: np.dtype) -> np.ndarray:
        count = sparse.integer("count", low=1, high=len(raw))
        places, values = sparse.fields("indices"), sparse.fields("values")
        component = places.integer("componentType")
        if component not in (5121, 5123, 5125):
            raise HyalineError(f"{places.where}.componentType: is {component}; expected 5121, 5123 or 5125")
        where_bytes, _ = self.file.buffer_view(places.integer("bufferView"), where=places.where)
        index_type = np.dtype(COMPONENTS[component])
        offset = places.integer("byteOffset", 0)
        index = _strided(where_bytes, offset, count, 1, index_type, 0, where=places.where)[:, 0].astype(np.int64)
        if index.max() >= len(raw):
            raise HyalineError(f"{places.where}: names element {index.max()}; expected at most {len(raw) - 1}")
        value_bytes, _ = self.file.buffer_view(values.integer("bufferView"), where=values.where)
        offset = values.integer("byteOffset", 0)
        raw[index] = _strided(value_bytes, offset, count, raw.shape[1], dtype, 0, where=values.where)
        return raw


def _strided(
    view: memoryview, offset: int, count: int, width: int, dtype: np.dtype, stride: int, *, where: str
) -> np.ndarray:
    """(count, width) numbers; each row begins `stride` bytes after the last one, or right after it if 0."""
    size = width * dtype.itemsize
    stride = stride or size
    if stride < size:
        raise HyalineError(f"{where}: has elements of {size} bytes every {stride}; expected no overlap")
    end = offset + (count - 1) * stride + size
    if end > len(view):
        raise HyalineError(f"{where}: needs {end:,} bytes, its buffer view has {len(view):,}; export the file again")
    return np.ndarray((count, width), dtype, view, offset, (stride, dtype.itemsize))


# Draco


def read_draco(arrays: GltfArrays, draco: Fields, wanted: dict[str, str]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Attributes of the vertices, and the vertices of the corners in order.

    Args:
        wanted: the type of each attribute by its name.
    """
    if importlib.util.find_spec("DracoPy") is None:
        raise HyalineError(
            f"{draco.where}: is compressed by Draco; `{install_command('generate')}` brings what reads it, "
            "or export the file without compression"
        )
    ids = draco.fields("attributes")
    names = [name for name in wanted if name in ids]
    if "POSITION" not in names:
        raise HyalineError(f"{ids.where}: has no POSITION; export the file again")
    view, _ = arrays.file.buffer_view(draco.integer("bufferView"), where=draco.where)
    found = _decode(bytes(view), {name: ids.integer(name) for name in names}, where=draco.where)
    attributes = {name: found[name].astype(np.float64) for name in names}
    for name, values in attributes.items():
        if values.shape != (len(attributes["POSITION"]), WIDTHS[wanted[name]]) or not np.isfinite(values).all():
            raise HyalineError(f"{draco.where}: its {name} are not {wanted[name]} of finite numbers; export it again")
    return attributes, found["faces"].astype(np.int64).reshape(-1)


def _decode(data: bytes, ids: dict[str, int], *, where: str) -> dict[str, np.ndarray]:
    words = tuple(f"{name}={unique}" for name, unique in ids.items())
    try:
        return arrays_from_child(
            "hyaline_import.gltf.file",
            {"draco": np.frombuffer(data, np.uint8)},
            timeout_s=TIMEOUT_S,
            words=words,
        )
    except ChildError as error:
        raise HyalineError(f"{where}: Draco cannot read it ({error}); export the file again") from None


def _child(source: Path, target: Path, ids: dict[str, int]) -> None:
    """Decodes in a process of its own, since DracoPy is native code."""
    import DracoPy  # pyright: ignore[reportMissingImports]

    with np.load(source) as arrays:
        mesh = DracoPy.decode(arrays["draco"].tobytes())
    found = {"faces": np.asarray(mesh.faces)}
    for attribute in mesh.attributes:
        for name, unique in ids.items():
            if attribute["unique_id"] == unique:
                found[name] = np.asarray(attribute["data"])
    np.savez(target, allow_pickle=False, **found)


if __name__ == "__main__":
    _child(Path(sys.argv[1]), Path(sys.argv[2]), {k: int(v) for k, v in (word.split("=") for word in sys.argv[3:])})
