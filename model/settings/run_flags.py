"""The flags of every run, whatever its method."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.data.paths import TRUTH
from model.settings.flags import SEED, check_limits, choice

Device = Literal["auto", "cpu", "cuda"]

RUNS = Path("runs")
"""Default folder of the runs, as RUNS/SCENE/NAME."""


@dataclass(frozen=True, kw_only=True)
class RunFlags:
    """What a run trains on, where it is stored, and where it is computed."""

    geometry: str = choice(TRUTH)
    """Whose layers to look up: truth, or a kind of proxy such as box."""
    out: Path | None = choice(None)
    """Folder of the run. Default: runs/SCENE/METHOD, with a suffix for each choice that is not the default."""
    label: str | None = choice(None)
    """Label of the run on its page and in the list of runs (`report --full`); tables of scores have the folder's name,
    the default."""
    seed: int = choice(0, "seed{}", limits=SEED)
    """Seed of all random numbers."""
    device: Device = choice("auto")
    """Where to compute; auto uses a GPU if there is one."""
    snapshots: bool = choice(True)
    """Write a small picture of the held-out views, below the truth, at each evaluation, to the run's folder
    snapshots."""
    tensorboard: bool = choice(False)
    """Write event files for TensorBoard to the run's folder tensorboard: loss, held-out PSNR and pictures. Needs the
    extra tensorboard."""
    costs: bool = choice(False)
    """Write costs.json to the run's folder: the wall time, CPU time and memory of training, shown on the run's page of
    the report. These are the only numbers that differ between identical trainings."""
    overwrite: bool = choice(False)
    """Delete the existing run and start over."""

    def __post_init__(self) -> None:
        check_limits(self)
