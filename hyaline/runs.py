"""Runs: training methods, and opening runs to render from any camera."""

import os
import signal
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, UInt8

from datagen.data.cameras import Camera
from datagen.data.dataset import Dataset, View
from datagen.data.images import read_png
from datagen.data.paths import TRUTH, find_dataset, view_name
from datagen.disk.errors import HyalineError, NumericsError
from datagen.disk.records import checked
from datagen.disk.storage import real_path
from datagen.terminal.command import Stopped, choose
from datagen.terminal.parsing import flags_of
from datagen.terminal.plugins import naming_parts
from hyaline.datasets import open_dataset
from model.methods.protocol import Inputs, MethodConfig
from model.run import run_folder
from model.run.logs import read_metrics
from model.run.run_folder import WEIGHTS, RunRecord, TrainConfig, check_trained_on, find_run, read_run
from model.settings import RUNS, Device, RunFlags, with_settings

if TYPE_CHECKING:
    from model.batches.rays import PixelSource
    from model.methods.renderer import Renderer


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A trained run and the dataset that it was trained on; `open_run` makes it.

    Its weights are read, and PyTorch and Mitsuba imported, when the first picture is rendered.
    """

    folder: Path
    record: RunRecord = field(repr=False)
    """The content of run.json: the configuration, the dataset's and the layers' digests, numbers of parameters."""
    dataset: Dataset
    """The dataset that it was trained on."""
    inputs: Inputs = field(repr=False)
    """The parts of the dataset that the method may use."""
    device: Device
    """Where networks compute."""

    @property
    def method(self) -> str:
        return self.record.method

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
        """One entry an evaluation: step, loss, and held_out_psnr and train_psnr in dB, of a quarter of the pixels of
        held-out views and of as many training views (None and missing without such views)."""
        return read_metrics(self.folder)

    @property
    def last_step(self) -> int:
        """Number of steps trained; while it is still training, the number at the last evaluation."""
        if (self.folder / WEIGHTS).is_file():
            return self.config.steps
        return max((int(line.get("step") or 0) for line in self.metrics), default=0)

    @checked
    @naming_parts("hyaline.Run.render")
    def render(self, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
        """The 8-bit sRGB picture for a camera; for a view's camera, exactly the run's own prediction.

        Raises:
            HyalineError: an invalid camera, a size that the method cannot draw, or no weights yet.
        """
        from model.run.predict import predict_pixels

        pixels = self._pixels(camera)
        return predict_pixels(self._renderer, pixels).reshape(camera.height, camera.width, 3)

    @checked
    @naming_parts("hyaline.Run.radiance")
    def radiance(self, camera: Camera) -> Float32[np.ndarray, "h w 3"]:
        """Linear radiance (Rec. 709), unclipped. Training images are clipped at white, so values above it are guesses.

        Raises:
            HyalineError: as `render`, or the method predicts display-referred colours.
        """
        if not self.config.net.has_radiance:
            raise HyalineError(
                f"{self.folder}: {self.method} predicts display-referred colours, not radiance; use render"
            )
        from model.batches.rays import linear_curve
        from model.run.predict import predict_colors

        colors = predict_colors(self._renderer, self._pixels(camera))
        if not bool(colors.isfinite().all()):
            raise NumericsError(f"{self.folder}: a predicted colour is not finite; train again with --overwrite")
        return linear_curve(colors).cpu().numpy().reshape(camera.height, camera.width, 3)

    def prediction(self, view: View) -> UInt8[np.ndarray, "h w 3"]:
        """The stored prediction; rendered now if the run is still training."""
        stored = self.folder / "predictions" / view.split / f"{view_name(view.index)}.png"
        return read_png(stored) if stored.is_file() else self.render(view.camera)

    @cached_property
    def _renderer(self) -> "Renderer":
        from model.run.predict import load_renderer
        from model.runtime import choose_device

        return load_renderer(self.folder, self.config, self.dataset).to(choose_device(self.device))

    def _pixels(self, camera: Camera) -> "PixelSource":
        from model.run.predict import check_draws_cameras
        from model.runtime import choose_device

        check_draws_cameras(self.folder, self.config)
        return self.config.net.load_cameras(self.inputs, camera.alone).to(choose_device(self.device))


@checked
@naming_parts("model")
def train(
    method: str | MethodConfig,
    dataset: Dataset | Path | str,
    *,
    geometry: str = TRUTH,
    out: Path | str | None = None,
    label: str | None = None,
    seed: int = 0,
    device: Device = "auto",
    overwrite: bool = False,
    **settings: int | float | str | bool | None,
) -> Run:
    """Trains a method on a dataset and renders its test splits. If interrupted, the same call resumes.

        run = hyaline.train("light-path", dataset, steps=500)
        run = hyaline.train("paper", dataset, geometry="ellipsoid", texture_size=64)
        run = hyaline.train(AlphaBlendConfig(texture_size=64), dataset, steps=500, lr=0.01)

    Args:
        method: the name of a method, or the record of one, such as one of your own (docs/extending.md).
        dataset: a dataset, its name under data/, or its folder.
        geometry: whose layers the method sees: `truth`, or proxies such as `ellipsoid`.
        out: folder of the run; runs/SCENE/METHOD unless given, with a suffix for each setting that is not the default.
        label: what the list of runs and pages add to the run's name, its folder's; that name unless given.
        seed: of all random numbers.
        device: auto (a GPU where there is one), cpu or cuda.
        overwrite: delete the run in `out` and start over.
        settings: flags of the method and its optimisation in `model train METHOD`, with _ for -, such as `steps`,
            `batch`, `lr` and `texture_size`; for a record, those of its optimisation.

    Raises:
        HyalineError: no such method or setting, a value out of range, or another run in `out`.
        NumericsError: training diverged.
        KeyboardInterrupt: training was interrupted; a checkpoint is saved.
    """
    from model.methods.protocol import METHODS, name_of
    from model.run.train_flags import Asked, complete_run
    from model.runtime import leaving_settings

    if isinstance(dataset, (str, Path)):
        dataset = open_dataset(dataset)
    if isinstance(method, str):
        net = METHODS.find(method)().usual(geometry)
        optimisation = net.optimisation()
    else:
        method, net, optimisation = name_of(method), method, method.optimisation()
    known = [flag.replace("-", "_") for kind in (type(net), type(optimisation)) for flag in flags_of(kind)]
    for key in settings:
        choose(f"method {method}: setting", key, known)
    asked = Asked(
        dataset=str(dataset.root),
        run=RunFlags(
            geometry=geometry,
            out=None if out is None else Path(out),
            label=label,
            seed=seed,
            device=device,
            overwrite=overwrite,
        ),
        method=with_settings(net, settings),
        optimisation=with_settings(optimisation, settings),
    )
    try:
        with leaving_settings():
            place = complete_run(method, asked)
    except Stopped as stopped:
        if stopped.status != 128 + signal.SIGINT:
            raise
        raise KeyboardInterrupt(str(stopped)) from None
    return open_run(place, dataset=dataset, device=device)


@checked
def list_runs(root: Path | str = RUNS) -> list[str]:
    """The names of the runs in a folder, sorted; `runs` in the working folder unless given.

    >>> list_runs()
    ['glass_table/paper']
    """
    return run_folder.list_runs(Path(root))


@checked
def open_run(
    name: Path | str, root: Path | str = RUNS, *, dataset: Dataset | Path | str | None = None, device: Device = "auto"
) -> Run:
    """A trained run, ready to render from any camera.

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
    folder = find_run(Path(name), Path(root))
    record = read_run(folder)
    found = dataset if isinstance(dataset, Dataset) else open_dataset(_place_of(record, folder, dataset))
    return Run(
        folder=folder,
        record=record,
        dataset=found,
        inputs=check_trained_on(folder, record.config, found),
        device=device,
    )


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
