"""The scene of an imported dataset: its meshes, with materials as far as they are known, and its cameras."""

from collections.abc import Mapping, Sequence, Set
from pathlib import Path

import numpy as np

from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, Split
from datagen.data.depth_range import seeing
from datagen.data.meshes import open_edges
from datagen.disk.errors import HyalineError
from datagen.machine.confined import allow_triangles
from datagen.scene.camera_list import CameraList
from datagen.scene.description import MAX_OBJECTS, Scene, SceneObject
from datagen.scene.import_choices import ImportChoices
from datagen.scene.materials import Dielectric, Material, ThinDielectric
from datagen.scene.mending import mend_scene
from datagen.scene.remarks import Remarks
from datagen.scene.soundness import check_scene
from datagen.scene.staging import even_sky
from hyaline_import.confined_import import save_answer, scene_from
from hyaline_import.datasets.choices import DatasetImportChoices
from hyaline_import.datasets.layouts import ForeignSurface
from hyaline_import.foreign import PLAIN, ForeignObject, z_up_from
from hyaline_import.foreign_files import (
    EXPORT_ADVICE,
    READERS,
    check_overrides,
    ending_of,
    override,
    parse_overrides,
)
from hyaline_import.importing import scene_object, unique_names
from hyaline_import.mapping import Mapper
from hyaline_import.overlaps import apart, nested, parted

UNKNOWN_LIGHT = (0.5, 0.5, 0.5)
"""Stands in for the unknown light: such a scene is never rendered."""


def find_scene(
    name: str, surfaces: Sequence[ForeignSurface], cameras: dict[Split, Cameras], choices: DatasetImportChoices
) -> tuple[Scene, list[str]]:
    """The scene of some meshes, as far as a dataset without light needs one, and remarks on it."""
    where = ", ".join(str(surface.file) for surface in surfaces)
    return scene_from(_save_scene, name, surfaces, cameras, choices, where=where)


def _save_scene(
    folder: Path,
    name: str,
    surfaces: Sequence[ForeignSurface],
    cameras: dict[Split, Cameras],
    choices: DatasetImportChoices,
) -> None:
    remarks = Remarks()
    scene = _make_scene(name, surfaces, cameras, choices, remarks)
    save_answer(folder, scene, [f"{line.where}: {line.what}" for line in remarks.lines])


def _make_scene(
    name: str,
    surfaces: Sequence[ForeignSurface],
    cameras: dict[Split, Cameras],
    choices: DatasetImportChoices,
    remarks: Remarks,
) -> Scene:
    overrides = parse_overrides(choices.material)
    linear = choices.scale * z_up_from(choices.up)
    mapper = Mapper(metres=choices.scale, thin="open", remarks=remarks)
    objects: list[SceneObject] = []
    without_uv: set[str] = set()
    parts = [(surface, part) for surface in surfaces for part in read_surface(surface, remarks)]
    allow_triangles(sum(len(part.faces) for _, part in parts))
    if len(parts) > MAX_OBJECTS:
        raise HyalineError(f"{name}: its meshes have {len(parts):,} objects; expected at most {MAX_OBJECTS}")
    names = unique_names([surface.name for surface, _ in parts])
    check_overrides(overrides, names)
    for object_name, (surface, part) in zip(names, parts, strict=True):
        chosen = override(object_name, overrides)
        if chosen is None and (part.material is PLAIN or surface.ior is not None):
            chosen = _glass(surface, choices, remarks)
        item = scene_object(object_name, part, linear, np.zeros(3), mapper, chosen, remarks, ImportChoices())
        objects += parted(_thin_where_open(item, remarks), remarks)
        if part.uv is None:
            without_uv.add(object_name)
    scene = assemble(name, objects, cameras, remarks, without_uv=without_uv, images=mapper.images)
    for item in scene.objects:
        if item.material.is_glass and not any(any(seeing(cameras[split], item.mesh)) for split in SPLITS):
            remarks.approximate(item.name, "no camera sees it")
    return scene


def assemble(
    name: str,
    objects: list[SceneObject],
    cameras: dict[Split, Cameras],
    remarks: Remarks,
    *,
    how: str = "Imported",
    without_uv: Set[str],
    images: Mapping[str, bytes],
) -> Scene:
    """The scene of some objects whose light is unknown, mended and checked.

    Args:
        without_uv: names of objects that get an atlas.
        images: that materials may use, by their paths.
    """
    objects = nested(apart(objects, remarks), remarks)
    used = {image.path for item in objects for image in item.material.images().values()}
    scene = Scene(
        name=name,
        description=f"{how} from {name}; its light is unknown",
        objects=tuple(objects),
        environment=even_sky(UNKNOWN_LIGHT),
        cameras=CameraList(**{split: cameras[split] for split in SPLITS}),
        baked={image: data for image, data in images.items() if image in used},
    )
    scene = mend_scene(scene, without_uv={item.name for item in objects if item.name in without_uv})
    check_scene(scene)
    return scene


def read_surface(surface: ForeignSurface, remarks: Remarks) -> tuple[ForeignObject, ...]:
    """The objects in the file of a mesh."""
    ending, known = ending_of(surface.file), sorted(set(READERS.names()) - {"xml"})
    if ending not in known:
        endings = ", ".join(f".{name}" for name in known)
        raise HyalineError(f"{surface.file}: is not a mesh by its ending; expected one of {endings}: {EXPORT_ADVICE}")
    return READERS.find(ending)(surface.file, remarks).objects


def _glass(surface: ForeignSurface, choices: DatasetImportChoices, remarks: Remarks) -> Material:
    ior = surface.ior
    if ior is None:
        ior = choices.ior
        remarks.approximate(
            surface.name, f"has no known material; taken for glass of index {ior:g}, --ior or --material sets it"
        )
    if surface.is_thin:
        return ThinDielectric(ior=ior)
    red, green, blue = (value / choices.scale for value in surface.absorption)
    return Dielectric(ior=ior, absorption=(red, green, blue))


def _thin_where_open(item: SceneObject, remarks: Remarks) -> SceneObject:
    """The object; of thin glass where light could never leave it, since its mesh is open."""
    medium = item.material.medium
    if medium is None or not (count := open_edges(item.mesh)):
        return item
    remarks.approximate(item.name, f"is not closed ({count} open edges); taken for thin glass, close it in a modeller")
    return SceneObject(name=item.name, mesh=item.mesh, material=ThinDielectric(ior=item.material.surface().ior))
