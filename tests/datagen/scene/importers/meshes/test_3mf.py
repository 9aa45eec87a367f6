"""Tests that 3MF files are read, and that broken ones are refused in one line."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from support.soon import soon

from datagen.data.meshes import signed_volume
from datagen.disk.errors import HyalineError
from datagen.scene.importers.foreign import PLAIN, ForeignScene
from datagen.scene.importers.meshes import bare
from datagen.scene.importers.meshes.bare import read_3mf
from datagen.scene.importers.remarks import Remarks
from datagen.scene.importers.surfaces import mesh_of

pytest.importorskip("lxml")


def read(path: Path, data: bytes, remarks: Remarks | None = None) -> ForeignScene:
    path.write_bytes(data)
    return read_3mf(path, remarks or Remarks())


def model_3mf(model: str, name: str = "3D/3dmodel.model") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(name, model)
    return buffer.getvalue()


VERTICES = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in ((0, 0, 0), (9, 0, 0), (0, 9, 0), (0, 0, 9)))
TRIANGLES = "".join(
    f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
)
MODEL = f"""<?xml version="1.0"?>
<model unit="centimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">
<resources><basematerials id="5"><base name="red" displaycolor="#FF000080"/></basematerials>
<object id="1" name="part" pid="5" pindex="0"><mesh>
<vertices>{VERTICES}</vertices><triangles>{TRIANGLES}</triangles></mesh>
</object><object id="2"><components><component objectid="1"/>
<component objectid="1" transform="-1 0 0 0 1 0 0 0 1 20 0 0"/></components></object></resources>
<build><item objectid="2" transform="2 0 0 0 2 0 0 0 2 0 0 5"/></build></model>"""


def test_a_3mf_places_components_keeps_its_unit_and_says_that_colours_are_left_out(tmp_path: Path) -> None:
    remarks = Remarks()
    scene = read(tmp_path / "job.3mf", model_3mf(MODEL), remarks)
    assert (scene.metres, scene.up, [item.name for item in scene.objects]) == (0.01, "z", ["part", "part"])
    for item, corner in zip(scene.objects, ([0, 0, 5], [40, 0, 5]), strict=True):
        np.testing.assert_allclose(item.positions[0], corner)
        # The second one is mirrored, and wound the right way round again.
        assert signed_volume(mesh_of(item.positions, item.faces, None, None, where="x")) == pytest.approx(8 * 9**3 / 6)
        assert item.material is PLAIN
    assert [line.what for line in remarks.lines] == ["has colours, which are left out"]


def test_an_object_without_colours_is_read_without_a_word(tmp_path: Path) -> None:
    remarks = Remarks()
    text = f'<model><resources><object id="1"><mesh><vertices>{VERTICES}</vertices><triangles>{TRIANGLES}</triangles>'
    text += '</mesh></object></resources><build><item objectid="1"/></build></model>'
    scene = read(tmp_path / "job.3mf", model_3mf(text), remarks)
    assert (len(scene.objects), scene.metres, remarks.lines) == (1, 0.001, [])


BOMB = '<!DOCTYPE m [<!ENTITY a "' + "x" * 999 + '">]><model>&a;</model>'


def changed_3mf(before: str, after: str) -> bytes:
    assert before in MODEL
    return model_3mf(MODEL.replace(before, after))


CHAIN = "".join(
    f'<object id="{i}"><components>' + 2 * f'<component objectid="{i + 1}"/>' + "</components></object>"
    for i in range(100, 160)
)
MANY = MODEL.replace("</resources>", CHAIN + '<object id="160"/></resources>').replace(
    'm objectid="2"', 'm objectid="100"'
)
"""Sixty objects, each of two of the next one."""
HOLLOW = MODEL.replace("</resources>", '<object id="9"/></resources>').replace('m objectid="2"', 'm objectid="9"')

BROKEN: dict[str, tuple[bytes, str]] = {
    "empty 3mf": (b"", "not a 3MF file that can be read"),
    "3mf of no archive": (b"PK\3\4 and then nothing", "not a 3MF file that can be read"),
    "3mf without a model": (model_3mf(MODEL, "thumbnail.png"), "holds no model"),
    "3mf that is cut off": (model_3mf(MODEL)[:-40], "not a 3MF file"),
    "3mf of half an XML": (model_3mf(MODEL[:-30]), "not a 3MF file"),
    "3mf with a document type": (model_3mf(BOMB), "builds no object"),
    "3mf that builds nothing": (changed_3mf("<item", "<nothing"), "builds no object"),
    "3mf of an object in itself": (changed_3mf('t objectid="1"/', 't objectid="2"/'), "CycleError"),
    "3mf of an object that is not there": (
        changed_3mf('m objectid="2"', 'm objectid="7"'),
        "places object '7', which is not there",
    ),
    "3mf of eleven numbers": (changed_3mf("2 0 0 0 2 0 0 0 2 0 0 5", "2 0 0 0 2 0 0 0 2 0 0"), "not a 3MF file"),
    "3mf that is flat": (changed_3mf("2 0 0 0 2 0 0 0 2 0 0 5", "2 0 0 0 2 0 0 0 0 0 0 5"), "flattens part to nothing"),
    "3mf beyond its vertices": (changed_3mf('v1="0"', 'v1="4"'), "vertices that are not there"),
    "3mf of a vertex below 0": (changed_3mf('v1="0"', 'v1="-1"'), "vertices that are not there"),
    "3mf of a word for x": (changed_3mf('x="9"', 'x="nine"'), "not a 3MF file"),
    "3mf of several parts": (
        changed_3mf("<item ", '<item p:path="/3D/b.model" xmlns:p="p" '),
        "in several parts",
    ),
    "3mf of an object without triangles": (changed_3mf(TRIANGLES, ""), "builds no object"),
    "3mf of an object without a mesh": (model_3mf(HOLLOW), "builds no object"),
    "3mf of an object without an id": (changed_3mf('id="1" name', "name"), "places object '1', which"),
    "3mf that is placed nowhere": (
        changed_3mf("2 0 0 0 2 0 0 0 2 0 0 5", "nan 0 0 0 2 0 0 0 2 0 0 5"),
        "flattens part",
    ),
    "3mf of huge numbers": (changed_3mf('x="9"', 'x="1e400"'), "not finite"),
    "3mf of two numbers for x": (changed_3mf('x="9"', 'x="9 9"'), "not a 3MF file"),
    "3mf of a fraction for an index": (changed_3mf('v1="0"', 'v1="1.5"'), "not a 3MF file"),
    "3mf of 2^60 objects": (model_3mf(MANY), "places 2,305,843,009,213,693,951 objects"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    data, message = BROKEN[name]
    with soon(), pytest.raises(HyalineError, match=message) as refused:
        read(tmp_path / "a.3mf", data)
    assert "\n" not in str(refused.value)


def test_an_archive_that_unpacks_to_more_than_a_file_may_have_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bare, "MAX_FILE_BYTES", 100)
    with pytest.raises(HyalineError, match=r"unpacks to \d+ bytes; expected at most 100"):
        read(tmp_path / "a.3mf", model_3mf(MODEL))
