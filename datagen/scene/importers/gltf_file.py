"""A glTF or GLB file: its JSON, and the bytes that it points to, inside the file or in files beside it.

Source: glTF 2.0 sections 3.6.1 and 4.
"""

import base64
import binascii
import struct
from pathlib import Path
from urllib.parse import unquote

from datagen.disk.errors import HyalineError
from datagen.disk.names import find_file
from datagen.disk.reading import parse_json
from datagen.disk.records import shown
from datagen.scene.importers.fields import Fields
from datagen.scene.importers.foreign import read_foreign

_JSON, _BIN = 0x4E4F534A, 0x004E4942
MAX_JSON_BYTES = 1 << 28
"""A .gltf may hold its buffers as base64."""

READ_EXTENSIONS = {
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
}
"""Extensions that a file may require: read, or left out with a remark."""


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
        """What a URI names: data inside of it, or a file in the folder of this one.

        Raises:
            HyalineError: it leads anywhere else.
        """
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
        """The file in the folder of this one that a URI names; it may not be there.

        Raises:
            HyalineError: it leads anywhere else.
        """
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
        raise HyalineError(f"{path}: its first chunk is no JSON; expected a GLB, export it again")
    return chunks[0][1].rstrip(b" \0"), next((chunk for kind, chunk in chunks[1:] if kind == _BIN), None)


def _check_version(root: Fields) -> None:
    version = root.fields("asset").text("version")
    if version.split(".")[0] != "2":
        raise HyalineError(f"{root.where}: is glTF of version {shown(version)}; expected version 2, export it again")
    required = root.data.get("extensionsRequired", [])
    names = {name for name in required if isinstance(name, str)} if isinstance(required, list) else set()
    if unknown := sorted(names - READ_EXTENSIONS):
        raise HyalineError(f"{root.where}: requires {shown(unknown[0])}, which is not read; export it without that")
