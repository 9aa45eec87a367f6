"""capture: pictures, a mask for each object of glass, and cameras, as `datagen capture` and people's own captures have.

    images/NAME.png            8-bit sRGB
    masks/OBJECT/NAME.png      255 where the object is seen first
    transforms.json            cameras; remove it, and `datagen capture` has to find them

Nothing here tells shapes, materials or the room.
"""

from collections.abc import Mapping

from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.export.files import CONVENTION, frame, lens_keys, mask_png, rgb_png
from datagen.export.plan import Part, Plan, one_file
from datagen.export.source import ExportView, Source


def plan_capture(source: Source) -> Plan:
    """The whole folder."""
    glass = {item.name: index + 1 for index, item in enumerate(source.dataset.objects) if item.is_glass}
    cameras = one_file("cameras", "transforms.json", lambda: dump_json(_transforms(source)))
    views = (_view_part(item, glass) for item in source.pictures if item.has_picture)
    return Plan(parts=(*views, cameras), hint="datagen capture OUT")


def _view_part(item: ExportView, glass: dict[str, int]) -> Part:
    files = (f"images/{item.name}.png", *(f"masks/{name}/{item.name}.png" for name in glass))

    def make() -> Mapping[str, bytes]:
        drawn = item.view.imported_object_ids  # Of a captured dataset, whose layers are those of stand-ins.
        first = item.view.object_ids()[0] if drawn is None else drawn
        return dict(zip(files, (rgb_png(item), *(mask_png(first == index) for index in glass.values())), strict=True))

    return Part(name=item.name, files=files, make=make)


def _transforms(source: Source) -> dict[str, Json]:
    frames: list[Json] = [frame(item, f"images/{item.name}.png") for item in source.pictures if item.has_picture]
    lens = lens_keys(source.pictures[0].view.camera)
    return {"convention": CONVENTION, "license": source.dataset.license, **lens, "frames": frames}
