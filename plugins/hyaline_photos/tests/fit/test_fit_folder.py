"""Tests the folder of a fit: what of it stays, and what is refused."""

from pathlib import Path

import pytest

from datagen.disk.errors import HyalineError
from datagen.disk.records import load_sealed
from hyaline_photos.fit.fit_folder import FitFolder


def test_a_fit_that_is_resumed_keeps_what_it_found_until_it_ends(tmp_path: Path) -> None:
    folder = FitFolder(root=tmp_path / "fit", asked={"seed": 1})
    folder.begin(overwrite=False)
    folder.finish({"objects": ["ball"]})
    folder.begin(overwrite=False)
    assert load_sealed(folder.root / "fit.json")["objects"] == ["ball"]
    folder.begin(overwrite=True)
    assert "objects" not in load_sealed(folder.root / "fit.json")


def test_a_damaged_record_is_named_and_overwrite_replaces_it(tmp_path: Path) -> None:
    folder = FitFolder(root=tmp_path / "fit", asked={"seed": 1})
    folder.begin(overwrite=False)
    folder.stage("room", "room", "", lambda: {"seen": 1})
    head = folder.root / "fit.json"
    head.write_bytes(head.read_bytes().replace(b"1", b"2", 1))
    with pytest.raises(HyalineError, match=r"fit\.json: is damaged, or not of a fit; start over with --overwrite"):
        folder.begin(overwrite=False)
    folder.begin(overwrite=True)
    assert load_sealed(head)["seed"] == 1
    assert not (folder.root / "room.pt").exists()
