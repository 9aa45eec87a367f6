"""What other projects write, made from a dataset or an export: a scene of RefRef, a binary model of COLMAP."""

import json
import struct
from pathlib import Path

import numpy as np

from datagen.data.dataset import Dataset
from datagen.data.ply import write_ply
from datagen.data.transforms import lens_keys
from datagen.quantities import surfaces_of
from hyaline_export.source import ROLES, Source, frame, mask_png, rgba_png


def write_refref(dataset: Dataset, root: Path) -> None:
    """Pictures and masks of glass by split, with a mesh of each object of glass."""
    source = Source(dataset=dataset, num_points=1)
    for role in ROLES:
        frames = []
        (root / role).mkdir(parents=True)
        for item in source.of_role(role):
            image, mask = f"image_{item.name}.png", f"mask_{item.name}.png"
            (root / role / image).write_bytes(rgba_png(item))
            (root / role / mask).write_bytes(mask_png(item.quantities.glass))
            frames.append(frame(item, f"./{role}/{image}", mask_file_path=f"./{role}/{mask}"))
        about = {**lens_keys(source.lens), **source.world, "frames": frames}
        (root / f"transforms_{role}.json").write_text(json.dumps(about))
    (root / "meshes").mkdir()
    surfaces = surfaces_of(dataset)
    for item, mesh in zip(surfaces.scene.objects, surfaces.meshes, strict=True):
        if item.material.is_glass:
            (root / "meshes" / f"{item.name}.ply").write_bytes(write_ply(mesh))


def write_binary_model(model: Path) -> None:
    """cameras.bin and images.bin, without points, beside the text files of a model with one PINHOLE camera."""
    (camera,) = [line.split() for line in (model / "cameras.txt").read_text().splitlines() if line[0] != "#"]
    head = struct.pack("<QIiQQ", 1, 1, 1, *map(int, camera[2:4]))
    (model / "cameras.bin").write_bytes(head + np.array(camera[4:], "<f8").tobytes())
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")][::2]
    data = [struct.pack("<Q", len(lines))]
    for line in lines:
        number, *pose, camera_id, name = line.split()
        data.append(struct.pack("<I7dI", int(number), *map(float, pose), int(camera_id)))
        data.append(name.encode() + b"\0" + struct.pack("<Q", 0))
    (model / "images.bin").write_bytes(b"".join(data))
