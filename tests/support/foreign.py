"""Files of other programs, written for tests of imports, and what `datagen import` makes of them."""

import dataclasses
import io
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from support.commands import call
from support.gltf import BOX, GltfBuilder, clear, glass

from datagen.data.meshes import Mesh, signed_volume
from datagen.scene.description import Scene, SceneObject
from datagen.scene.folder import load_scene
from datagen.scene.modelling import sheet
from hyaline_import.foreign import ForeignObject
from hyaline_import.surfaces import mesh_of

_SQUARE = sheet((0, 0, 0), (0.2, 0, 0), (0, 0.2, 0), cells=(2, 2))
CARD = dataclasses.replace(_SQUARE, uv=(_SQUARE.vertices[:, :2] / 0.2).astype(np.float32))
"""A square, whose image lies on it once."""


@dataclass(frozen=True, kw_only=True)
class Taken:
    """What the command made of a file, and what it said."""

    scene: Scene
    err: str

    def __getitem__(self, name: str) -> SceneObject:
        return next(item for item in self.scene.objects if item.name == name)


def taken(path: Path, flags: str = "") -> Taken:
    """The scene of a file that `datagen import` takes."""
    out = path.parent / "taken"
    shutil.rmtree(out, ignore_errors=True)
    answer = call(f"datagen import '{path}' --out '{out}' {flags}")
    assert answer.status == 0, answer.err
    return Taken(scene=load_scene(out, is_checked=True), err=answer.err)


def refused(path: Path, flags: str = "") -> str:
    """The one line in which `datagen import` refuses a file."""
    answer = call(f"datagen import '{path}' --out '{path.parent / 'refused'}' {flags}")
    assert answer.status == 1 and len(answer.err.strip().splitlines()) == 1, answer.err
    assert not (path.parent / "refused").exists()
    return answer.error


def png(pixels: object) -> bytes:
    """The PNG of (h, w), (h, w, 3) or (h, w, 4) values."""
    data = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(data, format="PNG")
    return data.getvalue()


def use_of(builder: GltfBuilder, image: object, sampler: dict | None = None) -> dict:
    """A texture of glTF with an image: its bytes, or its pixels."""
    data = image if isinstance(image, bytes) else png(image)
    texture = {"source": builder.add("images", {"bufferView": builder.view(data), "mimeType": "image/png"})}
    if sampler is not None:
        texture["sampler"] = builder.add("samplers", sampler)
    return {"index": builder.add("textures", texture)}


def add(builder: GltfBuilder, name: str, mesh: Mesh = BOX, entry: dict | None = None, **node: object) -> GltfBuilder:
    """Adds an object of a material, by its entry; of matt stuff if there is none."""
    entry = {"pbrMetallicRoughness": clear(roughnessFactor=1.0)} if entry is None else entry
    material = builder.material(entry.get("name", name), **{key: entry[key] for key in entry if key != "name"})
    builder.node(mesh=builder.mesh(mesh, material=material, has_uv=True), name=name, **node)
    return builder


def glass_entry(ior: float = 1.5, **pbr: object) -> dict:
    """Solid glass."""
    extensions = {**glass(), "KHR_materials_ior": {"ior": ior}}
    return {"pbrMetallicRoughness": clear(**pbr), "extensions": extensions}  # type: ignore[arg-type]


def obj_of(folder: Path, mtl: str, mesh: Mesh = BOX, scale: float = 0.1) -> Path:
    """An OBJ of one object, `thing`, of the material `m` that an MTL file describes."""
    (folder / "m.mtl").write_text(f"newmtl m\n{mtl}\n")
    lines = [f"v {x} {y} {z}" for x, y, z in scale * mesh.vertices] + [f"vt {u} {v}" for u, v in mesh.uv]
    lines += ["f " + " ".join(f"{corner}/{corner}" for corner in face + 1) for face in mesh.faces]
    (folder / "a.obj").write_text("mtllib m.mtl\no thing\nusemtl m\n" + "\n".join(lines) + "\n")
    return folder / "a.obj"


def xml_of(folder: Path, body: str) -> Path:
    """A scene of Mitsuba 3."""
    (folder / "a.xml").write_text(f'<scene version="3.0.0">{body}</scene>')
    return folder / "a.xml"


def volume(item: ForeignObject) -> float:
    return signed_volume(mesh_of(item.positions, item.faces, item.normals, None, where="x"))
