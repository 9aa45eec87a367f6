"""quantities: every quantity of a view as a file beside its picture, for NumPy and any viewer of PNGs.

train/NAME.png, train/NAME.depth.npy, ...     also val, interpolating, extrapolating
dataset.json                                  objects, materials, near, far, box; each file's content and unit
"""

from collections.abc import Iterator

import numpy as np

from datagen.data.images import npy_bytes, png_bytes
from datagen.data.transforms import CONVENTION, lens_keys
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.quantities.surfaces import surfaces_of
from datagen.quantities.view_quantities import ViewQuantities
from hyaline_export.files import bounds_keys, frame, mask_png, rgb_png
from hyaline_export.formats import Format
from hyaline_export.source import Source, tracked

FILES = {
    "png": "8-bit sRGB",
    "camera.json": "lens in pixels, world_from_camera, role, split and number of the view",
    "depth.npy": "float32 (h, w): metres along the camera's axis to the first surface, glass or not; 0: none",
    "opaque_depth.npy": "float32 (h, w): the same to the first opaque surface on the straight ray; 0: none",
    "position.npy": "float32 (h, w, 3): place of the first surface, metres, world axes; 0: none",
    "normal.npy": "float32 (h, w, 3): unit shading normal on the side that is seen, world axes; 0: none",
    "geometric_normal.npy": "float32 (h, w, 3): the same of the flat face",
    "object_id.png": "8 bits: the first surface's object, by `object_id` below; 0: none, the background",
    "opaque_object_id.png": "8 bits: that of the first opaque surface on the straight ray",
    "material_id.png": "8 bits: kind of material, 1 + place in `material_names` below; 0: none",
    "glass.png": "8 bits: 255 where glass is seen first, 0 elsewhere",
    "thickness.npy": "float32 (h, w): metres inside solid glass on the straight ray, up to the first opaque surface",
    "albedo.npy": "float32 (h, w, 3): linear reflectance (Rec. 709) of the first surface; NaN on glass and background",
    "ior.npy": "float32 (h, w): index of refraction of the first surface; 0 on everything opaque",
}
"""Files of each view by ending, and the convention of each."""

FLOW_FILES = {
    "flow.npy": "float32 (h, w, 2): refractive flow in pixels, (right, down): the pixel shows what the camera sees at "
    "pixel + flow when nothing refracts",
    "has_flow.png": "8 bits: 0 where `flow` is 0 because the path ends behind the camera, or was given up",
    "attenuation.npy": "float32 (h, w, 3): share of that light, per channel, that comes through along the path",
    "end_depth.npy": "float32 (h, w): metres along the camera's axis to where the refracted path ends; 0: it left",
    "end_position.npy": "float32 (h, w, 3): that place, metres, world axes",
    "end_object_id.png": "8 bits: the opaque object on which the refracted path ends; 0: it left, or was given up",
    "has_left.png": "8 bits: 255 where the refracted path ends in the sky or in a light",
}
"""What has to be traced, too."""


def _arrays(found: ViewQuantities, *, flow: bool) -> dict[str, np.ndarray]:
    """What each array file holds, by ending."""
    arrays = {
        "depth.npy": found.depth_along_axis,
        "opaque_depth.npy": found.opaque_depth_along_axis,
        "position.npy": found.position,
        "normal.npy": found.normal("shading"),
        "geometric_normal.npy": found.normal("geometric"),
        "object_id.png": found.object_id,
        "opaque_object_id.png": found.opaque_object_id,
        "material_id.png": found.material_id,
        "glass.png": found.glass,
        "thickness.npy": found.glass_thickness,
        "albedo.npy": found.albedo,
        "ior.npy": found.ior,
    }
    if not flow:
        return arrays
    ends = found.light_ends
    return arrays | {
        "flow.npy": ends.flow,
        "has_flow.png": ends.has_flow,
        "attenuation.npy": ends.attenuation,
        "end_depth.npy": ends.depth_along_axis,
        "end_position.npy": ends.position,
        "end_object_id.png": ends.object_id,
        "has_left.png": ends.has_left,
    }


def _quantities(source: Source) -> Iterator[tuple[str, bytes]]:
    for item in tracked(source.views):
        stem = f"{item.group}/{item.name}"
        yield f"{stem}.png", rgb_png(item)
        about = frame(item, f"{item.name}.png", role=item.role, split=item.view.split, view=item.view.index)
        yield f"{stem}.camera.json", dump_json({"convention": CONVENTION, **lens_keys(item.view.camera), **about})
        for ending, array in _arrays(item.quantities, flow=source.flow).items():
            encode = npy_bytes if ending.endswith(".npy") else mask_png if array.dtype == bool else png_bytes
            yield f"{stem}.{ending}", encode(array)
    objects: list[Json] = [
        {"object_id": index + 1, "name": item.name, "material": type(item.material).__name__}
        for index, item in enumerate(surfaces_of(source.dataset).scene.objects)
    ]
    names: list[Json] = [*source.pictures[0].quantities.material_names]
    about: dict[str, Json] = {
        "license": source.dataset.license,
        "convention": CONVENTION,
        **bounds_keys(source.bounds),
        "objects": objects,
        "material_names": names,
        "files": {**FILES, **(FLOW_FILES if source.flow else {})},
    }
    yield "dataset.json", dump_json(about)


QUANTITIES = Format(
    files=_quantities,
    hint="python -c \"import numpy; print(numpy.load('OUT/train/train_0000.depth.npy').shape)\"",
    has_flow=True,
)
