"""quantities: every quantity of a view as a file beside its picture, for NumPy and any viewer of PNGs.

train/NAME.png, train/NAME.depth.npy, ...     also val, interpolating, extrapolating
dataset.json                                  objects, materials, near, far, box; each file's content and unit
"""

import io
from collections.abc import Iterator

import numpy as np

from datagen.data.images import png_bytes
from datagen.data.transforms import CONVENTION, lens_keys
from datagen.disk.records import Json, dump_json
from datagen.quantities import NormalKind, surfaces_of
from hyaline_export.formats import Format
from hyaline_export.source import Source, frame, mask_png, rgb_png, tracked

NORMALS: dict[str, NormalKind] = {"normal.npy": "shading", "geometric_normal.npy": "geometric"}
FILES = {
    "depth.npy": ("depth_along_axis", "float32 metres along the camera's axis to the first surface; 0: none"),
    "opaque_depth.npy": ("opaque_depth_along_axis", "the same to the first opaque surface on the straight ray"),
    "position.npy": ("position", "float32: place of the first surface, metres, world axes; 0: none"),
    "normal.npy": ("normal", "float32: unit shading normal on the side that is seen, world axes; 0: none"),
    "geometric_normal.npy": ("normal", "float32: the same of the flat face"),
    "object_id.png": ("object_id", "8 bits: the first surface's object, by `object_id` below; 0: none"),
    "opaque_object_id.png": ("opaque_object_id", "8 bits: that of the first opaque surface on the straight ray"),
    "material_id.png": ("material_id", "8 bits: kind of material, 1 + place in `material_names` below; 0: none"),
    "glass.png": ("glass", "8 bits: 255 where glass is seen first, 0 elsewhere"),
    "thickness.npy": ("glass_thickness", "float32 metres inside glass on the straight ray, up to an opaque surface"),
    "albedo.npy": ("albedo", "float32: linear reflectance (Rec. 709) of the first surface; NaN: glass, background"),
    "ior.npy": ("ior", "float32: index of refraction of the first surface; 0: opaque"),
}
"""Files of each view by ending: the attribute of `ViewQuantities`, and the convention."""


def _npy_bytes(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(values), allow_pickle=False)
    return buffer.getvalue()


def _quantities(source: Source) -> Iterator[tuple[str, bytes]]:
    for item in tracked(source.views):
        stem = f"{item.group}/{item.name}"
        yield f"{stem}.png", rgb_png(item)
        about = frame(item, f"{item.name}.png", role=item.role, split=item.view.split, view=item.view.index)
        yield f"{stem}.camera.json", dump_json({"convention": CONVENTION, **lens_keys(item.view.camera), **about})
        found = item.quantities
        for ending, (name, _) in FILES.items():
            array = found.normal(NORMALS[ending]) if ending in NORMALS else getattr(found, name)
            encode = _npy_bytes if ending.endswith(".npy") else mask_png if array.dtype == bool else png_bytes
            yield f"{stem}.{ending}", encode(array)
    objects: list[Json] = [
        {"object_id": index + 1, "name": item.name, "material": type(item.material).__name__}
        for index, item in enumerate(surfaces_of(source.dataset).scene.objects)
    ]
    names: list[Json] = [*source.pictures[0].quantities.material_names]
    conventions = {"png": "8-bit sRGB", "camera.json": "lens in pixels, pose, role, split and number of the view"}
    conventions |= {ending: text for ending, (_, text) in FILES.items()}
    about: dict[str, Json] = {
        "convention": CONVENTION,
        **source.world,
        "objects": objects,
        "material_names": names,
        "files": {**conventions},
    }
    yield "dataset.json", dump_json(about)


QUANTITIES = Format(
    files=_quantities,
    hint="python -c \"import numpy; print(numpy.load('OUT/train/train_0000.depth.npy').shape)\"",
)
