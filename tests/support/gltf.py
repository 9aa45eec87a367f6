"""A small writer of glTF and GLB files, for tests that read them."""

import base64
import json
import struct
from pathlib import Path

import numpy as np

from datagen.data.meshes import Mesh
from datagen.scene.modelling import rounded_box

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}

BOX = rounded_box((1.0, 0.6, 0.4), bevel=0.05, segments=1)
"""Closed and outward, of 108 faces."""


class GltfBuilder:
    """The JSON and the buffer of a glTF file that grows."""

    def __init__(self) -> None:
        self.content: dict = {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
            "materials": [],
            "meshes": [],
            "nodes": [],
            "scenes": [{"nodes": []}],
            "scene": 0,
        }
        self.binary = bytearray()

    def view(self, data: bytes, **more: object) -> int:
        """A buffer view of these bytes."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **more}
        self.content["bufferViews"].append(entry)
        self.binary += data
        return len(self.content["bufferViews"]) - 1

    def array(self, values: np.ndarray, kind: str = "f4", **more: object) -> int:
        """An accessor of these numbers in this component type."""
        values = np.asarray(values).astype(f"<{kind}")
        width = 1 if values.ndim == 1 else values.shape[1]
        entry = {
            "bufferView": self.view(values.tobytes()),
            "componentType": COMPONENTS[kind],
            "count": len(values),
            "type": KINDS[width],
            **more,
        }
        return self.add("accessors", entry)

    def mesh(self, mesh: Mesh = BOX, *, material: int | None = None, has_uv: bool = False) -> int:
        """A mesh of one primitive."""
        attributes = {"POSITION": self.array(mesh.vertices), "NORMAL": self.array(mesh.normals)}
        if has_uv:
            attributes["TEXCOORD_0"] = self.array(mesh.uv)
        primitive: dict = {"attributes": attributes, "indices": self.array(mesh.faces.reshape(-1), "u2")}
        if material is not None:
            primitive["material"] = material
        return self.add("meshes", {"primitives": [primitive]})

    def add(self, where: str, entry: dict) -> int:
        """An entry of a top-level list."""
        listed = self.content.setdefault(where, [])
        listed.append(entry)
        return len(listed) - 1

    def node(self, *, is_root: bool = True, **entry: object) -> int:
        index = self.add("nodes", dict(entry))
        if is_root:
            self.content["scenes"][0]["nodes"].append(index)
        return index

    def material(self, name: str = "stuff", *, extensions: dict | None = None, **entry: object) -> int:
        more = {"extensions": extensions} if extensions else {}
        return self.add("materials", {"name": name, **entry, **more})

    def whole(self) -> dict:
        """The JSON of a GLB, the buffer included."""
        return {**self.content, "buffers": [{"byteLength": len(self.binary)}]}

    def glb(self, content: dict | None = None) -> bytes:
        """The bytes of a GLB, of other JSON if given."""
        text = json.dumps(content or self.whole()).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks

    def gltf(self, uri: str | None = None) -> bytes:
        """The bytes of a .gltf whose buffer is inside of it, or in the file that `uri` names."""
        inside = "data:application/octet-stream;base64," + base64.b64encode(bytes(self.binary)).decode()
        buffer = {"byteLength": len(self.binary), "uri": uri or inside}
        return json.dumps({**self.content, "buffers": [buffer]}).encode()

    def written(self, folder: Path, name: str = "thing.glb") -> Path:
        """The path of the GLB, written."""
        path = folder / name
        path.write_bytes(self.glb())
        return path


GLASS = {"KHR_materials_transmission": {"transmissionFactor": 1.0}}


def glass(**volume: object) -> dict:
    """The extensions of solid glass."""
    return {**GLASS, "KHR_materials_volume": {"thicknessFactor": 1.0, **volume}}


def clear(**more: float) -> dict:
    """A smooth surface that is no metal."""
    return {"metallicFactor": 0.0, "roughnessFactor": 0.0, **more}


def glass_of(mesh: Mesh = BOX, **node: object) -> GltfBuilder:
    """A file of one object of clear glass."""
    builder = GltfBuilder()
    material = builder.material(pbrMetallicRoughness=clear(), extensions=glass())
    builder.node(mesh=builder.mesh(mesh, material=material), **node)
    return builder
