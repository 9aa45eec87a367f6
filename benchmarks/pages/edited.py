"""Edits of a scene, as `datagen build --edit` writes them, for Python and for a page."""

import shutil
from pathlib import Path

import numpy as np

from datagen.build.build import peel_dataset
from datagen.build.plan_variant import plan_edit
from datagen.data.dataset import Dataset
from datagen.data.meshes import is_there
from datagen.data.metadata import Variant
from datagen.data.paths import TRUTH
from datagen.data.variants import variant_root
from datagen.data.writing import write_head
from datagen.scene.edits import CLEAR_GLASS, GREY, Edit, edit_scene
from datagen.scene.folder import load_scene


def edited_dataset(base: Dataset, edits: tuple[Edit, ...], folder: Path, *, with_layers: bool) -> Dataset:
    """The dataset after edits, without any picture, in a folder of its own."""
    plan = plan_edit(base, edits)
    beside = folder / base.name
    beside.mkdir()
    shutil.copyfile(base.root / "dataset.json", beside / "dataset.json")
    record = Variant(of=base.seal, splits=tuple(plan.cameras), edit=plan.edit)
    root = variant_root(beside, plan.name)
    edited = write_head(root, plan.config, plan.objects, plan.cameras, plan.scene, variant=record)
    if with_layers:
        peel_dataset(edited, TRUTH, num_layers=base.layer_store().head.num_layers, overwrite=False)
    return edited


def page_edits(base: Dataset, edits: tuple[Edit, ...], *, knows_materials: bool) -> dict[str, dict[str, object]]:
    """The same, as a page's `picture` takes them: copies come first, made of objects that no edit has changed yet."""
    before = load_scene(base.root / "scene", is_sealed=True)
    edited = edit_scene(before, edits)
    old = {item.name: item for item in before.objects}
    known = {CLEAR_GLASS: "clear glass", GREY: "matt"}
    changes: dict[str, dict[str, object]] = {name: {"copyOf": original} for name, original in edited.copies.items()}
    for item in edited.scene.objects:
        change = changes.setdefault(item.name, {})
        original = old[edited.copies.get(item.name, item.name)]
        if is_there(original.mesh):
            change["shown"] = is_there(item.mesh)
        change["offset"] = np.array(edited.offsets.get(item.name, (0, 0, 0))).tolist()
        if knows_materials and item.material != original.material and item.material in known:
            change["material"] = known[item.material]
    return changes
