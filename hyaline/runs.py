"""Trained runs, opened to render what any camera sees."""

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, UInt8

from datagen.data.cameras import Camera, check_camera
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.paths import find_dataset
from datagen.disk.errors import HyalineError, NumericsError
from datagen.disk.names import real_path
from datagen.terminal.distribution import naming_parts
from model.methods.protocol import Inputs
from model.run.run_folder import RUN, WEIGHTS, RunRecord, TrainConfig, check_trained_on, read_metrics, read_run
from model.settings.run_flags import RUNS, Device

if TYPE_CHECKING:
    from model.batches.rays import PixelSource
    from model.methods.renderer import Renderer


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A trained run and the dataset that it was trained on; `open_run` makes it.

    Its weights are read, and PyTorch and Mitsuba imported, when the first picture is rendered.
    """

    folder: Path
    record: RunRecord
    """What run.json says: the configuration, the dataset's and the layers' digests, numbers of parameters."""
    dataset: Dataset
    inputs: Inputs
    """What the method is given of the dataset."""
    device: Device
    """Where networks compute."""

    @property
    def method(self) -> str:
        return self.record.method

    @property
    def label(self) -> str:
        """How tables call the run."""
        return self.record.label

    @property
    def geometry(self) -> str:
        """`truth`, or the kind of proxy whose surfaces it was trained on."""
        return self.record.geometry

    @property
    def config(self) -> TrainConfig:
        """Everything that was chosen; `config.net` is the method's own record."""
        return self.record.config

    @property
    def metrics(self) -> list[dict[str, float | None]]:
        """One entry an evaluation: step, loss, and held_out_psnr in dB (None without held-out views)."""
        return read_metrics(self.folder)

    @property
    def last_step(self) -> int:
        """Steps that its weights have made; of a run that is still training, those at its last evaluation."""
        if (self.folder / WEIGHTS).is_file():
            return self.config.steps
        return max((int(line.get("step") or 0) for line in self.metrics), default=0)

    @property
    def has_radiance(self) -> bool:
        """True when the method predicts linear radiance."""
        return self.config.net.has_radiance

    @naming_parts("hyaline.Run.render")
    def render(self, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
        """The 8-bit sRGB picture that a camera takes; through a view's camera it is the run's own prediction.

        Raises:
            HyalineError: no camera, a size that the method cannot draw, or no weights yet.
        """
        from model.run.predict import predict_pixels

        pixels = self._pixels(camera)
        return predict_pixels(self._renderer, pixels).reshape(camera.height, camera.width, 3)

    @naming_parts("hyaline.Run.radiance")
    def radiance(self, camera: Camera) -> Float32[np.ndarray, "h w 3"]:
        """Linear radiance (Rec. 709), unclipped. Training pictures end at white: of what is brighter, a run knows only
        that it is.

        Raises:
            HyalineError: as `render`, or the method predicts display-referred colours (`has_radiance` is False).
        """
        if not self.has_radiance:
            raise HyalineError(
                f"{self.folder}: {self.method} predicts display-referred colours, not radiance; use render"
            )
        from model.batches.rays import linear_curve
        from model.run.predict import predict_colors

        colors = predict_colors(self._renderer, self._pixels(camera))
        if not bool(colors.isfinite().all()):
            raise NumericsError(f"{self.folder}: a predicted colour is not finite; train anew with --overwrite")
        return linear_curve(colors).cpu().numpy().reshape(camera.height, camera.width, 3)

    @cached_property
    def _renderer(self) -> "Renderer":
        from model.run.predict import load_renderer
        from model.settings.runtime import choose_device

        return load_renderer(self.folder, self.config, self.dataset).to(choose_device(self.device))

    def _pixels(self, camera: Camera) -> "PixelSource":
        from model.run.predict import check_draws_cameras
        from model.settings.runtime import choose_device

        check_camera(camera)
        check_draws_cameras(self.folder, self.config)
        return self.config.net.load_cameras(self.inputs, camera.alone).to(choose_device(self.device))


def list_runs(root: Path | str = RUNS) -> list[str]:
    """The names of the runs in a folder, sorted; `runs` in the working folder unless given.

    >>> list_runs()
    ['glass_table/paper']
    """
    return sorted(path.parent.relative_to(root).as_posix() for path in Path(root).glob(f"*/*/{RUN}"))


def open_run(
    name: Path | str, root: Path | str = RUNS, *, dataset: Dataset | Path | str | None = None, device: Device = "auto"
) -> Run:
    """A run of `model train`, ready to render what any camera sees.

    >>> run = open_run("glass_table/paper")              # runs/glass_table/paper, or a folder
    >>> run.method, run.last_step, run.dataset.name
    ('paper', 3, 'glass_table')
    >>> view = run.dataset.view("interpolating", 0)
    >>> picture = run.render(view.camera)                # (h, w, 3) uint8: the run's own prediction of this view
    >>> picture.shape
    (32, 32, 3)
    >>> import dataclasses
    >>> from hyaline import look_at
    >>> matrix = look_at((1.0, 1.5, 1.2), (0.0, 0.0, 0.2))     # from a place, to a place, in metres
    >>> run.render(dataclasses.replace(view.camera, world_from_camera=matrix, width=48, height=20)).shape
    (20, 48, 3)

    Args:
        name: SCENE/NAME under `root`, or a folder.
        dataset: the dataset, or its name or folder; where the run found it unless given.
        device: where networks compute: auto (a GPU where there is one), cpu or cuda.

    Raises:
        HyalineError: no run, one of a method from elsewhere, or a dataset other than the one it was trained on.
    """
    folder = _find_run(str(name), Path(root))
    record = read_run(folder)
    opened = dataset if isinstance(dataset, Dataset) else open_dataset(_place_of(record, folder, dataset))
    return Run(
        folder=folder,
        record=record,
        dataset=opened,
        inputs=check_trained_on(folder, record.config, opened),
        device=device,
    )


def _find_run(name: str, root: Path) -> Path:
    """The folder of a run."""
    folder = next((place for place in (Path(name), root / name) if place.is_dir()), None)
    if folder is None:
        known = f"known are {', '.join(list_runs(root))}" if list_runs(root) else "make one with `model train paper`"
        raise HyalineError(f"{name}: no run there, nor in {root}; {known}")
    return folder


def _place_of(record: RunRecord, folder: Path, given: Path | str | None) -> Path:
    """Where a run's dataset is: as given, as the run names it, or beside the folder of all runs."""
    if given is not None:
        return find_dataset(str(given))
    named = Path(record.dataset)
    places = (named, Path(os.path.normpath(real_path(folder) / "../../..")) / named)
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        raise HyalineError(f"{folder}: its dataset {named} is not there; say where it is with dataset=")
    return found
