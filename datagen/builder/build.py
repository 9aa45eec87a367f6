"""Making a dataset: for every view render, commit, peel, commit; goes on where it was stopped."""

import contextlib
import functools
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from datagen.builder.jobs import PeelJob, RenderJob, Task, peel_task, render_task
from datagen.builder.light_check import check_light
from datagen.builder.shards import Shard, own_tasks
from datagen.data.cameras import Cameras
from datagen.data.config import SPLITS, DatasetConfig, Split, config_difference, describe_views
from datagen.data.dataset import Dataset, DatasetObject, open_dataset
from datagen.data.geometries import geometry_hash
from datagen.data.layer_writing import check_settings, create_layers
from datagen.data.layers import record_path_of_layers
from datagen.data.metadata import RENDERED, Imported, unknown_license
from datagen.data.paths import HIDDEN, TRUTH, layers_root
from datagen.data.writing import clear_dataset, dataset_files, head_contents, view_files, write_head
from datagen.disk.errors import DamagedError, HyalineError, WorkerKilledError
from datagen.disk.ownership import DATASET, LAYERS, holding, is_ours, refuse_taken, remove_files
from datagen.disk.storage import sha256
from datagen.machine.processes import in_workers
from datagen.scene.description import CameraList, Scene
from datagen.scene.folder import scene_files
from datagen.scene.rig import cameras_within, make_cameras
from datagen.terminal.command import say, this_command, track

MOST_DECIBELS = 80.0
"""A higher noise ceiling means that nothing was measured, such as noise of a plain sky."""
MANY_PERCENT = 1.0
"""Percentage of rays that lose surfaces above which the build explains how to keep more."""


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
        cameras = None if overwrite else _stored_cameras(scene, root, config)
        if cameras is None:
            cameras = cameras_within(scene, make_cameras(scene.cameras, config))
            check_light(scene, cameras)
        dataset = open_or_start(scene, root, config, cameras, overwrite=overwrite)
        meshes_hash = geometry_hash(dataset, TRUTH)
        # Now, so that a dataset that is stopped while it renders says which layers it is to have.
        with holding(layers_root(root, TRUTH), LAYERS, within=root, shared=shard is not None):
            _start_layers(dataset, TRUTH, meshes_hash, num_layers=num_layers, overwrite=False, shard=shard)
        render_dataset(dataset, workers=workers, shard=shard)
    peel_dataset(dataset, TRUTH, num_layers=num_layers, overwrite=False, workers=workers, shard=shard)
    return dataset


def _stored_cameras(scene: Scene, root: Path, config: DatasetConfig) -> dict[Split, Cameras] | None:
    """The cameras that a scene's rig placed for an intact dataset of the same configuration, if there is one."""
    try:
        stored = open_dataset(root)
        is_same = stored.config == config and not isinstance(scene.cameras, CameraList)
        is_same = is_same and all(
            stored.files.get(path) == sha256(data) for path, data in head_contents(scene_files(scene), {}).items()
        )
        return {split: stored.cameras(split) for split in SPLITS} if is_same else None
    except HyalineError:
        return None


def render_dataset(dataset: Dataset, *, workers: int, shard: Shard | None = None) -> None:
    """Renders every view, or those of a part, that is not there yet; the caller holds the dataset's folder."""
    tasks = own_tasks(shard, _tasks(dataset))
    missing = [task for task in tasks if not dataset.view(*task).is_built]
    if not missing:
        return
    from datagen.machine.mitsuba_variant import use_mitsuba

    say(f"{dataset.root}: rendering {len(missing)} of {len(tasks)} views with {use_mitsuba()}")
    finished = in_workers(render_task, missing, workers, RenderJob, (dataset.root,))
    with _told_missing(missing, lambda task: dataset.view(*task).is_built, where=f"{dataset.root}: render"):
        for _ in track(finished, label="render", total=len(tasks), done=len(tasks) - len(missing)):
            pass


def peel_dataset(
    dataset: Dataset, geometry: str, *, num_layers: int, overwrite: bool, workers: int = 1, shard: Shard | None = None
) -> None:
    """Peels every view of a geometry, or those of one part, that is not peeled yet, into `num_layers` of each ray.

    Raises:
        HyalineError: the geometry does not exist, or was peeled with other settings.
    """
    check_settings(num_layers=num_layers, workers=workers)
    meshes_hash = geometry_hash(dataset, geometry)
    root = layers_root(dataset.root, geometry)
    with holding(root, LAYERS, within=dataset.root, shared=shard is not None):
        _start_layers(dataset, geometry, meshes_hash, num_layers=num_layers, overwrite=overwrite, shard=shard)
        is_made = functools.partial(_is_peeled, dataset, geometry)
        tasks = own_tasks(shard, _tasks(dataset))
        missing = [task for task in tasks if not is_made(task)]
        if not missing:
            return
        finished = in_workers(peel_task, missing, workers, PeelJob, (dataset.root, geometry))
        done = len(tasks) - len(missing)
        with _told_missing(missing, is_made, where=f"{root}: peel"):
            for _ in track(finished, label=f"peel {geometry}", total=len(tasks), done=done):
                pass


def _start_layers(
    dataset: Dataset, geometry: str, meshes_hash: str, *, num_layers: int, overwrite: bool, shard: Shard | None
) -> None:
    """Sees to it that a store of these settings stands there, without views or with some; the caller holds it."""
    if shard is not None:
        _start_beside_others(dataset, geometry, meshes_hash, num_layers=num_layers)
        return
    root = layers_root(dataset.root, geometry)
    is_started = not overwrite and _is_started(dataset, geometry, meshes_hash, num_layers=num_layers)
    if overwrite and is_ours(root, LAYERS):
        # Keeps views that verify under the new head, unless all are to be replaced.
        remove_files(root, [record_path_of_layers(Path(), *task).as_posix() for task in _tasks(dataset)])
    create_layers(dataset, geometry, num_layers=num_layers, geometry_hash=meshes_hash, replace=not is_started)


def _is_peeled(dataset: Dataset, geometry: str, task: Task) -> bool:
    try:
        return dataset.layer_store(geometry).is_peeled(*task)
    except HyalineError:
        return False


@contextlib.contextmanager
def _told_missing(tasks: list[Task], is_made: Callable[[Task], bool], *, where: str) -> Iterator[None]:
    """Adds to the error of a killed worker which of its tasks are not done, and the command that goes on."""
    try:
        yield
    except WorkerKilledError as error:
        left = [task for task in tasks if not is_made(task)]
        raise WorkerKilledError(
            f"{where}: {error}; {len(left)} views are missing ({describe_views(left)}); go on with `{this_command()}`"
        ) from None


def summary(dataset: Dataset, geometry: str) -> list[str]:
    """What was made, in a few lines: noise ceilings, rays that were cut off."""
    splits: list[Split] = [split for split in dataset.splits if dataset.config.split(split).views]
    lines = [f"noise ceiling {split}: {_decibels(dataset.noise_ceiling_db(split))}" for split in splits]
    store, most = dataset.layer_store(geometry), 0.0
    for split in splits:
        shares = [store.record(split, view).overflow_share for view in range(dataset.config.split(split).views)]
        share = 100 * float(np.mean(shares))
        lines.append(f"rays with more than {store.head.num_layers} hits {split}: {share:.2f} %")
        most = max(most, share)
    if most > MANY_PERCENT:
        words = ["datagen", "peel", str(dataset.root), *(["--geometry", geometry] if geometry != TRUTH else [])]
        more = shlex.join([*words, "--num-layers", str(2 * store.head.num_layers), "--overwrite"])
        lines.append(f"deeper surfaces are not stored in straight layers; `{more}` stores more")
    return lines


def _decibels(value: float | None) -> str:
    if value is not None and value > MOST_DECIBELS:
        return "none measured: the pictures have no noise"
    return "unknown" if value is None else f"{value:.1f} dB"


# Starting and going on


def refuse_unlit(dataset: Dataset, *, what: str) -> None:
    """Refuses what needs the light of a scene.

    Raises:
        HyalineError: the pictures were imported, or the scene is a hidden one, so that it is unknown.
    """
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

    Raises:
        HyalineError: another dataset, or something else, stands there.
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
    if dataset.imported != imported:
        raise HyalineError(
            f"{root}: holds {_origin(dataset.imported)}; pass --overwrite to replace it, or --out for another place"
        )
    if difference := config_difference(dataset.config, config):
        raise HyalineError(
            f"{root}: holds a dataset with another configuration ({difference}); "
            "pass --overwrite to replace it, or --out for another place"
        )
    # A rig's cameras are computed, and may differ in their last bits on another machine.
    is_listed = imported is not None or (scene is not None and isinstance(scene.cameras, CameraList))
    contents = head_contents(files, cameras if is_listed else {})
    changed = [path for path, data in contents.items() if dataset.files.get(path) != sha256(data)]
    if changed:
        raise HyalineError(
            f"{root}: holds a dataset of another version of scene {config.scene} ({changed[0]} differs); "
            "pass --overwrite to replace it, or --out for another place"
        )
    return dataset


def _origin(imported: Imported | None) -> str:
    if imported is None:
        return "a dataset that was rendered here"
    return f"a dataset that was imported from {imported.source}, of other files or with other choices"


def _is_started(dataset: Dataset, geometry: str, meshes_hash: str, *, num_layers: int) -> bool:
    """True when a store of these settings stands there; of other ones it is an error."""
    root = layers_root(dataset.root, geometry)
    if not (root / "layers.json").is_file():
        return False
    try:
        head = dataset.layer_store(geometry).head
    except DamagedError as error:
        say(f"{error}; making it again")
        return False
    if head.num_layers != num_layers:
        raise HyalineError(
            f"{root}: was peeled into {head.num_layers} layers, not {num_layers}; pass --overwrite, or "
            f"--num-layers {head.num_layers}"
        )
    if head.geometry != meshes_hash:
        say(f"{root}: the geometry has changed since it was peeled; peeling it again")
    return head.geometry == meshes_hash


def _start_beside_others(dataset: Dataset, geometry: str, meshes_hash: str, *, num_layers: int) -> None:
    """Starts a store that other processes may be starting too; what stands there is never deleted.

    Raises:
        HyalineError: a store of another geometry stands there, or another process has started one of other settings.
    """
    root = layers_root(dataset.root, geometry)
    create_layers(dataset, geometry, num_layers=num_layers, geometry_hash=meshes_hash)
    if not _is_started(dataset, geometry, meshes_hash, num_layers=num_layers):
        raise HyalineError(f"{root}: holds layers of another geometry; build without --shard, which replaces them")


def _tasks(dataset: Dataset) -> list[Task]:
    """All views, the splits interleaved: test views take longer, and so the time left is estimated well."""
    views = {split: dataset.config.split(split).views for split in dataset.splits}
    tasks: list[Task] = [(split, view) for split in dataset.splits for view in range(views[split])]
    return sorted(tasks, key=lambda task: (task[1] + 0.5) / views[task[0]])
