"""Tests that an atlas is made once for a surface, and that nothing but what was kept is ever taken for it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from datagen.data.ply import write_ply
from datagen.scene import atlas
from datagen.scene.atlas import unwrap, unwrap_all
from datagen.scene.modelling import moved, rounded_box

BOX = rounded_box((0.4, 0.3, 0.2), bevel=0.02, segments=1)


@pytest.fixture
def children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many surfaces each child process was asked for, with an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    asked: list[int] = []

    def one_chart(surfaces: dict[str, dict]) -> dict[str, dict]:
        asked.append(len(surfaces))
        return {
            where: {
                "vertex_of": np.arange(len(surface["vertices"])),
                "faces": surface["faces"].astype(np.int32),
                "uv": ((surface["vertices"] + 1)[:, :2] / 2048).astype(np.float32),
            }
            for where, surface in surfaces.items()
        }

    monkeypatch.setattr(atlas, "_unwrap_in_child", one_chart)
    return asked


def kept(tmp_path: Path) -> list[Path]:
    return sorted((tmp_path / "cache" / "hyaline" / "atlases").iterdir())


def test_copies_of_a_surface_are_unwrapped_together(children: list[int]) -> None:
    # Powers of two, so that it is the same surface but for its place.
    whole = dataclasses.replace(BOX, vertices=np.rint(BOX.vertices * 1024) / np.float32(1024))
    copies = {str(index): moved(whole, (index, 0, 0)) for index in range(3)}
    found = unwrap_all(copies)
    assert sum(children) == 1
    for name, mesh in copies.items():
        np.testing.assert_array_equal(found[name].vertices, mesh.vertices)
        np.testing.assert_array_equal(found[name].uv, found["0"].uv)


@pytest.mark.parametrize("harm", ["cut", "flipped", "no archive"])
def test_what_is_in_doubt_is_made_again(children: list[int], harm: str, tmp_path: Path) -> None:
    first = unwrap(BOX, where="box")
    (path,) = kept(tmp_path)
    data = path.read_bytes()
    middle = len(data) // 2
    if harm == "no archive":
        path.write_bytes(b"no archive")
    else:
        path.write_bytes(
            data[:-50] if harm == "cut" else data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
        )
    assert write_ply(unwrap(BOX, where="box")) == write_ply(first)
    assert children == [1, 1]
