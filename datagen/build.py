"""Owns the making of a dataset: for every view render, commit, peel, commit; goes on where it was stopped."""

import shutil
from pathlib import Path

import numpy as np

from datagen.cameras import make_cameras
from datagen.command import say, track
from datagen.dataset import (
    SPLITS,
    TEST_SPLITS,
    Cameras,
    Dataset,
    DatasetConfig,
    DatasetObject,
    Split,
    commit_view,
    config_difference,
    head_files,
    is_view_built,
    noise_ceiling_db,
    open_dataset,
    read_cameras,
    write_head,
)
from datagen.errors import HyalineError
from datagen.geometry import TRUTH, read_meshes
from datagen.layers import (
    LayerKind,
    create_store,
    is_view_peeled,
    layers_root,
    read_layers_head,
    read_layers_record,
    write_layers,
)
from datagen.meshes import write_ply
from datagen.scene import Scene, is_glass, load_scene, scene_files
from datagen.storage import commit, one_writer, remove_temporaries, sha256
from datagen.workers import in_workers

Task = tuple[Split, int]


def build_dataset(scene: Scene, root: Path, config: DatasetConfig, *, kinds: tuple[LayerKind, ...], num_layers: int,
                  workers: int, overwrite: bool) -> Dataset:  # fmt: skip
    """Renders and peels every view that is not there yet.

    The bytes depend on scene and configuration alone: not on workers, threads, order, or how often it was stopped.

    Raises:
        HyalineError: something else stands at `root`, or another process writes there.
    """
    with one_writer(root):
        remove_temporaries(root)
        dataset = _open_or_start(scene, root, config, overwrite=overwrite)
        tasks = _tasks(dataset)
        missing = [task for task in tasks if not is_view_built(dataset, *task)]
        done = len(tasks) - len(missing)
        if missing:
            from datagen.variant import use_mitsuba

            say(f"{root}: renders {len(missing)} of {len(tasks)} views with {use_mitsuba()}")
            finished = in_workers(_render_task, missing, workers, _RenderJob, (root,))
            for _ in track(finished, label="render", total=len(tasks), done=done):
                pass
    peel_dataset(dataset, TRUTH, kinds=kinds, num_layers=num_layers, overwrite=False, workers=workers)
    return dataset


def peel_dataset(dataset: Dataset, geometry: str, *, kinds: tuple[LayerKind, ...], num_layers: int, overwrite: bool,
                 workers: int = 1) -> None:  # fmt: skip
    """Peels every view of a geometry that is not peeled yet.

    Raises:
        HyalineError: the geometry does not exist, or was peeled with other settings.
    """
    if not 1 <= num_layers <= 255:
        raise HyalineError(f"num_layers: is {num_layers}; expected 1 to 255")
    for kind in kinds:
        root = layers_root(dataset.root, geometry, kind)
        meshes_hash = _geometry_hash(dataset, geometry)
        with one_writer(root):
            remove_temporaries(root)
            _open_or_start_layers(
                dataset, geometry, kind, num_layers=num_layers, meshes_hash=meshes_hash, overwrite=overwrite
            )
            tasks = _tasks(dataset)
            missing = [task for task in tasks if not is_view_peeled(dataset, geometry, kind, *task)]
            if missing:
                arguments = (dataset.root, geometry, kind, num_layers)
                finished = in_workers(_peel_task, missing, workers, _PeelJob, arguments)
                done = len(tasks) - len(missing)
                for _ in track(finished, label=f"peel {geometry}", total=len(tasks), done=done):
                    pass


def summary(dataset: Dataset, geometry: str, kind: LayerKind) -> str:
    """What was made, in a few lines: noise ceilings and rays with more hits than layers."""
    lines = [f"noise ceiling {split}: {noise_ceiling_db(dataset, split):.1f} dB" for split in ("train", *TEST_SPLITS)]
    head, _ = read_layers_head(dataset, geometry, kind)
    for split in SPLITS:
        views = range(dataset.config.split(split).views)
        shares = [read_layers_record(dataset, geometry, kind, split, view).overflow_share for view in views]
        lines.append(f"rays with more than {head.num_layers} hits {split}: {100 * float(np.mean(shares)):.2f} %")
    return "\n".join(lines)


# Starting and going on


def _open_or_start(scene: Scene, root: Path, config: DatasetConfig, *, overwrite: bool) -> Dataset:
    files = scene_files(scene)
    if (root / "dataset.json").is_file() and not overwrite:
        dataset = open_dataset(root)
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
        # A file of the head that was lost or damaged is written anew: its content is known.
        _write_scene(root, files)
        return dataset
    _clear(root, overwrite=overwrite)
    _write_scene(root, files)
    objects = tuple(DatasetObject(name=item.name, is_glass=is_glass(item.material)) for item in scene.objects)
    relative = tuple(Path("scene") / path for path in files)
    return write_head(root, config, objects, make_cameras(scene.cameras, config), relative)


def _clear(root: Path, *, overwrite: bool) -> None:
    """Makes room for a new dataset; never deletes what is not one."""
    if (root / "dataset.json").is_file():
        # The head goes first: what is left without it is garbage, and the next run clears it.
        (root / "dataset.json").unlink()
    ours = ("scene", "images", "records", "layers", "proxies")
    foreign = [path for path in root.iterdir() if path.name not in ours and not path.name.startswith("transforms_")]
    if foreign and not overwrite:
        raise HyalineError(f"{root}: is not empty ({foreign[0].name}) and no dataset; choose another --out")
    for name in ours:
        shutil.rmtree(root / name, ignore_errors=True)


def _write_scene(root: Path, files: dict[str, bytes]) -> None:
    for path, data in files.items():
        place = root / "scene" / path
        if not place.is_file() or place.read_bytes() != data:
            commit(place, data)


def _open_or_start_layers(dataset: Dataset, geometry: str, kind: LayerKind, *, num_layers: int, meshes_hash: str,
                          overwrite: bool) -> None:  # fmt: skip
    root = layers_root(dataset.root, geometry, kind)
    if (root / "layers.json").is_file() and not overwrite:
        head, _ = read_layers_head(dataset, geometry, kind)
        if head.num_layers != num_layers:
            raise HyalineError(
                f"{root}: was peeled into {head.num_layers} layers, not {num_layers}; "
                f"pass --overwrite, or --num-layers {head.num_layers}"
            )
        if head.geometry == meshes_hash:
            return
        say(f"{root}: the geometry has changed since it was peeled; peels it again")
    shutil.rmtree(root, ignore_errors=True)
    create_store(dataset, geometry, kind, num_layers=num_layers, geometry_hash=meshes_hash)


def _geometry_hash(dataset: Dataset, geometry: str) -> str:
    return sha256(b"".join(write_ply(mesh) for mesh in read_meshes(dataset, geometry)))


def _tasks(dataset: Dataset) -> list[Task]:
    """All views, the splits interleaved: test views take longer, and so the time left is estimated well."""
    views = {split: dataset.config.split(split).views for split in SPLITS}
    tasks: list[Task] = [(split, view) for split in SPLITS for view in range(views[split])]
    return sorted(tasks, key=lambda task: (task[1] + 0.5) / views[task[0]])


# One view


class _RenderJob:
    """What a worker keeps between the views that it renders."""

    def __init__(self, threads: int, root: Path) -> None:
        from datagen.render import Renderer
        from datagen.variant import use_mitsuba

        self.variant = use_mitsuba(quiet=True, threads=threads)
        self.dataset = open_dataset(root)
        self.cameras = _all_cameras(self.dataset)
        self.renderer = Renderer(load_scene(root / "scene"), max_depth=self.dataset.config.max_depth)


def _render_task(job: _RenderJob, task: Task) -> None:
    from datagen.render import picture_bytes, radiance_bytes, render_view, view_seed

    split, view = task
    config = job.dataset.config
    seed = view_seed(config.seed, split, view)
    truth = render_view(
        job.renderer,
        job.cameras[split],
        view,
        spp=config.split(split).spp,
        view_seed=seed,
        ceiling_db=config.ceiling_db if split in TEST_SPLITS else None,
    )
    commit_view(
        job.dataset,
        split,
        view,
        png=picture_bytes(truth),
        exr=radiance_bytes(truth),
        seed=seed,
        spp=truth.spp,
        noise_mse=truth.noise_mse,
        variant=job.variant,
    )


class _PeelJob:
    """What a worker keeps between the views that it peels."""

    def __init__(self, threads: int, root: Path, geometry: str, kind: LayerKind, num_layers: int) -> None:
        from datagen.peel import Peeler
        from datagen.variant import use_mitsuba

        use_mitsuba(quiet=True, threads=threads)
        self.dataset = open_dataset(root)
        self.cameras = _all_cameras(self.dataset)
        self.peeler = Peeler(read_meshes(self.dataset, geometry))
        self.geometry, self.num_layers = geometry, num_layers
        self.kind: LayerKind = kind


def _peel_task(job: _PeelJob, task: Task) -> None:
    split, view = task
    layers, overflow_share = job.peeler.peel(job.cameras[split], view, job.num_layers)
    write_layers(job.dataset, job.geometry, job.kind, split, view, layers, overflow_share=overflow_share)


def _all_cameras(dataset: Dataset) -> dict[Split, Cameras]:
    return {split: read_cameras(dataset, split) for split in SPLITS}
