"""Cameras beside a model: a COLMAP reconstruction, or a transforms file as NeRF tools write it."""

import math
from pathlib import Path

from datagen.disk.errors import HyalineError
from datagen.scene.importers.colmap import has_colmap, read_colmap
from datagen.scene.importers.foreign import ForeignCamera
from datagen.scene.importers.remarks import Remarks
from datagen.scene.importers.transforms import TransformsFile

NAMES = ("transforms.json", "transforms_train.json")


def read_camera_file(given: Path, remarks: Remarks) -> tuple[ForeignCamera, ...]:
    """The cameras in a folder or a file, in the axes and units of the model beside which they stand.

    Raises:
        HyalineError: there are none that can be read.
    """
    if given.is_dir() and has_colmap(given):
        return read_colmap(given, remarks)
    if given.is_dir():
        found = next((given / name for name in NAMES if (given / name).is_file()), None)
        if found is None:
            raise HyalineError(
                f"{given}: holds no cameras; expected {' or '.join(NAMES)}, or cameras.bin and images.bin of COLMAP"
            )
        given = found
    if given.suffix.lower() != ".json" or not given.is_file():
        raise HyalineError(
            f"--cameras {given}: is no such file; expected around, file, a transforms.json, or a folder of COLMAP's"
        )
    file = TransformsFile(given.parent, given.name)
    cameras = []
    for frame in file.frames:
        angle, lens, left_out = file.angle(frame)
        for line in left_out:
            remarks.approximate("cameras", line)
        cameras.append(ForeignCamera(world_from_camera=file.pose(frame), fov_deg=math.degrees(angle), intrinsics=lens))
    return tuple(cameras)
