"""The formats with cameras in a transforms.json: nerfstudio, Blender, Gaussian splatting, captures.

nerfstudio, read by `ns-train METHOD --data OUT` (nerfstudio-data):

    transforms.json       lens, frames with file endings, train_filenames, val_filenames, test_filenames (both splits)
    images/NAME.png       8-bit sRGB
    depths/NAME.png       16 bits, millimetres along the axis to the first surface, glass or not; 0: none
    masks/NAME.png        255 where glass is seen first. Named as `mask_file_path`, which nerfstudio does not read: what
                          its own key `mask_path` names is left out of training
    sparse_pc.ply         points of the surfaces, in the same world

`orientation_override: none` keeps +z up. nerfstudio still centres and scales the poses unless asked not to.

blender, as NeRF's synthetic scenes, and 3dgs, the same with points:

    transforms_train.json, transforms_val.json, transforms_test.json    camera_angle_x, frames without file endings
    train/NAME.png, val/NAME.png, test/NAME.png                         RGBA, alpha 255
    points3d.ply                                                        3dgs: points of the surfaces to start from

Tools of this format do not read `near` and `far`; they are there to be set by hand.

capture, as `datagen capture` and people's own captures have it, without shapes, materials and room:

    images/NAME.png            8-bit sRGB
    masks/OBJECT/NAME.png      255 where the object is seen first
    transforms.json            cameras; remove it, and `datagen capture` has to find them
"""

import functools
from collections.abc import Iterator

from datagen.data.transforms import CONVENTION, lens_keys
from datagen.disk.records import Json, dump_json
from hyaline_export.formats import Format
from hyaline_export.source import (
    ROLES,
    Source,
    check_centered,
    depth_png,
    frame,
    mask_png,
    ply_points,
    rgb_png,
    rgba_png,
    tracked,
)


def _nerfstudio(source: Source) -> Iterator[tuple[str, bytes]]:
    frames: list[Json] = []
    for item in tracked(source.views):
        found = item.quantities
        picture, depth, mask = (f"{folder}/{item.name}.png" for folder in ("images", "depths", "masks"))
        yield picture, rgb_png(item)
        yield depth, depth_png(found.depth_along_axis)
        yield mask, mask_png(found.glass)
        frames.append(frame(item, picture, depth_file_path=depth, mask_file_path=mask))
    yield "sparse_pc.ply", ply_points(source.points)
    splits: dict[str, Json] = {
        f"{role}_filenames": [f"images/{item.name}.png" for item in source.of_role(role)] for role in ROLES
    }
    cameras: dict[str, Json] = {
        "convention": CONVENTION,
        "camera_model": "PINHOLE",
        "orientation_override": "none",
        "ply_file_path": "sparse_pc.ply",
        **lens_keys(source.lens),
        **source.world,
        **splits,
        "frames": frames,
    }
    yield "transforms.json", dump_json(cameras)


def _blender(source: Source, form: str) -> Iterator[tuple[str, bytes]]:
    check_centered(source.lens, form)
    for item in tracked(source.views):
        yield f"{item.role}/{item.name}.png", rgba_png(item)
    about = {"convention": CONVENTION, **lens_keys(source.lens), **source.world}
    for role in ROLES:
        frames: list[Json] = [frame(item, f"./{role}/{item.name}") for item in source.of_role(role)]
        yield f"transforms_{role}.json", dump_json({**about, "frames": frames})
    if form == "3dgs":  # Its reader takes this format where there is no folder `sparse`.
        yield "points3d.ply", ply_points(source.points)


def _capture(source: Source) -> Iterator[tuple[str, bytes]]:
    glass = {item.name: index + 1 for index, item in enumerate(source.dataset.objects) if item.is_glass}
    frames: list[Json] = []
    for item in tracked([item for item in source.views if item.view.split not in source.dataset.withheld]):
        drawn = item.view.imported_object_ids  # Of a captured dataset, whose layers are those of stand-ins.
        first = item.view.object_ids()[0] if drawn is None else drawn
        yield f"images/{item.name}.png", rgb_png(item)
        for name, index in glass.items():
            yield f"masks/{name}/{item.name}.png", mask_png(first == index)
        frames.append(frame(item, f"images/{item.name}.png"))
    about = {"convention": CONVENTION, "license": source.dataset.license, **lens_keys(source.lens)}
    yield "transforms.json", dump_json({**about, "frames": frames})


NERFSTUDIO = Format(files=_nerfstudio, hint="ns-train nerfacto --data OUT")
BLENDER = Format(files=functools.partial(_blender, form="blender"), hint="ns-train nerfacto --data OUT blender-data")
GAUSSIAN_SPLATTING = Format(files=functools.partial(_blender, form="3dgs"), hint="python train.py -s OUT --eval")
CAPTURE = Format(files=_capture, hint="datagen capture OUT")
