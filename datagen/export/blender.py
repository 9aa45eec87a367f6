"""The Blender format of NeRF's synthetic scenes, and its form for Gaussian splatting.

    transforms_train.json, transforms_val.json, transforms_test.json    camera_angle_x, frames without file endings
    transforms_interpolating.json, transforms_extrapolating.json        the two halves of test
    train/NAME.png, val/NAME.png, test/NAME.png                         RGBA, alpha 255
    points3d.ply                                                        3dgs: points of the surfaces to start from

Tools of this format do not read `near`, `far` and `aabb`; they are there to be set by hand.
"""

from datagen.data.config import TEST_SPLITS
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.export.files import CONVENTION, check_centered, frame, lens_keys, ply_points, rgba_png, world_keys
from datagen.export.plan import Part, Plan, one_file
from datagen.export.source import ROLES, ExportView, Source


def plan_blender(source: Source) -> Plan:
    """Pictures and cameras."""
    check_centered(source.pictures[0].view.camera, "blender")
    return Plan(parts=_parts(source), hint="ns-train nerfacto --data OUT blender-data")


def plan_3dgs(source: Source) -> Plan:
    """The same with points; the reader takes this format where no folder `sparse` is there."""
    check_centered(source.pictures[0].view.camera, "3dgs")
    points = one_file("points", "points3d.ply", lambda: ply_points(source.points))
    return Plan(parts=(*_parts(source), points), hint="python train.py -s OUT --eval")


def _parts(source: Source) -> tuple[Part, ...]:
    lists = {f"transforms_{role}.json": source.of_role(role) for role in ROLES} | {
        f"transforms_{split}.json": tuple(item for item in source.of_role("test") if item.view.split == split)
        for split in TEST_SPLITS
    }
    cameras = Part(
        name="cameras",
        files=tuple(lists),
        make=lambda: {file: dump_json(_transforms(source, views)) for file, views in lists.items()},
    )
    return (*(_view_part(item) for item in source.views), cameras)


def _view_part(item: ExportView) -> Part:
    file = f"{item.role}/{item.name}.png"
    return Part(name=f"{item.role}-{item.name}", files=(file,), make=lambda: {file: rgba_png(item)})


def _transforms(source: Source, views: tuple[ExportView, ...]) -> dict[str, Json]:
    return {
        "convention": CONVENTION,
        **lens_keys(source.pictures[0].view.camera),
        **world_keys(source),
        "frames": [frame(item, f"./{item.role}/{item.name}") for item in views],
    }
