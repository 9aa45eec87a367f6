"""Another project's dataset as one of ours: read, split, write; goes on where it was stopped."""

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.builder.build import open_or_start
from datagen.data.cameras import Cameras, seeing, with_depth_range
from datagen.data.config import SPLITS, DatasetConfig, Imported, Resolution, Split, SplitConfig, unknown_license
from datagen.data.dataset import Dataset
from datagen.data.writing import commit_view
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, holding
from datagen.disk.storage import read_regular, sha256
from datagen.scene.description import MAX_OBJECTS, CameraList, Scene
from datagen.scene.finding import ImportChoices
from datagen.scene.materials import Dielectric
from datagen.terminal.command import track
from datagen.terminal.plugins import Group
from hyaline_import.commands import DatasetImportChoices
from hyaline_import.confined_import import save_answer, scene_from
from hyaline_import.datasets.layouts import ROLES, ForeignDataset, ForeignView, view_files
from hyaline_import.foreign import PLAIN, ForeignObject, z_up_from
from hyaline_import.importing import Made, World, unique_names
from hyaline_import.mapping import Mapper
from hyaline_import.remarks import Remarks
from hyaline_import.source import chosen_materials, read_scene, scene_name
from hyaline_import.staging import even_sky

READERS: Group[Callable[[Path], ForeignDataset | None]] = Group(
    name="hyaline.dataset_readers",
    what="layout",
    built_in={"transforms": "hyaline_import.datasets.layouts:read_folder"},
    guide="docs/extending.md",
)
"""Each gets a folder, and returns None where it is not of its layout."""

UNKNOWN_LIGHT = (0.5, 0.5, 0.5)
"""Stands in for the unknown light: such a scene is never rendered."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """What an import will write, before any picture is decoded."""

    files: Callable[[Split, int], dict[str, bytes]]
    """The files of a view by their endings."""
    cameras: dict[Split, Cameras]
    config: DatasetConfig
    scene: Scene | None
    """None without meshes."""
    imported: Imported
    stated_license: str | None


def plan_import(folder: Path, choices: DatasetImportChoices) -> Plan:
    """Reads all of a folder but for its pictures."""
    foreign = read_foreign_dataset(folder)
    views, lines = split_views(foreign)
    size = foreign.lens.size
    turn = z_up_from(choices.up)
    cameras: dict[Split, Cameras] = {}
    for split in SPLITS:
        poses = np.stack([view.world_from_camera for view in views[split]])
        poses[:, :3, :3] = turn @ poses[:, :3, :3]
        poses[:, :3, 3] = choices.scale * poses[:, :3, 3] @ turn.T
        cameras[split] = foreign.lens.cameras(poses)
    name = scene_name(folder.resolve())
    scene, about_scene = None, []
    if choices.mesh:
        where = ", ".join(map(str, choices.mesh))
        scene, about_scene, _ = scene_from(_save_scene, name, cameras, choices, where=where)
        cameras = with_depth_range(cameras, [item.mesh for item in scene.objects])
    config = imported_config(name, size, views)
    imported = Imported(
        layout=foreign.layout,
        source=folder.resolve().name,
        source_sha256=digest_of([*foreign.files, *choices.mesh], f"{choices.background} {choices.scale}"),
        has_masks=all(view.mask is not None for split in SPLITS for view in views[split]),
        has_depth=False,
        remarks=(*foreign.remarks, *lines, *about_scene),
    )

    def files(split: Split, index: int) -> dict[str, bytes]:
        return view_files(views[split][index], size, choices, has_mask=imported.has_masks)

    return Plan(
        files=files, cameras=cameras, config=config, scene=scene, imported=imported, stated_license=foreign.license
    )


def imported_config(name: str, size: Resolution, views: Mapping[Split, Sequence[ForeignView]]) -> DatasetConfig:
    """The configuration of a dataset of these views."""
    train, near, far = (SplitConfig(views=len(views[split]), spp=None) for split in SPLITS)
    return DatasetConfig(
        scene=name, preset="imported", resolution=size, train=train, interpolating=near, extrapolating=far
    )


def read_foreign_dataset(root: Path) -> ForeignDataset:
    """What a folder names, by the first reader that knows its layout."""
    if not root.is_dir():
        raise HyalineError(f"{root}: is not a folder; expected one with transforms_train.json or transforms.json")
    if (root / DATASET.head).is_file():
        raise HyalineError(f"{root}: is a hyaline dataset already; pass it to the other commands as it is")
    for name in READERS.names():
        if (found := READERS.find(name)(root)) is not None:
            return found
    others = ", ".join(READERS.names()[len(READERS.built_in) :])
    raise HyalineError(
        f"{root}: has neither transforms_train.json nor transforms.json; expected the layout of RefRef, OpenMaterial, "
        f"Blender or nerfstudio{f', or of one of the installed readers ({others})' if others else ''}"
    )


def write_import(plan: Plan, root: Path, *, overwrite: bool) -> Dataset:
    """Writes what is missing of an import."""
    with holding(root, DATASET):
        dataset = open_or_start(
            plan.scene,
            root,
            plan.config,
            plan.cameras,
            overwrite=overwrite,
            imported=plan.imported,
            stated_license=plan.stated_license or unknown_license(plan.imported.source),
        )
        missing = [view for split in dataset.splits for view in dataset.views(split) if not view.is_built]
        total = sum(plan.config.split(split).views for split in SPLITS)
        for view in track(missing, label="import", total=total, done=total - len(missing)):
            commit_view(dataset, view.split, view.index, plan.files(view.split, view.index))
    return dataset


def digest_of(files: Sequence[Path], choices: str) -> str:
    """Names the content of files in their order, and what decides how they are taken over."""
    digest = hashlib.sha256(choices.encode())
    for file in files:
        digest.update(sha256(read_regular(file)).encode())
    return digest.hexdigest()


def _save_scene(folder: Path, name: str, cameras: dict[Split, Cameras], choices: DatasetImportChoices) -> None:
    remarks, made = Remarks(), Made()
    world = World(
        linear=choices.scale * z_up_from(choices.up),
        offset=np.zeros(3),
        mapper=Mapper(metres=choices.scale, remarks=remarks),
        choices=ImportChoices(),
    )
    parts: list[tuple[str, ForeignObject]] = []
    for file in choices.mesh:
        parts += [(file.stem, part) for part in read_scene(file, remarks).objects]
    if len(parts) > MAX_OBJECTS:
        raise HyalineError(f"{name}: its meshes have {len(parts):,} objects; expected at most {MAX_OBJECTS}")
    names = unique_names([stem for stem, _ in parts])
    materials = chosen_materials(choices.material, names)
    for object_name, (stem, part) in zip(names, parts, strict=True):
        chosen = materials.get(object_name)
        if chosen is None and part.material is PLAIN:
            chosen = Dielectric(ior=choices.ior)
            remarks.approximate(
                stem,
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
        objects=tuple(made.placed(world.remarks, where=name)),
        environment=even_sky(UNKNOWN_LIGHT),
        cameras=CameraList(**{split: cameras[split] for split in SPLITS}),
    )
    return made.finished(scene, world)


# Splits

OURS = re.compile(r"(?:image_)?(train|interpolating|extrapolating)_(\d{4})")
"""Names of pictures in what `datagen export` writes."""
FAR_SHARE = 4
"""One in this many test views is for extrapolation."""


def split_views(foreign: ForeignDataset) -> tuple[dict[Split, tuple[ForeignView, ...]], list[str]]:
    """The views of each split, and one line for each decision.

    Pictures that `datagen export` named get back their places. Otherwise the farthest views become `extrapolating`.
    """
    if (named := _by_name(foreign)) is not None:
        return named, []
    train, val, test = (foreign.views[role] for role in ROLES)
    lines = []
    if val and not test:
        test, lines = val, ["splits: there are no test pictures; those for validation take their place"]
    elif val:
        lines.append(f"splits: {len(val)} pictures for validation were left out")
    if not train or not test:
        raise HyalineError(
            f"{foreign.root}: has {len(train)} pictures to train on and {len(test)} to test; expected some of each"
        )
    learned = {view.picture for view in train}
    if (again := next((view.picture for view in test if view.picture in learned), None)) is not None:
        raise HyalineError(f"{again}: is listed to train on and to test; expected each picture once")
    if len(test) == 1:
        lines.append("splits: the only test picture is in both test splits")
        return {"train": train, "interpolating": test, "extrapolating": test}, lines
    places = np.stack([view.world_from_camera[:3, 3] for view in train])
    away = np.array([np.linalg.norm(places - view.world_from_camera[:3, 3], axis=1).min() for view in test])
    far = {int(place) for place in np.argsort(-away, kind="stable")[: max(1, len(test) // FAR_SHARE)]}
    lines.append(
        f"splits: the {len(far)} test views farthest from any training camera are in extrapolating, the "
        "other ones in interpolating"
    )
    near = tuple(view for place, view in enumerate(test) if place not in far)
    return {"train": train, "interpolating": near, "extrapolating": tuple(test[place] for place in sorted(far))}, lines


def _by_name(foreign: ForeignDataset) -> dict[Split, tuple[ForeignView, ...]] | None:
    """The views by the splits in their names; None unless every name has one of its own, and each split some views."""
    views = [view for role in ROLES for view in foreign.views[role]]
    places = {match.groups(): view for view in views if (match := OURS.fullmatch(view.picture.stem))}
    found: dict[Split, tuple[ForeignView, ...]] = {
        split: tuple(places[place] for place in sorted(places) if place[0] == split) for split in SPLITS
    }
    return found if all(found.values()) and len(places) == len(views) else None
