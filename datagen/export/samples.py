"""Every quantity of a view as a file of its own: the formats `quantities` and `webdataset`.

quantities: a file for each quantity of each view, beside the pictures, as NumPy and any viewer of PNGs open them
train/NAME.png, train/NAME.depth.npy, ...                           also val, interpolating, extrapolating

webdataset: shards of samples NAME.png, NAME.depth.npy, ..., one a view
train-000000.tar, val-..., interpolating-..., extrapolating-...     SHARD_VIEWS views each

dataset.json of both: objects, materials, near, far, box; what each file says, and in what unit
"""

import io
import tarfile
from collections.abc import Iterator, Mapping

from datagen.data.images import npy_bytes, png_bytes
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.export.files import CONVENTION, bounds_keys, frame, lens_keys, mask_png, rgb_png
from datagen.export.plan import Part, Plan, one_file
from datagen.export.source import ExportView, Source
from datagen.quantities.surfaces import surfaces_of

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
"""Files of each view by ending, in their order, and the convention of each."""

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


def sample_files(item: ExportView, *, flow: bool) -> Mapping[str, bytes]:
    """The contents of a view's files by ending: those of `FILES`, with `flow` also those of `FLOW_FILES`."""
    found = item.quantities
    camera: dict[str, Json] = {
        "convention": CONVENTION,
        **lens_keys(item.view.camera),
        **frame(item, f"{item.name}.png", role=item.role, split=item.view.split, view=item.view.index),
    }
    contents = {
        "png": rgb_png(item),
        "camera.json": dump_json(camera),
        "depth.npy": npy_bytes(found.depth_along_axis),
        "opaque_depth.npy": npy_bytes(found.opaque_depth_along_axis),
        "position.npy": npy_bytes(found.position),
        "normal.npy": npy_bytes(found.normal("shading")),
        "geometric_normal.npy": npy_bytes(found.normal("geometric")),
        "object_id.png": png_bytes(found.object_id),
        "opaque_object_id.png": png_bytes(found.opaque_object_id),
        "material_id.png": png_bytes(found.material_id),
        "glass.png": mask_png(found.glass),
        "thickness.npy": npy_bytes(found.glass_thickness),
        "albedo.npy": npy_bytes(found.albedo),
        "ior.npy": npy_bytes(found.ior),
    }
    if not flow:
        return contents
    ends = found.light_ends
    return contents | {
        "flow.npy": npy_bytes(ends.flow),
        "has_flow.png": mask_png(ends.has_flow),
        "attenuation.npy": npy_bytes(ends.attenuation),
        "end_depth.npy": npy_bytes(ends.depth_along_axis),
        "end_position.npy": npy_bytes(ends.position),
        "end_object_id.png": png_bytes(ends.object_id),
        "has_left.png": mask_png(ends.has_left),
    }


def sample_groups(source: Source) -> dict[str, list[ExportView]]:
    """The views by what they are for: train, val, interpolating, extrapolating."""
    groups: dict[str, list[ExportView]] = {}
    for item in source.views:
        groups.setdefault(item.view.split if item.role == "test" else item.role, []).append(item)
    return groups


def about_samples(source: Source) -> bytes:
    """dataset.json: licence, objects, kinds of material, near, far, box, and the convention of every file."""
    surfaces = surfaces_of(source.dataset)
    objects: list[Json] = [
        {"object_id": index + 1, "name": item.name, "material": type(item.material).__name__}
        for index, item in enumerate(surfaces.scene.objects)
    ]
    kinds: list[Json] = [*source.pictures[0].quantities.material_names]
    return dump_json(
        {
            "license": source.dataset.license,
            "convention": CONVENTION,
            **bounds_keys(source.bounds),
            "objects": objects,
            "material_names": kinds,
            "files": {**FILES, **(FLOW_FILES if source.flow else {})},
        }
    )


def plan_quantities(source: Source) -> Plan:
    """The whole folder."""
    about = one_file("about", "dataset.json", lambda: about_samples(source))
    views = [
        _view_part(folder, item, flow=source.flow) for folder, items in sample_groups(source).items() for item in items
    ]
    first = views[0].files[list(FILES).index("depth.npy")]
    hint = f"python -c \"import numpy; print(numpy.load('OUT/{first}').shape)\""
    return Plan(parts=(*views, about), hint=hint, has_flow=True)


def _view_part(folder: str, item: ExportView, *, flow: bool) -> Part:
    stem = f"{folder}/{item.name}"
    return Part(
        name=f"{folder}-{item.name}",
        files=tuple(f"{stem}.{ending}" for ending in (*FILES, *(FLOW_FILES if flow else ()))),
        make=lambda: {f"{stem}.{ending}": data for ending, data in sample_files(item, flow=flow).items()},
    )


SHARD_VIEWS = 32
"""Views of a shard, which is made at once."""


def plan_webdataset(source: Source) -> Plan:
    """All shards, and what they have in common."""
    about = one_file("about", "dataset.json", lambda: about_samples(source))
    hint = "python -c \"import webdataset; print(next(iter(webdataset.WebDataset('OUT/train-000000.tar'))).keys())\""
    return Plan(parts=(*_shards(source), about), hint=hint, has_flow=True)


def _shards(source: Source) -> Iterator[Part]:
    for name, items in sample_groups(source).items():
        for shard, first in enumerate(range(0, len(items), SHARD_VIEWS)):
            yield _shard_part(f"{name}-{shard:06d}", items[first : first + SHARD_VIEWS], flow=source.flow)


def _shard_part(name: str, items: list[ExportView], *, flow: bool) -> Part:
    file = f"{name}.tar"
    return Part(name=name, files=(file,), make=lambda: {file: _tar(items, flow=flow)})


def _tar(items: list[ExportView], *, flow: bool) -> bytes:
    """The same views give the same bytes: no time, no owner."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for item in items:
            for name, data in sample_files(item, flow=flow).items():
                entry = tarfile.TarInfo(f"{item.name}.{name}")
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()
