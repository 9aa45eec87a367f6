"""The formats in which datasets are exported, and the export of one."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from datagen.data.dataset import Dataset
from datagen.data.metadata import OWN_LICENSE, OWN_LICENSE_ADDRESS
from datagen.disk.errors import HyalineError
from datagen.disk.names import real_path
from datagen.export.plan import Part, Plan, one_file, write_export
from datagen.export.source import Source
from datagen.terminal.command import say
from datagen.terminal.plugins import Group

FORMATS: Group[Callable[[Source], Plan]] = Group(
    name="hyaline.exports",
    what="format",
    built_in={
        "nerfstudio": "datagen.export.nerfstudio:plan_nerfstudio",
        "blender": "datagen.export.blender:plan_blender",
        "3dgs": "datagen.export.blender:plan_3dgs",
        "colmap": "datagen.export.colmap:plan_colmap",
        "nerfbaselines": "datagen.export.colmap:plan_nerfbaselines",
        "capture": "datagen.export.capture:plan_capture",
        "refref": "datagen.export.refref:plan_refref",
        "cleargrasp": "datagen.export.cleargrasp:plan_cleargrasp",
        "webdataset": "datagen.export.samples:plan_webdataset",
        "quantities": "datagen.export.samples:plan_quantities",
        "huggingface": "datagen.export.huggingface:plan_huggingface",
    },
    guide="docs/adding-an-export.md",
)

EXPORTS = Path("exports")
"""Where exports go by default."""


def export_dataset(
    dataset: Dataset, form: str, out: Path | None, *, num_points: int, flow: bool, overwrite: bool
) -> tuple[Path, str]:
    """Writes what is missing of an export; its folder, and the command of the tool that opens it."""
    make_plan = FORMATS.find(form)
    source = Source(dataset=dataset, num_points=num_points, flow=flow)
    out = out or EXPORTS / f"{dataset.name}-{form}"
    if real_path(out).is_relative_to(real_path(dataset.root)):
        raise HyalineError(f"--out: {out} lies in the dataset, which keeps to its own files; choose a folder outside")
    plan = make_plan(source)
    if flow and not plan.has_flow:
        raise HyalineError(
            f"--flow: has no place in the format {form}; leave it out, or take --format quantities or webdataset"
        )
    say(f"{out}: exporting {dataset.root} as {form}")
    plan = dataclasses.replace(plan, parts=(*plan.parts, _license_part(dataset)))
    settings = {"format": form, "dataset": dataset.seal, "points": num_points, "flow": flow}
    write_export(out, plan, {**settings}, overwrite=overwrite)
    say(f"{out}: {len(source.pictures)} views; {_roles(source)}; licence: {dataset.license}")
    if dataset.withheld:
        say(f"{out}: the test pictures are grey, since a verifier keeps the true ones; never train on them")
    return out, plan.hint.replace("OUT", str(out))


def _license_part(dataset: Dataset) -> Part:
    """LICENSE.txt, where people look for it whatever the format."""
    text = f"The data in this folder: {dataset.license}\n"
    if dataset.license == OWN_LICENSE:
        text += f"Nobody has to ask, or to name a source. {OWN_LICENSE_ADDRESS}\n"
    return one_file("license", "LICENSE.txt", text.encode)


def _roles(source: Source) -> str:
    return ", ".join(f"{len(source.of_role(role))} {role}" for role in ("train", "val", "test"))
