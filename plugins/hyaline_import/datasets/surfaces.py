"""The scene of an imported dataset: its meshes, with materials as far as they are known, and its cameras."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, Split
from datagen.data.depth_range import seeing
from datagen.disk.errors import HyalineError
from datagen.machine.confined import allow_triangles
from datagen.scene.camera_list import CameraList
from datagen.scene.description import MAX_OBJECTS, Scene
from datagen.scene.import_choices import ImportChoices
from datagen.scene.materials import Dielectric
from datagen.scene.remarks import Remarks
from datagen.scene.staging import even_sky
from hyaline_import.confined_import import save_answer, scene_from
from hyaline_import.datasets.choices import DatasetImportChoices
from hyaline_import.datasets.layouts import ForeignSurface
from hyaline_import.foreign import PLAIN, ForeignObject, z_up_from
from hyaline_import.foreign_files import EXPORT_ADVICE, READERS, check_overrides, ending_of, override, parse_overrides
from hyaline_import.importing import Made, World, unique_names
from hyaline_import.mapping import Mapper
from hyaline_import.overlaps import apart, nested

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
    remarks, overrides, made = Remarks(), parse_overrides(choices.material), Made()
    world = World(
        linear=choices.scale * z_up_from(choices.up),
        offset=np.zeros(3),
        mapper=Mapper(metres=choices.scale, thin="open", remarks=remarks),
        choices=ImportChoices(),
        thins_open=True,
    )
    parts = [(surface, part) for surface in surfaces for part in read_surface(surface, remarks)]
    allow_triangles(sum(len(part.faces) for _, part in parts))
    if len(parts) > MAX_OBJECTS:
        raise HyalineError(f"{name}: its meshes have {len(parts):,} objects; expected at most {MAX_OBJECTS}")
    names = unique_names([surface.name for surface, _ in parts])
    check_overrides(overrides, names)
    for object_name, (surface, part) in zip(names, parts, strict=True):
        chosen = override(object_name, overrides)
        if chosen is None and part.material is PLAIN:
            chosen = Dielectric(ior=choices.ior)
            remarks.approximate(
                surface.name,
                f"has no known material; taken for glass of index {choices.ior:g}, --ior or --material sets it",
            )
        made.add(object_name, part, world, chosen)
    scene = unlit_scene(name, made, world, cameras)
    for item in scene.objects:
        if item.material.is_glass and not any(any(seeing(cameras[split], item.mesh)) for split in SPLITS):
            remarks.approximate(item.name, "no camera sees it")
    save_answer(folder, scene, [f"{line.where}: {line.what}" for line in remarks.lines])


def unlit_scene(name: str, made: Made, world: World, cameras: dict[Split, Cameras], *, how: str = "Imported") -> Scene:
    """The scene of objects whose light is unknown, mended and checked."""
    scene = Scene(
        name=name,
        description=f"{how} from {name}; its light is unknown",
        objects=tuple(nested(apart(made.objects, world.remarks), world.remarks)),
        environment=even_sky(UNKNOWN_LIGHT),
        cameras=CameraList(**{split: cameras[split] for split in SPLITS}),
    )
    return made.finished(scene, world, where=name)


def read_surface(surface: ForeignSurface, remarks: Remarks) -> tuple[ForeignObject, ...]:
    """The objects in the file of a mesh."""
    ending, known = ending_of(surface.file), sorted(set(READERS.names()) - {"xml"})
    if ending not in known:
        endings = ", ".join(f".{name}" for name in known)
        raise HyalineError(f"{surface.file}: is not a mesh by its ending; expected one of {endings}: {EXPORT_ADVICE}")
    return READERS.find(ending)(surface.file, remarks).objects
