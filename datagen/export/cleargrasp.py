"""ClearGrasp: a folder for each split, as its data loaders look for files by their endings.

    SPLIT/rgb-imgs/000000000-rgb.jpg                              JPEG of quality 95, without chroma subsampling
    SPLIT/depth-imgs-rectified/000000000-depth-rectified.exr      R: metres along the axis to the first surface
    SPLIT/camera-normals/000000000-cameraNormals.exr              R G B: shading normal in camera axes (+x right, +y up,
                                                                  +z towards the viewer)
    SPLIT/segmentation-masks/000000000-segmentation-mask.png      255 where glass is seen first
    SPLIT/cameras.json                                            lens and poses, which its own data does not have

SPLIT is train, val, interpolating or extrapolating; files are numbered as the dataset's views. EXR files are of 32
bits, and 0 where a ray meets nothing.
"""

import io
from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from datagen.data.images import encode_float_exr
from datagen.disk.storage import dump_json
from datagen.export.files import CONVENTION, frame, lens_keys, mask_png
from datagen.export.plan import Part, Plan
from datagen.export.source import ExportView, Source

JPEG_QUALITY = 95


def plan_cleargrasp(source: Source) -> Plan:
    """The whole folder."""
    parts = [*(_view_part(item) for item in source.views), _cameras_part(source)]
    return Plan(parts=tuple(parts), hint="python eval_depth_completion.py -c config/config.yaml, with paths below OUT")


def _folder(item: ExportView) -> str:
    return item.view.split if item.role == "test" else item.role


def _view_part(item: ExportView) -> Part:
    folder, number = _folder(item), f"{item.view.index:09d}"
    files = (
        f"{folder}/rgb-imgs/{number}-rgb.jpg",
        f"{folder}/depth-imgs-rectified/{number}-depth-rectified.exr",
        f"{folder}/camera-normals/{number}-cameraNormals.exr",
        f"{folder}/segmentation-masks/{number}-segmentation-mask.png",
    )

    def make() -> Mapping[str, bytes]:
        found = item.quantities
        normals = np.moveaxis(found.normal("shading", "camera"), -1, 0)
        contents = (
            _jpeg(item.image),
            encode_float_exr({"R": found.depth_along_axis}),
            encode_float_exr(dict(zip("RGB", normals, strict=True))),
            mask_png(found.glass),
        )
        return dict(zip(files, contents, strict=True))

    return Part(name=f"{folder}-{item.name}", files=files, make=make)


def _cameras_part(source: Source) -> Part:
    folders: dict[str, list[ExportView]] = {}
    for item in source.views:
        folders.setdefault(_folder(item), []).append(item)

    def make() -> Mapping[str, bytes]:
        return {
            f"{folder}/cameras.json": dump_json(
                {
                    "license": source.dataset.license,
                    "convention": CONVENTION,
                    **lens_keys(items[0].view.camera),
                    "frames": [frame(item, f"rgb-imgs/{item.view.index:09d}-rgb.jpg") for item in items],
                }
            )
            for folder, items in folders.items()
        }

    return Part(name="cameras", files=tuple(f"{folder}/cameras.json" for folder in folders), make=make)


def _jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    return buffer.getvalue()
