"""Making a dataset: for every view render, commit, peel, commit; goes on where it was stopped."""

import shlex
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from datagen.builder.choices import Shard
from datagen.data.cameras import Cameras
from datagen.data.config import (
    RENDERED,
    SPLITS,
    DatasetConfig,
    DatasetObject,
    Imported,
    Split,
    config_difference,
    unknown_license,
)
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import geometry_hash, read_meshes
from datagen.data.layers import check_settings, record_path_of_layers, start_layers
from datagen.data.paths import HIDDEN, TRUTH, layers_root
from datagen.data.writing import clear_dataset, commit_view, dataset_files, head_contents, view_files, write_head
from datagen.disk.errors import HyalineError, WorkerKilledError
from datagen.disk.ownership import DATASET, LAYERS, holding, is_ours, refuse_taken, remove_files
from datagen.disk.storage import sha256
from datagen.machine.processes import in_workers
from datagen.scene.description import CameraList, Scene
from datagen.scene.folder import open_scene, scene_files
from datagen.scene.rig import cameras_within, make_cameras
from datagen.scene.soundness import check_glass_is_seen
from datagen.terminal.command import say, this_command, track

Task = tuple[Split, int]

MOST_DECIBELS = 80.0
"""A higher noise ceiling means that nothing was measured, such as noise of a plain sky."""
MANY_PERCENT = 1.0
"""Percentage of rays that lose surfaces above which the build explains how to keep more."""


class RenderJob:
    """What a worker keeps between the views that it renders."""

    def __init__(self, threads: int, root: Path) -> None:
        from datagen.machine.mitsuba_variant import use_mitsuba
        from datagen.render.truth import Renderer

        self.variant = use_mitsuba(threads=threads)
        self.dataset = open_dataset(root)
        self.cameras = {split: self.dataset.cameras(split) for split in self.dataset.splits}
        self.renderer = Renderer(open_scene(self.dataset), max_depth=self.dataset.config.max_depth)


def render_task(job: RenderJob, task: Task) -> None:
    """Renders one view and commits it."""
    from datagen.render.truth import derive_seed, render_view, truth_files

    split, view = task
    config = job.dataset.config
    seed, spp = derive_seed(config.seed, split, view, "render"), config.split(split).spp
    assert spp is not None, "an imported dataset is not rendered"
    truth = render_view(
        job.renderer,
        job.cameras[split],
        view,
        spp=spp,
        view_seed=seed,
        ceiling_db=config.ceiling_db if split != "train" else None,
    )
    if task == ("train", 0) and not truth.radiance.any():
        raise HyalineError(
            f"scene {config.scene}: no light reaches the first training camera; add a lamp (`lights` in scene.json, or "
            "a mesh that glows in the file), or open the room"
        )
    commit_view(
        job.dataset,
        split,
        view,
        truth_files(truth),
        seed=seed,
        spp=truth.spp,
        noise_mse=truth.noise_mse,
        variant=job.variant,
    )


class PeelJob:
    """What a worker keeps between the views that it peels."""

    def __init__(self, threads: int, root: Path, geometry: str) -> None:
        from datagen.machine.mitsuba_variant import use_mitsuba
        from datagen.trace.peel import Peeler

        use_mitsuba(threads=threads)
        self.dataset = open_dataset(root)
        self.cameras = {split: self.dataset.cameras(split) for split in self.dataset.splits}
        self.peeler = Peeler(read_meshes(self.dataset, geometry))
        self.store = self.dataset.layer_store(geometry)


def peel_task(job: PeelJob, task: Task) -> None:
    """Peels one view into layers and commits them."""
    split, view = task
    layers, overflow_share = job.peeler.peel(job.cameras[split], view, job.store.head.num_layers)
    job.store.write(split, view, layers, overflow_share=overflow_share)


def build_dataset(
    scene: Scene,
    root: Path,
    config: DatasetConfig,
    *,
    num_layers: int,
    workers: int,
    overwrite: bool,
    shard: Shard | None = None,
) -> Dataset:
    """Renders and peels every view that is not there yet, or those of one part.

    The bytes depend on scene and configuration alone: not on workers, threads, order, parts, or how often it was
    stopped. `num_layers` are kept of each ray.

    Raises:
        HyalineError: `root` holds something else, or another process writes there.
    """
    check_settings(num_layers=num_layers, workers=workers)
    if HIDDEN.fullmatch(config.scene):
        raise HyalineError(
            f"scene {config.scene}: is not rendered, since only a verifier knows light and colours of hidden scenes "
            "of hyaline-bench; choose another name for a scene of your own"
        )
    if config.train.views < 1:
        raise HyalineError(f"views: are {config.train.views}; expected at least 1 training view")
    with holding(root, DATASET, shared=shard is not None):
        cameras = cameras_within(scene, make_cameras(scene.cameras, config))
        check_glass_is_seen(scene, cameras.values())
        dataset = open_or_start(scene, root, config, cameras, overwrite=overwrite)
        meshes_hash = geometry_hash(dataset, TRUTH)
        # Now, so that a dataset that is stopped while it renders says which layers it is to have.
        with holding(layers_root(root, TRUTH), LAYERS, within=root, shared=shard is not None):
            _start_layers(dataset, TRUTH, meshes_hash, num_layers=num_layers, overwrite=False, shard=shard)
        made = render_dataset(dataset, workers=workers, shard=shard)
    made += peel_dataset(dataset, TRUTH, num_layers=num_layers, overwrite=False, workers=workers, shard=shard)
    if not made:
        say(f"{root}: is built already; nothing to do")
    elif shard is None:
        say(*summary(dataset, TRUTH))
    return dataset


def render_dataset(dataset: Dataset, *, workers: int, shard: Shard | None = None) -> int:
    """Renders every view, or those of a part, that is not there yet; returns how many. The caller holds the folder."""
    views = {task: dataset.view(*task) for task in _tasks(dataset, shard)}
    missing = [task for task, view in views.items() if not view.is_built]
    if not missing:
        return 0
    from datagen.machine.mitsuba_variant import use_mitsuba

    say(f"{dataset.root}: rendering {len(missing)} of {len(views)} views with {use_mitsuba()}")
    finished = in_workers(render_task, missing, workers, RenderJob, (dataset.root,))
    where, done = f"{dataset.root}: render", len(views) - len(missing)
    _wait_for(finished, label="render", where=where, total=len(views), done=done)
    return len(missing)


def peel_dataset(
    dataset: Dataset, geometry: str, *, num_layers: int, overwrite: bool, workers: int = 1, shard: Shard | None = None
) -> int:
    """Peels every view of a geometry, or those of one part, that is not peeled yet, into `num_layers` of each ray.

    Returns how many it peeled.
    """
    check_settings(num_layers=num_layers, workers=workers)
    meshes_hash = geometry_hash(dataset, geometry)
    root = layers_root(dataset.root, geometry)
    with holding(root, LAYERS, within=dataset.root, shared=shard is not None):
        _start_layers(dataset, geometry, meshes_hash, num_layers=num_layers, overwrite=overwrite, shard=shard)
        store, tasks = dataset.layer_store(geometry), _tasks(dataset, shard)
        missing = [task for task in tasks if not store.is_peeled(*task)]
        if missing:
            finished = in_workers(peel_task, missing, workers, PeelJob, (dataset.root, geometry))
            done = len(tasks) - len(missing)
            _wait_for(finished, label=f"peel {geometry}", where=f"{root}: peel", total=len(tasks), done=done)
        return len(missing)


def _start_layers(
    dataset: Dataset, geometry: str, meshes_hash: str, *, num_layers: int, overwrite: bool, shard: Shard | None
) -> None:
    """Sees to it that a store of these settings stands there, without views or with some; the caller holds it.

    A part never replaces a store, since other parts may have started it.
    """
    root, size = layers_root(dataset.root, geometry), dataset.config.resolution
    settings = {"num_layers": num_layers, "geometry_hash": meshes_hash}
    if shard is not None:
        start_layers(root, size, **settings)
    if overwrite and is_ours(root, LAYERS):
        # Keeps views that verify under the new head, unless all are to be replaced.
        remove_files(root, [record_path_of_layers(Path(), *task).as_posix() for task in _tasks(dataset)])
    elif is_ours(root, LAYERS):
        head = dataset.layer_store(geometry).head
        if head.num_layers != num_layers:
            raise HyalineError(
                f"{root}: was peeled into {head.num_layers} layers, not {num_layers}; pass --overwrite, or "
                f"--num-layers {head.num_layers}"
            )
        if head.geometry == meshes_hash:
            return
        if shard is not None:
            raise HyalineError(f"{root}: holds layers of another geometry; build without --shard, which replaces them")
        say(f"{root}: the geometry has changed since it was peeled; peeling it again")
    start_layers(root, size, **settings, replace=True)


def _wait_for(work: Iterable[object], *, label: str, where: str, total: int, done: int) -> None:
    """Waits for workers, with a line of progress; the error of a killed one says how many views it leaves."""
    try:
        for _ in track(work, label=label, total=total, done=done):
            done += 1
    except WorkerKilledError as error:
        left = f"at most {total - done} of {total} views are missing"
        raise WorkerKilledError(f"{where}: {error}; {left}; go on with `{this_command()}`") from None


def summary(dataset: Dataset, geometry: str) -> list[str]:
    """What was made, in a line for each split: its noise ceiling, and rays that were cut off."""
    views: dict[Split, int] = {split: count for split, count in dataset.num_views.items() if count}
    store = dataset.layer_store(geometry)
    lines, most = [], 0.0
    for split, count in views.items():
        ceiling = dataset.noise_ceiling_db(split)
        value = "unknown" if ceiling is None else f"{ceiling:.1f} dB"
        if ceiling is not None and ceiling > MOST_DECIBELS:
            value = "none measured (the pictures have no noise)"
        share = 100 * float(np.mean([store.record(split, view).overflow_share for view in range(count)]))
        crossing = f"{share:.2f} % of rays cross more surfaces than the {store.head.num_layers} that are stored"
        lines.append(f"{split}: noise ceiling {value}; {crossing}")
        most = max(most, share)
    if most > MANY_PERCENT:
        words = ["datagen", "peel", str(dataset.root), *(["--geometry", geometry] if geometry != TRUTH else [])]
        more = shlex.join([*words, "--num-layers", str(2 * store.head.num_layers), "--overwrite"])
        lines.append(f"`{more}` stores more")
    return lines


def refuse_unlit(dataset: Dataset, *, what: str) -> None:
    """Refuses what needs the light of a scene, where pictures were imported or the scene is a hidden one."""
    if dataset.is_hidden:
        raise HyalineError(
            f"{dataset.root}: is a hidden scene of hyaline-bench; only a verifier knows its light and colours, so that "
            f"{what} cannot be rendered; expected another scene"
        )
    if dataset.imported is not None:
        raise HyalineError(
            f"{dataset.root}: was imported from {dataset.imported.source}, and the light in its scene is unknown, so "
            f"that {what} cannot be rendered; expected a dataset that `datagen build` made"
        )


def open_or_start(
    scene: Scene | None,
    root: Path,
    config: DatasetConfig,
    cameras: dict[Split, Cameras],
    *,
    overwrite: bool,
    imported: Imported | None = None,
    stated_license: str | None = None,
) -> Dataset:
    """The dataset at `root`, its head complete, or a new one without views; the caller holds the folder.

    Args:
        scene: None where pictures were imported without any mesh.
        imported: where the pictures come from, unless they are rendered here.
        stated_license: of imported pictures; that of the scene unless given.
    """
    files = {} if scene is None else scene_files(scene)
    if stated_license is None:
        stated_license = (None if scene is None else scene.license) or unknown_license(f"scene {config.scene}")
    listed = () if scene is None else scene.objects
    objects = tuple(DatasetObject(name=item.name, is_glass=item.material.is_glass) for item in listed)
    if overwrite and is_ours(root, DATASET):
        endings = RENDERED if imported is None else imported.endings
        wanted = [*view_files(config, SPLITS, endings), *head_contents(files, cameras)]
        refuse_taken(root, DATASET, wanted, dataset_files(root))
        clear_dataset(root)
    # Another process may have been there first, with other settings.
    dataset = write_head(
        root, config, objects, cameras, files, imported=imported, stated_license=stated_license, replace=overwrite
    )
    # A rig's cameras are computed, and may differ in their last bits on another machine.
    is_listed = imported is not None or (scene is not None and isinstance(scene.cameras, CameraList))
    contents = head_contents(files, cameras if is_listed else {})
    changed = next((path for path, data in contents.items() if dataset.files.get(path) != sha256(data)), None)
    if dataset.imported != imported:
        other = "pictures that were rendered or imported otherwise"
    elif difference := config_difference(dataset.config, config):
        other = f"a dataset with another configuration ({difference})"
    elif changed is not None:
        other = f"a dataset of another version of scene {config.scene} ({changed} differs)"
    else:
        return dataset
    raise HyalineError(f"{root}: holds {other}; pass --overwrite to replace it, or --out for another place")


def _tasks(dataset: Dataset, shard: Shard | None = None) -> list[Task]:
    """All views, or those of a part, the splits interleaved: so the time left is estimated well."""
    views = dataset.num_views
    tasks: list[Task] = [(split, view) for split, count in views.items() for view in range(count)]
    tasks.sort(key=lambda task: (task[1] + 0.5) / views[task[0]])
    return tasks if shard is None else tasks[shard.number - 1 :: shard.count]
