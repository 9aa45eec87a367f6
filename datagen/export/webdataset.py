"""WebDataset: shards of samples, one a view, with every quantity that a view has.

    train-000000.tar, val-..., interpolating-..., extrapolating-...     VIEWS views each
    dataset.json                                                        objects, materials, conventions, near and far

A sample NAME (such as train_0003) has the files

    NAME.png                   8-bit sRGB                     NAME.camera.json           lens, world_from_camera, split
    NAME.depth.npy             metres along the axis          NAME.opaque_depth.npy      to the first opaque surface
    NAME.position.npy          metres, world axes             NAME.normal.npy            shading, world axes
    NAME.object_id.png         ids, 0: none                   NAME.material_id.png       kinds of material, 0: none
    NAME.glass.png             255: glass is seen first       NAME.thickness.npy         metres inside of glass
    NAME.albedo.npy            linear, NaN on glass           NAME.ior.npy               0 on everything opaque

and with --flow NAME.flow.npy (pixels right, down), NAME.has_flow.png and NAME.attenuation.npy. Numbers are float32; the
conventions are those of datagen/quantities/view_quantities.py.
"""

import io
import tarfile
from collections.abc import Iterator, Mapping

from datagen.data.npy import npy_bytes
from datagen.data.png import png_bytes
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.export.pictures import mask_png, rgb_png
from datagen.export.plan import Part, Plan
from datagen.export.source import ExportView, Source
from datagen.export.transforms import CONVENTION, bounds_keys, frame, lens_keys
from datagen.quantities.surfaces import surfaces_of

VIEWS = 32
"""Of a shard: what is made at once."""


def plan_webdataset(source: Source) -> Plan:
    """All shards, and what they have in common."""
    about = Part(name="about", files=("dataset.json",), make=lambda: {"dataset.json": dump_json(_about(source))})
    hint = "python -c \"import webdataset; print(next(iter(webdataset.WebDataset('OUT/train-000000.tar'))).keys())\""
    return Plan(parts=(*_shards(source), about), hint=hint)


def _shards(source: Source) -> Iterator[Part]:
    groups: dict[str, list[ExportView]] = {}
    for item in source.views:
        groups.setdefault(item.view.split if item.role == "test" else item.role, []).append(item)
    for name, items in groups.items():
        for shard, first in enumerate(range(0, len(items), VIEWS)):
            yield _shard_part(f"{name}-{shard:06d}", items[first : first + VIEWS], flow=source.flow)


def _shard_part(name: str, items: list[ExportView], *, flow: bool) -> Part:
    file = f"{name}.tar"
    return Part(name=name, files=(file,), make=lambda: {file: _tar(items, flow=flow)})


def _tar(items: list[ExportView], *, flow: bool) -> bytes:
    """The same views give the same bytes: no time, no owner."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for item in items:
            for name, data in _sample(item, flow=flow).items():
                entry = tarfile.TarInfo(f"{item.name}.{name}")
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def _sample(item: ExportView, *, flow: bool) -> Mapping[str, bytes]:
    found = item.quantities
    camera: dict[str, Json] = {
        "convention": CONVENTION,
        **lens_keys(item.view.camera),
        **frame(item, f"{item.name}.png", role=item.role, split=item.view.split, view=item.view.index),
    }
    sample = {
        "png": rgb_png(item),
        "camera.json": dump_json(camera),
        "depth.npy": npy_bytes(found.depth_along_axis),
        "opaque_depth.npy": npy_bytes(found.opaque_depth_along_axis),
        "position.npy": npy_bytes(found.position),
        "normal.npy": npy_bytes(found.normal("shading")),
        "object_id.png": png_bytes(found.object_id),
        "material_id.png": png_bytes(found.material_id),
        "glass.png": mask_png(found.glass),
        "thickness.npy": npy_bytes(found.glass_thickness),
        "albedo.npy": npy_bytes(found.albedo),
        "ior.npy": npy_bytes(found.ior),
    }
    if not flow:
        return sample
    ends = found.light_ends
    traced = {"flow.npy": npy_bytes(ends.flow), "has_flow.png": mask_png(ends.has_flow)}
    return {**sample, **traced, "attenuation.npy": npy_bytes(ends.attenuation)}


def _about(source: Source) -> dict[str, Json]:
    surfaces = surfaces_of(source.dataset)
    objects: list[Json] = [
        {"object_id": index + 1, "name": item.name, "material": type(item.material).__name__}
        for index, item in enumerate(surfaces.scene.objects)
    ]
    kinds: list[Json] = [*source.pictures[0].quantities.material_names]
    return {
        "convention": CONVENTION,
        **bounds_keys(source.bounds),
        "objects": objects,
        "material_names": kinds,
    }
