"""RefRef: its scenes as its own data parser (Blender with masks and depth) reads them, and what its oracle needs.

transforms_{train,val,test}.json     lens; frames with file_path, mask_file_path, depth_file_path
SPLIT/image_NAME.png                 RGBA, alpha 255
SPLIT/mask_NAME.png                  255 where glass is seen first
SPLIT/depth_NAME.npy                 float32, metres along the axis to the first surface; 0: none
meshes/OBJECT.ply                    each object of glass, metres, the same world
objects.json                         their index of refraction and absorption (1/m)
points3d.ply                         points of the surfaces, for `--ply-path points3d.ply`
"""

from collections.abc import Mapping

from datagen.data.images import npy_bytes
from datagen.data.meshes import is_there
from datagen.data.ply import write_ply
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from datagen.export.files import CONVENTION, frame, lens_keys, mask_png, ply_points, rgba_png, world_keys
from datagen.export.plan import Part, Plan, one_file
from datagen.export.source import ROLES, ExportView, Role, Source
from datagen.quantities.surfaces import surfaces_of


def plan_refref(source: Source) -> Plan:
    """The whole folder."""
    lists: dict[str, Role] = {f"transforms_{role}.json": role for role in ROLES}
    cameras = Part(
        name="cameras",
        files=tuple(lists),
        make=lambda: {file: dump_json(_transforms(source, role)) for file, role in lists.items()},
    )
    points = one_file("points", "points3d.ply", lambda: ply_points(source.points))
    parts = (*(_view_part(item) for item in source.views), _objects_part(source), points, cameras)
    return Plan(parts=parts, hint="ns-train r3f --data OUT")


def _files(item: ExportView) -> tuple[str, str, str]:
    """Picture, mask and depth."""
    name = item.name
    return f"{item.role}/image_{name}.png", f"{item.role}/mask_{name}.png", f"{item.role}/depth_{name}.npy"


def _view_part(item: ExportView) -> Part:
    files = _files(item)

    def make() -> Mapping[str, bytes]:
        found = item.quantities
        return dict(zip(files, (rgba_png(item), mask_png(found.glass), npy_bytes(found.depth_along_axis)), strict=True))

    return Part(name=f"{item.role}-{item.name}", files=files, make=make)


def _transforms(source: Source, role: Role) -> dict[str, Json]:
    frames: list[Json] = []
    for item in source.of_role(role):
        image, mask, depth = (f"./{file}" for file in _files(item))
        frames.append(frame(item, image, mask_file_path=mask, depth_file_path=depth))
    lens = lens_keys(source.pictures[0].view.camera)
    return {"convention": CONVENTION, **lens, **world_keys(source), "frames": frames}


def _objects_part(source: Source) -> Part:
    names = [item.name for item in source.dataset.objects if item.is_glass]
    files = ("objects.json", *(f"meshes/{name}.ply" for name in names))

    def make() -> Mapping[str, bytes]:
        surfaces = surfaces_of(source.dataset)
        described: dict[str, Json] = {}
        meshes: dict[str, bytes] = {}
        for item, mesh in zip(surfaces.scene.objects, surfaces.meshes, strict=True):
            if item.name not in names:
                continue
            assert is_there(mesh), "only edits remove objects"
            medium = item.material.medium
            described[item.name] = {
                "mesh": f"meshes/{item.name}.ply",
                "ior": item.material.surface().ior,
                "is_thin": medium is None,
                "absorption_per_metre": [0.0, 0.0, 0.0] if medium is None else list(medium.absorption),
            }
            meshes[f"meshes/{item.name}.ply"] = write_ply(mesh)
        return {"objects.json": dump_json(described), **meshes}

    return Part(name="objects", files=files, make=make)
