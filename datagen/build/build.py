"""Making a dataset: for every view render, commit, peel, commit; goes on where it was stopped."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from datagen.build.jobs import PeelJob, RenderJob, Task, TraceJob, peel_task, render_task, trace_task
from datagen.build.shards import Shard, own_tasks
from datagen.data.cameras import Cameras
from datagen.data.clear import clear_dataset
from datagen.data.config import SPLITS, DatasetConfig, Split, config_difference, describe_views
from datagen.data.dataset import Dataset, DatasetObject, head_files
from datagen.data.dataset_head import dataset_files, head_contents, view_files, write_head
from datagen.data.geometries import geometry_hash
from datagen.data.layer_store import (
    Head,
    LayersHead,
    LightPathsHead,
    record_path_of_layers,
)
from datagen.data.layer_writing import check_settings, create_layers
from datagen.data.paths import TRUTH, LayerKind, layers_root
from datagen.disk.errors import DamagedError, HyalineError, WorkerKilledError
from datagen.disk.ownership import DATASET, LAYERS, holding, is_ours, refuse_taken, remove_files
from datagen.disk.promises import check_files
from datagen.disk.storage import sha256
from datagen.machine.workers import in_workers
from datagen.scene.description import Scene
from datagen.scene.folder import scene_files
from datagen.scene.rig import make_cameras
from datagen.terminal.command import say, this_command, track
from datagen.trace.light_path_layers import NUM_BRANCHES, create_light_paths


def build_dataset(
    scene: Scene,
    root: Path,
    config: DatasetConfig,
    *,
    kinds: tuple[LayerKind, ...],
    num_layers: int,
    workers: int,
    overwrite: bool,
    rays: int = 4,
    shard: Shard | None = None,
) -> Dataset:
    """Renders and peels every view that is not there yet, or those of one part.

    The bytes depend on scene and configuration alone: not on workers, threads, order, parts, or how often it was
    stopped. `kinds`, `num_layers` and `rays` are those of `peel_dataset`.

    Raises:
        HyalineError: something else stands at `root`, or another process writes there.
    """
    check_settings(num_layers=num_layers, rays=rays, workers=workers, kinds=kinds)
    if config.train.views < 1:
        raise HyalineError(f"views: are {config.train.views}; expected at least 1 training view")
    with holding(root, DATASET, shared=shard is not None):
        cameras = make_cameras(scene.cameras, config)
        dataset = open_or_start(scene, root, config, cameras, overwrite=overwrite)
        meshes_hash = geometry_hash(dataset, TRUTH)
        for kind in kinds:
            # Now, so that a dataset that is stopped while it renders says which layers it is to have.
            with holding(layers_root(root, TRUTH, kind), LAYERS, within=root, shared=shard is not None):
                _start_layers(
                    dataset, TRUTH, kind, meshes_hash, num_layers=num_layers, rays=rays, overwrite=False, shard=shard
                )
        if shard is None and not dataset.view("train", 0).is_built:
            _say_slits(scene, cameras)
        render_dataset(dataset, workers=workers, shard=shard)
    peel_dataset(
        dataset, TRUTH, kinds=kinds, num_layers=num_layers, rays=rays, overwrite=False, workers=workers, shard=shard
    )
    return dataset


def _say_slits(scene: Scene, cameras: dict[Split, Cameras]) -> None:
    """A remark on each slit through which the sky shines: it may be meant, and pictures of it are right."""
    from datagen.machine.mitsuba_variant import use_mitsuba
    from datagen.trace.slits import describe_slit, find_slits

    use_mitsuba(quiet=True)
    for slit in find_slits(scene, tuple(cameras.values())):
        say(describe_slit(scene, slit))


def render_dataset(dataset: Dataset, *, workers: int, shard: Shard | None = None) -> None:
    """Renders every view, or those of a part, that is not there yet; the caller holds the dataset's folder."""
    tasks = own_tasks(shard, _tasks(dataset))
    missing = [task for task in tasks if not dataset.view(*task).is_built]
    if not missing:
        return
    from datagen.machine.mitsuba_variant import use_mitsuba

    say(f"{dataset.root}: renders {len(missing)} of {len(tasks)} views with {use_mitsuba()}")
    finished = in_workers(render_task, missing, workers, RenderJob, (dataset.root,))
    with _told_missing(missing, lambda task: dataset.view(*task).is_built, where=f"{dataset.root}: render"):
        for _ in track(finished, label="render", total=len(tasks), done=len(tasks) - len(missing)):
            pass


def peel_dataset(
    dataset: Dataset,
    geometry: str,
    *,
    kinds: tuple[LayerKind, ...],
    num_layers: int,
    overwrite: bool,
    rays: int = 4,
    workers: int = 1,
    shard: Shard | None = None,
) -> None:
    """Peels every view of a geometry, or those of one part, that is not peeled yet.

    Args:
        num_layers: straight layers kept of each ray, vertices kept of each branch of a light path.
        rays: light paths of each pixel, a square number.

    Raises:
        HyalineError: the geometry does not exist, or was peeled with other settings.
    """
    check_settings(num_layers=num_layers, rays=rays, workers=workers, kinds=kinds)
    meshes_hash = geometry_hash(dataset, geometry)
    for kind in kinds:
        root = layers_root(dataset.root, geometry, kind)
        with holding(root, LAYERS, within=dataset.root, shared=shard is not None):
            _start_layers(
                dataset, geometry, kind, meshes_hash, num_layers=num_layers, rays=rays, overwrite=overwrite, shard=shard
            )
            tasks = own_tasks(shard, _tasks(dataset))
            missing = [task for task in tasks if not _is_peeled(dataset, geometry, kind, task)]
            if missing and kind == "light-path":
                _require_vectorised()
            if missing:
                arguments = (dataset.root, geometry)
                if kind == "straight":
                    finished = in_workers(peel_task, missing, workers, PeelJob, arguments)
                else:
                    finished = in_workers(trace_task, missing, workers, TraceJob, arguments)
                is_made = functools.partial(_is_peeled, dataset, geometry, kind)
                done = len(tasks) - len(missing)
                with _told_missing(missing, is_made, where=f"{root}: peel"):
                    for _ in track(finished, label=f"peel {geometry} {kind}", total=len(tasks), done=done):
                        pass


def _start_layers(
    dataset: Dataset,
    geometry: str,
    kind: LayerKind,
    meshes_hash: str,
    *,
    num_layers: int,
    rays: int,
    overwrite: bool,
    shard: Shard | None,
) -> None:
    """Sees to it that a store of these settings stands there, without views or with some; the caller holds it."""
    root = layers_root(dataset.root, geometry, kind)
    is_started = not overwrite and _is_started(dataset, geometry, kind, meshes_hash, num_layers=num_layers, rays=rays)
    if not is_started and kind == "light-path":
        _require_vectorised()
    if shard is None:
        if overwrite and is_ours(root, LAYERS):
            # Views that verify under the new head are kept, unless all are asked for anew.
            remove_files(root, [record_path_of_layers(Path(), *task).as_posix() for task in _tasks(dataset)])
        _start(dataset, geometry, kind, meshes_hash, num_layers=num_layers, rays=rays, replace=not is_started)
    elif not is_started:
        _start_beside_others(dataset, geometry, kind, meshes_hash, num_layers=num_layers, rays=rays)


def _is_peeled(dataset: Dataset, geometry: str, kind: LayerKind, task: Task) -> bool:
    try:
        return dataset.layer_store(geometry, kind).is_peeled(*task)
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


def summary(dataset: Dataset, geometry: str, kinds: tuple[LayerKind, ...]) -> list[str]:
    """What was made, in a few lines: noise ceilings, rays that were cut off."""
    splits: list[Split] = [split for split in dataset.splits if dataset.config.split(split).views]
    lines = [f"noise ceiling {split}: {dataset.noise_ceiling_db(split):.1f} dB" for split in splits]
    for kind in kinds:
        head = dataset.layer_store(geometry, kind).head
        match head:
            case LayersHead():
                what = f"rays with more than {head.num_layers} hits"
            case LightPathsHead():
                what = f"rays with a branch given up after {head.max_depth} surfaces"
        for split in splits:
            views = range(dataset.config.split(split).views)
            shares = [dataset.layer_store(geometry, kind).record(split, view).overflow_share for view in views]
            lines.append(f"{what} {split}: {100 * float(np.mean(shares)):.2f} %")
    return lines


# Starting and going on


def open_or_start(
    scene: Scene, root: Path, config: DatasetConfig, cameras: dict[Split, Cameras], *, overwrite: bool
) -> Dataset:
    """The dataset at `root`, its head complete, or a new one without views; the caller holds the folder.

    Raises:
        HyalineError: another dataset, or something else, stands there.
    """
    files = scene_files(scene)
    objects = tuple(DatasetObject(name=item.name, is_glass=item.material.is_glass) for item in scene.objects)
    if overwrite and is_ours(root, DATASET):
        wanted = [*view_files(config, SPLITS), *head_contents(files, cameras)]
        refuse_taken(root, DATASET, wanted, dataset_files(root))
        clear_dataset(root)
    # Another process may have been there first, with other settings.
    dataset = write_head(root, config, objects, cameras, files, replace=overwrite)
    if difference := config_difference(dataset.config, config):
        raise HyalineError(
            f"{root}: holds a dataset with another configuration ({difference}); "
            "pass --overwrite to replace it, or --out for another place"
        )
    promised = head_files(root)
    changed = [path for path, data in files.items() if promised.get(f"scene/{path}") != sha256(data)]
    if changed:
        raise HyalineError(
            f"{root}: holds a dataset of another version of scene {scene.name} ({changed[0]} differs); "
            "pass --overwrite to replace it, or --out for another place"
        )
    return dataset


def _is_started(
    dataset: Dataset, geometry: str, kind: LayerKind, meshes_hash: str, *, num_layers: int, rays: int
) -> bool:
    """True when a store of these settings stands there; of other ones it is an error."""
    root = layers_root(dataset.root, geometry, kind)
    if not (root / "layers.json").is_file():
        return False
    try:
        head = dataset.layer_store(geometry, kind).head
    except DamagedError as error:
        say(f"{error}; makes it again")
        return False
    if difference := _settings_difference(head, num_layers=num_layers, rays=rays):
        raise HyalineError(f"{root}: was {difference}")
    if head.geometry != meshes_hash:
        say(f"{root}: the geometry has changed since it was peeled; peels it again")
    return head.geometry == meshes_hash


def _start(
    dataset: Dataset,
    geometry: str,
    kind: LayerKind,
    meshes_hash: str,
    *,
    num_layers: int,
    rays: int,
    replace: bool = False,
) -> None:
    if kind == "straight":
        create_layers(dataset, geometry, num_layers=num_layers, geometry_hash=meshes_hash, replace=replace)
    else:
        create_light_paths(
            dataset,
            geometry,
            num_branches=NUM_BRANCHES,
            max_vertices=num_layers,
            samples=rays,
            geometry_hash=meshes_hash,
            replace=replace,
        )


def _start_beside_others(
    dataset: Dataset, geometry: str, kind: LayerKind, meshes_hash: str, *, num_layers: int, rays: int
) -> None:
    """Starts a store that other processes may be starting too; what stands there is never deleted.

    Raises:
        HyalineError: a store of another geometry stands there, or another process has started one of other settings.
    """
    root = layers_root(dataset.root, geometry, kind)
    _start(dataset, geometry, kind, meshes_hash, num_layers=num_layers, rays=rays)
    if not _is_started(dataset, geometry, kind, meshes_hash, num_layers=num_layers, rays=rays):
        raise HyalineError(f"{root}: holds layers of another geometry; build without --shard, which replaces them")
    check_files(root, dataset.layer_store(geometry, kind).head.files)


def _require_vectorised() -> None:
    """Says here what workers would say later, when an empty store has replaced what was there."""
    from datagen.machine.mitsuba_variant import use_mitsuba

    if use_mitsuba(quiet=True).startswith("scalar"):
        raise HyalineError(
            "light paths: Mitsuba runs as scalar_rgb, which cannot trace them; "
            "`datagen doctor` names the libLLVM to install"
        )


def _settings_difference(head: Head, *, num_layers: int, rays: int) -> str | None:
    """How a store was made that was not made as asked, and the way out."""
    match head:
        case LayersHead(num_layers=stored) if stored != num_layers:
            return f"peeled into {stored} layers, not {num_layers}; pass --overwrite, or --num-layers {stored}"
        case LightPathsHead(max_vertices=stored) if stored != num_layers:
            return f"traced to {stored} vertices, not {num_layers}; pass --overwrite, or --num-layers {stored}"
        case LightPathsHead(samples=stored) if stored != rays:
            return f"traced with {stored} rays a pixel, not {rays}; pass --overwrite, or --rays {stored}"
        case LightPathsHead(num_branches=stored) if stored != NUM_BRANCHES:
            return f"traced in {stored} branches, which are now {NUM_BRANCHES}; pass --overwrite"
    return None


def _tasks(dataset: Dataset) -> list[Task]:
    """All views, the splits interleaved: test views take longer, and so the time left is estimated well."""
    views = {split: dataset.config.split(split).views for split in dataset.splits}
    tasks: list[Task] = [(split, view) for split in dataset.splits for view in range(views[split])]
    return sorted(tasks, key=lambda task: (task[1] + 0.5) / views[task[0]])
