"""The formats in which datasets are exported, and the export of one."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from datagen.data.dataset import Dataset
from datagen.data.metadata import OWN_LICENSE, OWN_LICENSE_ADDRESS
from datagen.disk.errors import HyalineError
from datagen.disk.names import real_path
from datagen.export.blender import plan_3dgs, plan_blender
from datagen.export.cleargrasp import plan_cleargrasp
from datagen.export.colmap import plan_colmap
from datagen.export.folder import write_export
from datagen.export.huggingface import plan_huggingface
from datagen.export.nerfbaselines import plan_nerfbaselines
from datagen.export.nerfstudio import plan_nerfstudio
from datagen.export.plan import Part, Plan
from datagen.export.quantities import plan_quantities
from datagen.export.refref import plan_refref
from datagen.export.source import Source
from datagen.export.webdataset import plan_webdataset
from datagen.terminal.command import choose, say

FORMATS: dict[str, Callable[[Source], Plan]] = {
    "nerfstudio": plan_nerfstudio,
    "blender": plan_blender,
    "3dgs": plan_3dgs,
    "colmap": plan_colmap,
    "nerfbaselines": plan_nerfbaselines,
    "refref": plan_refref,
    "cleargrasp": plan_cleargrasp,
    "webdataset": plan_webdataset,
    "quantities": plan_quantities,
    "huggingface": plan_huggingface,
}

WITH_FLOW = ("quantities", "webdataset")
"""Formats that have a place for refractive flow."""

EXPORTS = Path("exports")
"""Where exports go unless told."""


def export_dataset(
    dataset: Dataset, form: str, out: Path | None, *, num_points: int, flow: bool, overwrite: bool
) -> tuple[Path, str]:
    """Writes what is missing of an export; its folder, and the command of the tool that opens it.

    Raises:
        HyalineError: no such format, a dataset that is not finished, or something else stands in the folder.
    """
    make_plan = FORMATS[choose("format", form, FORMATS)]
    if flow and form not in WITH_FLOW:
        raise HyalineError(
            f"--flow: has no place in the format {form}; leave it out, or take --format {' or '.join(WITH_FLOW)}"
        )
    source = Source(dataset=dataset, num_points=num_points, flow=flow)
    out = out or EXPORTS / f"{dataset.name}-{form}"
    if real_path(out).is_relative_to(real_path(dataset.root)):
        raise HyalineError(f"--out: {out} lies in the dataset, which keeps to its own files; choose a folder outside")
    plan = make_plan(source)
    plan = dataclasses.replace(plan, parts=(*plan.parts, _license_part(dataset)))
    settings = {"format": form, "dataset": dataset.seal, "points": num_points, "flow": flow}
    write_export(out, plan, {**settings}, overwrite=overwrite)
    say(f"{out}: {len(source.pictures)} views; {_roles(source)}; licence: {dataset.license}")
    return out, plan.hint.replace("OUT", str(out))


def _license_part(dataset: Dataset) -> Part:
    """LICENSE.txt, where people look for it whatever the format."""
    text = f"The data in this folder: {dataset.license}\n"
    if dataset.license == OWN_LICENSE:
        text += f"Nobody has to ask, or to name a source. {OWN_LICENSE_ADDRESS}\n"
    return Part(name="license", files=("LICENSE.txt",), make=lambda: {"LICENSE.txt": text.encode()})


def _roles(source: Source) -> str:
    return ", ".join(f"{len(source.of_role(role))} {role}" for role in ("train", "val", "test"))
