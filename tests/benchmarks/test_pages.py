"""Tests that a scene is edited for the comparison of a page with Python, and the dataset stays as it is."""

from pathlib import Path

import numpy as np
from support.synthetic import write_synthetic_dataset

from benchmarks.compare import edited_dataset, page_edits
from datagen.data.geometries import read_meshes
from datagen.data.paths import TRUTH
from datagen.data.variants import list_variants
from datagen.scene.edits import parse_edit

EDITS = tuple(map(parse_edit, ("duplicate:pane:0.1,0.2,0.3", "glass:pane", "move:pane:0,0,0.2", "remove:pane_copy1")))


def test_an_edited_dataset_has_the_moved_meshes_and_its_base_gets_no_variant(tmp_path: Path) -> None:
    base = write_synthetic_dataset(tmp_path / "data" / "synthetic")
    (tmp_path / "edited").mkdir()
    edited = edited_dataset(base, EDITS[:3], tmp_path / "edited", with_layers=True)
    before, after = read_meshes(base, TRUTH), read_meshes(edited, TRUTH)
    place = [item.name for item in base.objects].index("pane")
    assert np.allclose(after[place].vertices - before[place].vertices, (0, 0, 0.2))
    assert np.allclose(after[2].vertices - before[place].vertices, (0.1, 0.2, 0.3))
    assert edited.layer_store().head.num_layers == base.layer_store().head.num_layers
    assert list_variants(base.root) == []


def test_a_page_is_told_where_each_object_stands_what_it_is_made_of_and_whose_copy_it_is(tmp_path: Path) -> None:
    base = write_synthetic_dataset(tmp_path / "data" / "synthetic")
    told = page_edits(base, EDITS, knows_materials=True)
    assert list(told) == ["pane_copy1", "pane", "floor"]
    assert told["pane"] == {"shown": True, "offset": [0, 0, 0.2], "material": "matt"}
    assert told["pane_copy1"] == {"copyOf": "pane", "shown": False, "offset": [0.1, 0.2, 0.3]}
    assert told["floor"] == {"shown": True, "offset": [0, 0, 0]}
    assert "material" not in page_edits(base, EDITS, knows_materials=False)["pane"]
