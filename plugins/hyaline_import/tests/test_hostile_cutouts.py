"""Tests that odd and hostile opacity is refused in one line, or leaves just the surface that the file means."""

import dataclasses
import io
import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.gltf import BOX, GltfBuilder, clear, glass
from support.hostile.pictures import png
from support.soon import soon
from support.synthetic import synthetic_scene

from datagen.data.meshes import face_areas
from datagen.disk.errors import HyalineError
from datagen.scene.description import Scene, SceneObject
from datagen.scene.folder import load_scene, save_scene
from datagen.scene.import_choices import ImportChoices
from datagen.scene.materials import Diffuse
from datagen.scene.modelling import sheet
from hyaline_import.importing import Imported, import_scene

SIDE = 0.2
CARD = sheet((0, 0, 0), (SIDE, 0, 0), (0, SIDE, 0), cells=(2, 2))
UV = (CARD.vertices[:, :2] / SIDE).astype(np.float32)


def image_of(alpha: int | np.ndarray, size: int = 4) -> bytes:
    """A PNG of one green whose alpha is given."""
    pixels = np.full((size, size, 4), 99, np.uint8)
    pixels[..., 3] = alpha
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, format="PNG")
    return data.getvalue()


HALF = image_of(np.where(np.arange(8) < 4, 255, 0), 8)
"""Its left half is opaque."""
BLACK_AND_WHITE = io.BytesIO()
Image.fromarray(np.where(np.arange(8) < 4, 255, 0).astype(np.uint8)[None].repeat(8, 0)).save(BLACK_AND_WHITE, "PNG")


def imported(path: Path) -> Imported:
    """The scene of a file; soon, and without a warning of a number that fits nowhere."""
    with soon(), warnings.catch_warnings():
        warnings.simplefilter("error")
        return import_scene(path, ImportChoices(ground="never"))


def refusal(path: Path) -> str:
    with pytest.raises(HyalineError) as refused:
        imported(path)
    text = str(refused.value)
    assert "\n" not in text and "0x" not in text and len(text) < 1000
    return text


def share_left(scene: Scene) -> float:
    """Of the card's area; 0 where it is gone."""
    return sum(float(face_areas(item.mesh).sum()) for item in scene.objects if item.name == "leaf") / SIDE**2


# glTF

MASK = {"alphaMode": "MASK"}
BLEND = {"alphaMode": "BLEND"}


def gltf(
    folder: Path,
    *,
    image: bytes | str | None = HALF,
    uv: np.ndarray | None = UV,
    alpha: float = 1.0,
    metallic: float = 0.0,
    transmits: bool = False,
    is_solid: bool = False,
    is_alone: bool = False,
    tex_coord: int = 0,
    number: str | None = None,
    **entry: object,
) -> Path:
    """A card, or a solid box, cut out as told, beside a glass box.

    Args:
        image: PNG, or the name of a file.
        number: stands for `alphaCutoff` just as it is written here.
    """
    builder = GltfBuilder()
    if not is_alone:
        vase = builder.material("Glass", pbrMetallicRoughness=clear(), extensions=glass())
        builder.node(mesh=builder.mesh(material=vase), name="vase", scale=[0.1, 0.1, 0.1], translation=[0.1, 0.1, 0.2])
    pbr: dict[str, object] = {
        **clear(roughnessFactor=1.0, metallicFactor=metallic),
        "baseColorFactor": [1, 1, 1, alpha],
    }
    if image is not None:
        where = {"uri": image} if isinstance(image, str) else {"bufferView": builder.view(image)}
        texture = builder.add("textures", {"source": builder.add("images", {**where, "mimeType": "image/png"})})
        pbr["baseColorTexture"] = {"index": texture, "texCoord": tex_coord}
    extensions = glass() if transmits else None
    material = builder.material("Leaf", pbrMetallicRoughness=pbr, extensions=extensions, **entry)
    mesh = BOX if is_solid else CARD if uv is None else dataclasses.replace(CARD, uv=uv)
    builder.node(mesh=builder.mesh(mesh, material=material, has_uv=uv is not None), name="leaf")
    if number is not None:
        builder.content["materials"][-1]["alphaCutoff"] = 0.123
    data = builder.gltf()
    path = folder / "a.gltf"
    path.write_bytes(data if number is None else data.replace(b"0.123", number.encode()))
    return path


REFUSED_GLTF: dict[str, tuple[dict, str]] = {
    "a cutoff of nan": ({"number": "NaN"}, "not finite"),
    "a cutoff of infinity": ({"number": "-Infinity"}, "not finite"),
    "a cutoff of 1e999": ({"number": "1e999"}, "not finite"),
    "a cutoff of 5,000 digits": ({"number": "9" * 5000}, "99"),
    "a cutoff of text": ({"number": '"0.5"'}, r"alphaCutoff: is '0.5'; expected a number"),
    "a cutoff of null": ({"number": "null"}, "has no 'alphaCutoff'"),
    "a cutoff of true": ({"number": "true"}, "alphaCutoff: is True; expected a number"),
    "a cutoff of a list": ({"number": "[0.5]"}, r"alphaCutoff: is \[0.5\]; expected a number"),
    "a mode in small letters": ({"alphaMode": "mask"}, "expected one of OPAQUE, MASK, BLEND"),
    "a mode of a list": ({"alphaMode": ["MASK"]}, "expected a string"),
    "an image of 0 columns": ({"image": png(0, 8)}, "not an image that can be read"),
    "an image of 0 rows": ({"image": png(8, 0)}, "not an image that can be read"),
    "an image of 900 million pixels": ({"image": png(30_000, 30_000)}, "not an image that can be read"),
    "an image of 81 million pixels": ({"image": png(9_000, 9_000)}, r"expected at most 67,108,864 pixels"),
    "an image of 2**62 pixels": ({"image": png(2**31 - 1, 2**31 - 1)}, "not an image that can be read"),
    "an image that is cut off": ({"image": HALF[:60]}, "not an image that can be read"),
    "an image of a zero": ({"image": b"\0"}, "not an image that can be read"),
    "an image outside of the folder": ({"image": "../leaf.png"}, "expected a file inside the folder"),
    "uv that are no numbers": ({"uv": np.full_like(UV, np.nan)}, "not finite"),
    "uv of 1e30": ({"uv": 1e30 * UV}, r"needs uv in or near \[0, 1\]"),
    "uv that repeat 2,500 by 2,500 times": ({"uv": 5e3 * UV}, "expected at most 4096"),
    "all of a scene that is transparent": ({"image": image_of(0), "is_alone": True}, "all of it is cut away"),
    "a cutoff that nothing reaches": ({"number": "1e308", "is_alone": True}, "all of it is cut away"),
}


@pytest.mark.parametrize("name", REFUSED_GLTF)
def test_opacity_of_gltf_that_cannot_be_is_refused(name: str, tmp_path: Path) -> None:
    wrong, message = REFUSED_GLTF[name]
    assert re.search(message, refusal(gltf(tmp_path, **{**MASK, **wrong})))


IMPORTED_GLTF: dict[str, tuple[dict, float, str, str]] = {
    "a mask without a cutoff": (MASK, 0.5, "Diffuse", ""),
    "a cutoff without a mask": ({"number": "0.5"}, 1, "Diffuse", ""),
    "a cutoff below 0": ({**MASK, "number": "-1"}, 1, "Diffuse", ""),
    "a cutoff of 0": ({**MASK, "number": "0"}, 1, "Diffuse", ""),
    "a cutoff just above 1": ({**MASK, "number": "1.0001"}, 0, "", "is cut away whole"),
    "a cutoff of 1e308": ({**MASK, "number": "1e308"}, 0, "", "is cut away whole"),
    "a mask without an image": ({**MASK, "image": None}, 1, "Diffuse", ""),
    "a mask of a factor alone": ({**MASK, "image": None, "alpha": 0.2}, 0, "", "is cut away whole"),
    "an image that does not exist": ({**MASK, "image": "gone.png"}, 1, "Diffuse", "an image that is not there"),
    "one opaque pixel": ({**MASK, "image": image_of(255, 1)}, 1, "Diffuse", ""),
    "one transparent pixel": ({**MASK, "image": image_of(0, 1)}, 0, "", "is cut away whole"),
    "an image that is transparent": ({**MASK, "image": image_of(0)}, 0, "", "is cut away whole"),
    "blending of what is transparent": ({**BLEND, "image": image_of(0)}, 0, "", "is cut away whole"),
    "blending of an alpha of 0": ({**BLEND, "image": None, "alpha": 0.0}, 0, "", "is cut away whole"),
    "blending of an image of one alpha": ({**BLEND, "image": image_of(76)}, 1, "ThinDielectric", "alpha 0.3; drawn as"),
    "blending that is nearly opaque": ({**BLEND, "image": None, "alpha": 0.95}, 1, "Diffuse", "0.95; drawn opaque"),
    "blending of metal": (
        {**BLEND, "image": None, "alpha": 0.3, "metallic": 1.0},
        1,
        "ThinDielectric",
        "is metal and blended with alpha 0.3",
    ),
    "blending of glass": (
        {**BLEND, "image": None, "alpha": 0.3, "transmits": True},
        1,
        "ThinDielectric",
        "is glass and blended",
    ),
    "no uv": ({**MASK, "uv": None}, 1, "Diffuse", "has no uv; drawn whole"),
    "uv in one corner": ({**MASK, "uv": 0 * UV}, 1, "Diffuse", ""),
    "uv in one opaque place": ({**MASK, "uv": 0 * UV + np.float32(0.2)}, 1, "Diffuse", ""),
    "uv in one transparent place": ({**MASK, "uv": 0 * UV + np.float32(0.8)}, 0, "", "is cut away whole"),
    "uv of a set that is not there": ({**MASK, "tex_coord": 5}, 1, "Diffuse", "has no uv; drawn whole"),
    "uv from -1e4 on": ({**MASK, "uv": UV - np.float32(10_000)}, 0.5, "Diffuse", ""),
    "a grey image of 16 bits": ({**MASK, "image": png(4, 4, depth=16, color=0)}, 1, "Diffuse", ""),
    "a colour image of 16 bits that is transparent": ({**MASK, "image": png(4, 4, depth=16, color=6)}, 0, "", "whole"),
}


@pytest.mark.parametrize("name", IMPORTED_GLTF)
def test_odd_opacity_of_gltf_leaves_what_it_means(name: str, tmp_path: Path) -> None:
    odd, share, kind, told = IMPORTED_GLTF[name]
    done = imported(gltf(tmp_path, **odd))
    assert share_left(done.scene) == pytest.approx(share, abs=1e-3)
    assert [type(item.material).__name__ for item in done.scene.objects if item.name == "leaf"] == [kind] * bool(kind)
    lines = [line.what for line in done.remarks if line.where in ("leaf", "Leaf")]
    assert any(told in line for line in lines) if told else all("is cut out where" in line for line in lines), lines


def test_a_solid_is_not_cut_and_that_is_said(tmp_path: Path) -> None:
    done = imported(gltf(tmp_path, transmits=True, is_solid=True, alphaMode="MASK"))
    assert share_left(done.scene) * SIDE**2 == pytest.approx(face_areas(BOX).sum(), rel=1e-4)
    told = [line for line in done.remarks if "would open a solid; drawn whole" in line.what]
    assert [line.is_approximation for line in told] == [True]


# MTL and Mitsuba's masks

FILES = {
    "half.png": HALF,
    "grey.png": BLACK_AND_WHITE.getvalue(),
    "none.png": png(0, 8),
    "cut.png": HALF[:60],
    "one.png": png(1, 1),
    "text.png": b"leaf",
}
MTL: dict[str, tuple[str, float | str]] = {
    "an image of brightness": ("map_d grey.png", 0.5),
    "an image of alpha": ("map_d half.png", 0.5),
    "an image after options": ("map_d -clamp on half.png", 0.5),
    "an image that does not exist": ("map_d gone.png", 1),
    "no name": ("map_d", 1),
    "an image of 0 pixels": ("map_d none.png", 1),
    "an image that is cut off": ("map_d cut.png", "not an image that can be read"),
    "an image of text": ("map_d text.png", 1),
    "one black pixel": ("map_d one.png", "all of it is cut away by its opacity"),
    "an image from the root": ("map_d /etc/passwd", 1),
    "the folder": ("map_d .", 1),
    "opacity of nan": ("d nan", "d: is 'nan'; expected 1 finite numbers"),
    "opacity of words": ("d half", "d: is 'half'; expected 1 finite numbers"),
    "opacity of nothing": ("d", "d: is ''; expected 1 finite numbers"),
    "opacity of 1e308": ("d 1e308", 1),
}


def obj(folder: Path, text: str) -> Path:
    (folder / "m.mtl").write_text(f"newmtl leaf\n{text}\n")
    corners = f"v 0 0 0\nv {SIDE} 0 0\nv {SIDE} {SIDE} 0\nv 0 {SIDE} 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (folder / "a.obj").write_text(f"mtllib m.mtl\n{corners}o leaf\nusemtl leaf\nf 1/1 2/2 3/3 4/4\n")
    return folder / "a.obj"


def bitmap(name: str, more: str = "") -> str:
    return f'<texture type="bitmap" name="opacity"><string name="filename" value="{name}"/>{more}</texture>'


def opacity(value: str) -> str:
    return f'<float name="opacity" value="{value}"/>'


MASKS: dict[str, tuple[str, float | str]] = {
    "an image": (bitmap("half.png"), 0.5),
    "opacity of 1": (opacity("1"), 1),
    "opacity of 2": (opacity("2"), 1),
    "opacity of nan": (opacity("nan"), "opacity is 'nan'"),
    "opacity of -1": (opacity("-1"), "opacity is '-1.0'"),
    "opacity of 1e308": (opacity("1e308"), "opacity is"),
    "opacity of words": (opacity("half"), "not a scene of Mitsuba 3"),
    "opacity of 0": (opacity("0"), "all of it is cut away by its opacity"),
    "an image of 0 pixels": (bitmap("none.png"), "not an image that can be read"),
    "an image that is cut off": (bitmap("cut.png"), "not an image that can be read"),
    "an image that does not exist": (bitmap("gone.png"), "which is not in the scene's folder"),
    "an image from the root": (bitmap("/etc/passwd"), "expected a file inside the folder"),
    "an image without a name": ('<texture type="bitmap" name="opacity"/>', "names ''; expected a file"),
    "an image that is flat": (
        bitmap("half.png", '<transform name="to_uv"><scale value="0"/></transform>'),
        "to_uv is not an invertible transform",
    ),
    "a checkerboard": ('<texture type="checkerboard" name="opacity"/>', "known is bitmap"),
    "masks in a mask": (f'{opacity("1")}<bsdf type="mask">{bitmap("half.png")}<bsdf type="diffuse"/></bsdf>', 0.5),
}


def xml(folder: Path, text: str) -> Path:
    """A rectangle with a mask around something matt."""
    inner = text if "<bsdf" in text else f'{text}<bsdf type="diffuse"/>'
    place = f'<transform name="to_world"><scale value="{SIDE / 2}"/></transform>'
    shape = f'<shape type="rectangle" id="leaf">{place}<bsdf type="mask">{inner}</bsdf></shape>'
    (folder / "a.xml").write_text(f'<scene version="3.0.0">{shape}<emitter type="constant"/></scene>')
    return folder / "a.xml"


@pytest.mark.parametrize(("kind", "name"), [*(("mtl", name) for name in MTL), *(("mask", name) for name in MASKS)])
def test_opacity_of_other_files_is_refused_or_means_what_it_says(kind: str, name: str, tmp_path: Path) -> None:
    for file, data in FILES.items():
        (tmp_path / file).write_bytes(data)
    text, expected = (MTL if kind == "mtl" else MASKS)[name]
    path = obj(tmp_path, text) if kind == "mtl" else xml(tmp_path, text)
    if isinstance(expected, str):
        assert re.search(expected, refusal(path))
    else:
        assert share_left(imported(path).scene) == pytest.approx(expected, abs=1e-3)


# Our own scenes

OWN = {
    "nan": ("NaN", "leaf.png"),
    "0": ("0", "leaf.png"),
    "-1": ("-1", "leaf.png"),
    "1e308": ("1e308", "leaf.png"),
    "text": ('"0.5"', "leaf.png"),
    "true": ("true", "leaf.png"),
    "an image that does not exist": ("0.5", "gone.png"),
    "an image of 0 pixels": ("0.5", "none.png"),
    "an image of 81 million pixels": ("0.5", "large.png"),
    "an image of 900 million pixels": ("0.5", "bomb.png"),
    "an image that is cut off": ("0.5", "cut.png"),
    "an image from the root": ("0.5", "/etc/passwd"),
    "a drawing that Pillow would hand to another program": ("0.5", "drawing.png"),
}


@pytest.mark.parametrize(
    ("where", "name"),
    [("cutout", name) for name in OWN] + [("color", name) for name in OWN if OWN[name][1] != "leaf.png"],
)
def test_a_scene_with_such_an_image_or_cutoff_is_refused(where: str, name: str, tmp_path: Path) -> None:
    cutoff, image = OWN[name]
    card = SceneObject(name="leaf", mesh=dataclasses.replace(CARD, uv=UV), material=Diffuse(color=(0.2, 0.5, 0.1)))
    scene = synthetic_scene()
    save_scene(dataclasses.replace(scene, objects=(*scene.objects, card)), tmp_path)
    drawing = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 4\n%%EndComments\nshowpage\n"
    for file, data in {**FILES, "leaf.png": HALF, "large.png": png(9_000, 9_000), "drawing.png": drawing}.items():
        (tmp_path / file).write_bytes(data)
    (tmp_path / "bomb.png").write_bytes(png(30_000, 30_000))
    path = tmp_path / "scene.json"
    data = json.loads(path.read_text())
    if where == "cutout":
        data["objects"][-1]["cutout"] = {"type": "Cutout", "image": image, "cutoff": 0.123}
    else:
        data["objects"][-1]["material"]["color"] = {"type": "ImageTexture", "path": image}
    path.write_text(json.dumps(data).replace("0.123", cutoff))
    with soon(), pytest.raises(HyalineError) as refused:
        load_scene(tmp_path)
    assert "\n" not in str(refused.value) and "0x" not in str(refused.value)
