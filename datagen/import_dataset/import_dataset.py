"""Another project's dataset as one of ours: read, split, write; goes on where it was stopped."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.build.build import open_or_start
from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, DatasetConfig, Resolution, Split, SplitConfig
from datagen.data.dataset import Dataset, View
from datagen.data.depth_range import with_depth_range
from datagen.data.metadata import Imported, unknown_license
from datagen.data.writing import commit_imported_view
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, holding
from datagen.disk.storage import sha256_file
from datagen.import_dataset.choices import DatasetImportChoices
from datagen.import_dataset.foreign_dataset import ForeignDataset, ForeignSurface, ForeignView
from datagen.import_dataset.layouts import read_layout, surface_name
from datagen.import_dataset.pictures import view_files
from datagen.import_dataset.splits import split_views
from datagen.import_dataset.surfaces import find_scene
from datagen.scene.description import Scene
from datagen.scene.importers.importing import scene_name
from datagen.scene.importers.staging import z_up_from
from datagen.terminal.command import track

PRESET = "imported"


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """What an import will write, before any picture is decoded."""

    foreign: ForeignDataset
    views: dict[Split, tuple[ForeignView, ...]]
    cameras: dict[Split, Cameras]
    config: DatasetConfig
    scene: Scene | None
    """None without meshes."""
    imported: Imported


def plan_import(folder: Path, choices: DatasetImportChoices) -> Plan:
    """Reads all of a folder but for its pictures.

    Raises:
        HyalineError: no layout that is known, or something in it that no dataset can hold.
    """
    foreign = read_layout(folder)
    whole, times = foreign.lens.size, choices.downscale
    if whole.width % times or whole.height % times:
        raise HyalineError(f"--downscale: is {times}, and pictures are {whole} pixels; expected a divisor of both")
    views, lines = split_views(foreign)
    linear = choices.scale * z_up_from(choices.up)
    size = Resolution(width=whole.width // times, height=whole.height // times)
    lens = foreign.lens.fitted(size)
    cameras: dict[Split, Cameras] = {
        split: lens.cameras(np.stack([_placed(view.world_from_camera, linear) for view in views[split]]))
        for split in SPLITS
    }
    name = scene_name(folder.resolve())
    given = tuple(ForeignSurface(name=surface_name(file), file=file) for file in choices.mesh)
    surfaces = (*foreign.surfaces, *given)
    scene, about_scene = find_scene(name, surfaces, cameras, choices) if surfaces else (None, [])
    if scene is not None:
        cameras = with_depth_range(cameras, [item.mesh for item in scene.objects])
    few = {split: SplitConfig(views=len(views[split]), spp=None) for split in SPLITS}
    config = DatasetConfig(
        scene=name,
        preset=PRESET,
        resolution=size,
        train=few["train"],
        interpolating=few["interpolating"],
        extrapolating=few["extrapolating"],
    )
    used = [view for split in SPLITS for view in views[split]]
    told = (*foreign.remarks, *lines, *about_scene)
    imported = Imported(
        layout=foreign.layout,
        source=folder.resolve().name,
        source_sha256=_digest([*foreign.files, *choices.mesh], choices),
        has_masks=all(view.mask is not None for view in used),
        has_depth=all(view.depth is not None for view in used),
        remarks=told,
    )
    return Plan(foreign=foreign, views=views, cameras=cameras, config=config, scene=scene, imported=imported)


def write_import(plan: Plan, root: Path, choices: DatasetImportChoices, *, overwrite: bool) -> Dataset:
    """Writes what is missing of an import.

    Raises:
        HyalineError: something else stands at `root`, or a picture cannot be read.
    """
    with holding(root, DATASET):
        dataset = open_or_start(
            plan.scene,
            root,
            plan.config,
            plan.cameras,
            overwrite=overwrite,
            imported=plan.imported,
            stated_license=plan.foreign.license or unknown_license(plan.imported.source),
        )
        missing = [view for view in _views(dataset) if not view.is_built]
        total = sum(plan.config.split(split).views for split in SPLITS)
        for view in track(missing, label="import", total=total, done=total - len(missing)):
            files = view_files(
                plan.views[view.split][view.index],
                plan.foreign.lens.size,
                choices,
                has_mask=plan.imported.has_masks,
                has_depth=plan.imported.has_depth,
            )
            commit_imported_view(dataset, view.split, view.index, files)
    return dataset


def _views(dataset: Dataset) -> Iterator[View]:
    for split in dataset.splits:
        yield from dataset.views(split)


def _placed(pose: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """A camera in our world: turned and moved, and not stretched."""
    placed = pose.copy()
    placed[:3, :3] = np.rint(linear / np.abs(linear).max()) @ pose[:3, :3]
    placed[:3, 3] = linear @ pose[:3, 3]
    return placed


def _digest(files: list[Path], choices: DatasetImportChoices) -> str:
    """Names the content of files in their order, and what decides how pictures are taken over."""
    digest = hashlib.sha256(f"{choices.downscale} {choices.background} {choices.scale}".encode())
    for file in files:
        digest.update(sha256_file(file).encode())
    return digest.hexdigest()
