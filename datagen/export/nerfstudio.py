"""nerfstudio: one transforms.json for all views, read by `ns-train METHOD --data OUT` (nerfstudio-data).

    transforms.json       lens, frames with file endings, train_filenames, val_filenames, test_filenames (both splits)
    images/NAME.png       8-bit sRGB
    depths/NAME.png       16 bits, millimetres along the axis to the first surface, glass or not; 0: none
    masks/NAME.png        255 where glass is seen first. Named as `mask_file_path`, which nerfstudio does not read: what
                          its own key `mask_path` names is left out of training
    sparse_pc.ply         points of the surfaces, in the same world

`orientation_override: none` keeps +z up. nerfstudio still centres and scales the poses unless asked not to.
"""

from collections.abc import Mapping

from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.export.files import CONVENTION, depth_png, frame, lens_keys, mask_png, ply_points, rgb_png, world_keys
from datagen.export.plan import Part, Plan, one_file
from datagen.export.source import ROLES, ExportView, Source


def plan_nerfstudio(source: Source) -> Plan:
    """The whole folder."""
    return Plan(parts=nerfstudio_parts(source), hint="ns-train nerfacto --data OUT")


def nerfstudio_parts(source: Source) -> tuple[Part, ...]:
    """What nerfstudio reads, without anything that other tools add."""
    points = one_file("points", "sparse_pc.ply", lambda: ply_points(source.points))
    cameras = one_file("cameras", "transforms.json", lambda: dump_json(_transforms(source)))
    return (*(_view_part(item) for item in source.pictures), points, cameras)


def _view_part(item: ExportView) -> Part:
    picture, depth, mask = (f"{folder}/{item.name}.png" for folder in ("images", "depths", "masks"))
    return picture_depth_mask(item.name, (picture, depth, mask), item)


def picture_depth_mask(name: str, files: tuple[str, str, str], item: ExportView) -> Part:
    """A view as an 8-bit picture, 16-bit depth along the camera's axis in millimetres, and the mask of glass."""

    def make() -> Mapping[str, bytes]:
        found = item.quantities
        data = (rgb_png(item), depth_png(found.depth_along_axis), mask_png(found.glass))
        return dict(zip(files, data, strict=True))

    return Part(name=name, files=files, make=make)


def _transforms(source: Source) -> dict[str, Json]:
    frames: list[Json] = [
        frame(
            item,
            f"images/{item.name}.png",
            depth_file_path=f"depths/{item.name}.png",
            mask_file_path=f"masks/{item.name}.png",
        )
        for item in source.pictures
    ]
    splits: dict[str, Json] = {
        f"{role}_filenames": [f"images/{item.name}.png" for item in source.of_role(role)] for role in ROLES
    }
    return {
        "convention": CONVENTION,
        "camera_model": "PINHOLE",
        "orientation_override": "none",
        "ply_file_path": "sparse_pc.ply",
        **lens_keys(source.pictures[0].view.camera),
        **world_keys(source),
        **splits,
        "frames": frames,
    }
