"""The flags of `datagen build`, `datagen add` and `datagen film`; presets and parts of a build."""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from datagen.data.config import DatasetConfig, SplitConfig, parse_resolution
from datagen.disk.errors import HyalineError, UsageError
from datagen.scene.finding import list_families
from datagen.terminal.command import choose

if TYPE_CHECKING:
    from datagen.scene.description import Scene

PresetName = Literal["tiny", "small", "demo", "standard", "paper", "labels"]
MAX_BASELINE = 10.0
LOCAL_MIN = 7 * 24 * 60
"""Time limit of jobs on this machine; submitit's own is two minutes."""


@dataclass(frozen=True, kw_only=True)
class BuildChoices:
    """Which dataset to build, and how."""

    preset: PresetName = "demo"
    """Size of the dataset."""
    out: Path | None = None
    """Folder to write; with --count, the folder for all datasets. Default: data/SCENE."""
    seed: int = 0
    """Seed for cameras, noise, and random scenes; the same seed gives the same bytes."""
    workers: int = 1
    """Parallel processes; the bytes do not depend on their number."""
    overwrite: bool = False
    """Replace an existing dataset that has other settings."""
    family: Annotated[str | None, list_families] = None
    """For random scenes: one object, a table (glassware among other objects), nested media, and others. Default: the
    seed cycles through the first three."""
    count: int | None = None
    """For random scenes: build this many datasets, with --seed and the seeds that follow. One that fails is reported
    and does not stop the others."""
    shard: str | None = None
    """Build part I of N of all views, such as 2/4. Parts may run at the same time on machines of one kind that share
    the folder; together they give the bytes of a single build. Without --shard, the rest of a failed part is built."""
    stereo: float | None = None
    """Also render every view from a second camera this many metres to its right, such as 0.06."""


@dataclass(frozen=True, kw_only=True)
class SizeChoices:
    """Single values that replace those of the preset."""

    resolution: str | int | None = None
    """Pixels: one number for square pictures, or width and height, such as 320x240."""
    views: int | None = None
    """Number of training views."""
    test_views: int | None = None
    """Number of views in each of the two test splits."""
    spp: int | None = None
    """Samples per pixel of training views."""
    test_spp: int | None = None
    """Samples per pixel of test views; with --ceiling, the number to start from."""
    ceiling: float | None = None
    """Render each test view until its noise ceiling reaches this many dB, instead of a fixed number of samples."""
    num_layers: int = 8
    """Layers stored per ray; the share of rays with more layers is reported."""
    max_depth: int = DatasetConfig.max_depth
    """Maximum number of segments in a light path. Fewer darken the rims of clear glass."""


@dataclass(frozen=True, kw_only=True)
class LaunchChoices:
    """Run in jobs on a Slurm cluster. Options of sbatch are read from its variables, such as SBATCH_PARTITION."""

    launcher: Literal["slurm", "local"] | None = None
    """slurm: submit Slurm jobs from a machine that shares the folder, wait for them, and report failures. local: run
    all jobs on this machine at once. Needs the extra `cluster`. Logs: DATASET-jobs/ or runs/jobs/."""
    slurm_time: int = 24 * 60
    """Time limit of each job in minutes; finished work is kept."""
    slurm_cpus: int = 4
    """CPUs of each job."""
    slurm_gpus: int = 0
    """GPUs of each job."""

    def __post_init__(self) -> None:
        changed = [item.name for item in dataclasses.fields(self) if getattr(self, item.name) != item.default]
        if self.launcher is None and changed:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
            raise UsageError(f"{flags}: need --launcher; give that, too, or leave them out")
        if min(self.slurm_time, self.slurm_cpus) < 1 or self.slurm_gpus < 0:
            raise UsageError("--slurm-time, --slurm-cpus: expected at least 1, and --slurm-gpus at least 0")

    def parameters(self) -> dict[str, object]:
        """What submitit asks the cluster for."""
        if self.launcher == "local":
            return {"timeout_min": LOCAL_MIN}
        return {
            "timeout_min": self.slurm_time,
            "cpus_per_task": self.slurm_cpus,
            # Since 22.05 srun does not take over sbatch's number, and would bind the command to a single CPU.
            "slurm_srun_args": [f"--cpus-per-task={self.slurm_cpus}"],
            **({"gpus_per_node": self.slurm_gpus} if self.slurm_gpus else {}),
        }


@dataclass(frozen=True, kw_only=True)
class ShardChoices(LaunchChoices):
    """Build in jobs, on a cluster or on this machine."""

    shards: int = 4
    """Number of jobs; each builds one part of all views, or with --count of all scenes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shards < 1:
            raise UsageError(f"--shards: is {self.shards}; expected at least 1")


@dataclass(frozen=True, kw_only=True)
class AddChoices:
    """What to add to a dataset."""

    edit: tuple[str, ...] = ()
    """Render the test views of the edited scene: remove:OBJECT, move:OBJECT:dx,dy,dz (metres),
    duplicate:OBJECT:dx,dy,dz, glass:OBJECT (turns an opaque object into glass, or glass opaque), swap:OBJECT:OBJECT,
    no-glass or opaque-glass. May be repeated: all edits change one scene, in this order."""
    twins: bool = False
    """Render the test views with all glass removed, and with it painted opaque."""
    angles: bool = False
    """Render test cameras 10, 20 and 40 degrees outside the directions of the training cameras."""
    larger: tuple[int, ...] = ()
    """Render the test views at N times their width and height, such as 2. May be repeated."""
    larger_views: int | None = None
    """With --larger: number of evenly spaced views of each test split. Default: all."""
    stereo: float | None = None
    """Render every view from a second camera this many metres to its right, such as 0.06: rectified stereo pairs."""
    workers: int = 1
    """Parallel processes; the bytes do not depend on their number."""
    overwrite: bool = False
    """Render again, even if present."""


@dataclass(frozen=True, kw_only=True)
class FilmChoices:
    """A film and its file."""

    path: Literal["orbit", "spline"] = "orbit"
    """The camera's path: around the scene, or through the interpolating test views."""
    out: Path | None = None
    """File to write: .webp, or .mp4 (extra `video`). Default: DATASET-truth.webp; of runs DATASET-RUN.webp."""
    frames: int = 48
    """Number of pictures."""
    fps: float = 24.0
    """Frames per second."""
    width: int | None = None
    """Width in pixels. Default: the dataset's."""
    height: int | None = None
    """Height in pixels. Default: from the width and the dataset's aspect ratio."""
    overwrite: bool = False
    """Replace an existing film."""


def _preset(name: str, size: str, train: tuple[int, int], test: tuple[int, int]) -> DatasetConfig:
    config = DatasetConfig.even("scene", parse_resolution(size), test[0], spp=test[1])
    return dataclasses.replace(config, preset=name, train=SplitConfig(views=train[0], spp=train[1]))


PRESETS: dict[str, DatasetConfig] = {
    "tiny": _preset("tiny", "32", train=(8, 16), test=(3, 64)),  # Tests: seconds.
    "small": _preset("small", "64", train=(60, 256), test=(8, 256)),  # Many scenes: two minutes on two cores.
    "demo": _preset("demo", "128", train=(100, 256), test=(12, 512)),  # A first look: minutes.
    "standard": _preset("standard", "256", train=(200, 64), test=(20, 512)),  # Comparing methods: half an hour.
    "paper": _preset("paper", "512", train=(1000, 64), test=(40, 512)),  # The paper's size: a night.
    "labels": _preset("labels", "640x480", train=(8, 32), test=(1, 32)),  # Noisy pictures, exact labels; many scenes.
}
"""Samples per pixel are powers of two, as Sobol's sequence likes."""


def configure(preset: str, size: SizeChoices, *, seed: int) -> DatasetConfig:
    """The configuration of a new dataset; `fit_to_scene` completes it when the scene is known."""
    usual = PRESETS[choose("preset", preset, PRESETS)]
    test = _given(usual.interpolating, views=size.test_views, spp=size.test_spp)
    return dataclasses.replace(
        usual,
        train=_given(usual.train, views=size.views, spp=size.spp),
        interpolating=test,
        extrapolating=test,
        resolution=usual.resolution if size.resolution is None else parse_resolution(str(size.resolution)),
        ceiling_db=size.ceiling,
        max_depth=size.max_depth,
        seed=seed,
    )


def _given(split: SplitConfig, **values: int | None) -> SplitConfig:
    return dataclasses.replace(split, **{name: value for name, value in values.items() if value is not None})


def fit_to_scene(config: DatasetConfig, scene: "Scene", size: SizeChoices) -> DatasetConfig:
    """The configuration with the scene's name; what `size` leaves open is as in the scene, if it lists its cameras."""
    from datagen.scene.rig import with_listed_shape, with_listed_views

    config = dataclasses.replace(config, scene=scene.name)
    if size.resolution is None:
        config = with_listed_shape(config, scene.cameras)
    has_views = size.views is not None or size.test_views is not None
    return config if has_views else with_listed_views(config, scene.cameras)


def check_baseline(metres: float | None) -> None:
    """Refuses a distance between the cameras of a pair that is probably in millimetres."""
    if metres is not None and not 0 < metres <= MAX_BASELINE:
        raise HyalineError(f"--stereo: is {metres:g}; expected more than 0 and at most {MAX_BASELINE:g} metres")


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One of `count` disjoint parts of the views of a dataset, which several machines may make at once.

    Machines meet in the folder alone, without a lock (flock often ends at the machine). So a part never deletes or
    replaces anything but by the same bytes. What a killed part left is cleared by a build without a part.
    """

    number: int
    """From 1 to `count`."""
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


def parse_shard(text: str) -> Shard:
    """The part that `--shard 2/4` names."""
    found = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise HyalineError(f"shard: is {text!r}; expected the part and the number of parts, such as 2/4")
    return Shard(number=int(found[1]), count=int(found[2]))
