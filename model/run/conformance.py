"""`model check-method NAME`: the requirements on every method, checked on a tiny dataset."""

import contextlib
import dataclasses
import io
import re
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch.optim.optimizer import register_optimizer_step_post_hook

from datagen.data.dataset import Dataset
from datagen.data.images import read_png
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.records import to_json
from datagen.scene.folder import open_scene
from datagen.terminal.command import Stopped, tell
from model.batches.rays import PixelSource, cameras_of
from model.methods.protocol import METHODS, Inputs, open_inputs
from model.methods.renderer import Renderer
from model.run.predict import load_renderer, predict_colors, predict_pixels, render_predictions
from model.run.run_folder import WEIGHTS, TrainConfig, parse_config
from model.run.train import build_renderer, train
from model.settings import decided
from model.state import fingerprint, load_state

STEPS = 4
MOST_PIXELS = 256
"""Largest batch of a step."""
CPU = torch.device("cpu")


class Skipped(Exception):
    """Why a check does not apply."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A method on a dataset, and a folder for its runs."""

    config: TrainConfig
    inputs: Inputs
    folder: Path

    def build(self) -> Renderer:
        return build_renderer(self.config, self.inputs, device=CPU)

    def pixels(self, split: Literal["interpolating", "extrapolating"], view: int) -> PixelSource:
        return self.config.net.load(self.inputs, split, [view], with_images=False)

    def train(self, name: str, device: torch.device = CPU) -> bytes:
        """The weights of a new run in `folder`/`name`, or of one that goes on."""
        train(self.config, self.inputs.dataset, self.folder / name, label=name, device=device)
        return (self.folder / name / WEIGHTS).read_bytes()

    def trained(self) -> Renderer:
        return load_renderer(self.folder / "first", self.config, self.inputs.dataset)


def check_method(name: str, dataset: Dataset, folder: Path) -> int:
    """Runs every check of a method and prints a line for each; the number of those that failed.

    Args:
        folder: an empty folder, for runs.
    """
    net = METHODS.find(name)().usual(TRUTH)
    optimisation = decided(net.optimisation())
    inputs = open_inputs(net, dataset, TRUTH)
    settings = {item.name: getattr(optimisation, item.name) for item in dataclasses.fields(optimisation)}
    settings |= {"steps": STEPS, "batch": min(optimisation.batch, MOST_PIXELS)}
    config = TrainConfig(
        method=name, geometry=TRUTH, net=net.complete(inputs), checkpoint_every=2, evaluate_every=2, **settings
    )
    subject = Subject(config=config, inputs=inputs, folder=folder)
    failed = 0
    for title, check in CHECKS.items():
        word, why = "ok", ""
        try:
            with contextlib.redirect_stderr(io.StringIO()):
                check(subject)
        except Skipped as skipped:
            word, why = "skip", f": {skipped}"
        except Exception as error:  # A method is other people's code: any exception is the result of the check.
            kind = "" if isinstance(error, HyalineError) else f"{type(error).__name__}: "
            word, why = "FAIL", f": {kind}{error}"
        tell(f"{word:<5} {title}{why}")
        failed += word == "FAIL"
    return failed


def _expect(holds: bool, problem: str) -> None:
    if not holds:
        raise HyalineError(problem)


def _reads_its_record(subject: Subject) -> None:
    again = parse_config(to_json(subject.config), where="config")
    _expect(again == subject.config, "the record changes when it is written to JSON and read back")


def _starts_alike(subject: Subject) -> None:
    first, second = (fingerprint(dict(subject.build().state_dict())) for _ in range(2))
    _expect(first == second, "two renderers built from one seed differ; use only torch's default generator")


def _draws_pictures(subject: Subject) -> None:
    pixels = subject.pixels("interpolating", 0)
    _expect(not bool(pixels.rgb.any()), "load gives a picture's colours although with_images is False")
    colors = predict_colors(subject.build(), pixels)
    count = subject.inputs.dataset.config.resolution.pixels
    _expect(tuple(colors.shape) == (count, 3), f"render gives {tuple(colors.shape)}; expected ({count}, 3)")
    _expect(colors.dtype == torch.float32, f"render gives {colors.dtype}; expected torch.float32")
    _expect(bool(colors.isfinite().all()), "a rendered colour is not finite")
    far = float(colors.abs().max())
    _expect(far < 100, f"a rendered colour is {far:.3g}; expected sRGB, about 0 to 1")


def _draws_nothing(subject: Subject) -> None:
    if subject.inputs.dataset.config.scene != "synthetic":
        raise Skipped("the given dataset may have no empty view")
    for view in range(subject.inputs.dataset.num_views["extrapolating"]):
        colors = predict_colors(subject.build(), subject.pixels("extrapolating", view))
        _expect(bool(colors.isfinite().all()), f"extrapolating view {view}: a colour is not finite")


def _trains_alike(subject: Subject) -> None:
    fresh = subject.build()
    before = fingerprint(dict(fresh.state_dict()))
    same = subject.train("first") == subject.train("second")
    _expect(same, "two runs of one seed end with different weights; draw only from `rng`")
    after = load_state(subject.folder / "first" / WEIGHTS)["renderer"]
    has_learned = before != fingerprint(after) or not list(fresh.parameters())
    _expect(has_learned, f"no weight changed in {STEPS} steps")


def _resumes(subject: Subject) -> None:
    updates = 0

    def stop(*_: object) -> None:
        nonlocal updates
        updates += 1
        if updates == STEPS // 2 * subject.config.updates:
            signal.raise_signal(signal.SIGTERM)  # Training ends after the current step.

    hook = register_optimizer_step_post_hook(stop)
    with contextlib.suppress(Stopped), contextlib.ExitStack() as stack:
        stack.callback(hook.remove)
        subject.train("parts")
    same = subject.train("parts") == (subject.folder / "first" / WEIGHTS).read_bytes()
    _expect(same, "a stopped and resumed run ends with different weights; keep all state in parameters and buffers")


def _predicts(subject: Subject) -> None:
    out = subject.folder / "first"
    render_predictions(out, subject.config, subject.inputs.dataset, device=CPU)
    drawn = predict_pixels(subject.trained(), subject.pixels("extrapolating", 0))
    saved = read_png(out / "predictions" / "extrapolating" / "0000.png")
    _expect(np.array_equal(drawn.reshape(saved.shape), saved), "saved and loaded weights render a different picture")


def _draws_any_camera(subject: Subject) -> None:
    net = subject.config.net
    if not net.draws_cameras:
        raise Skipped("it only draws the views of its dataset (draws_cameras is False)")
    renderer, camera = subject.trained(), cameras_of(subject.inputs.dataset, "extrapolating", [0])
    free = predict_colors(renderer, net.load_cameras(subject.inputs, camera))
    stored = predict_colors(renderer, subject.pixels("extrapolating", 0))
    # Layers may have been stored by another machine, where rays along an edge may hit its other side.
    contrast = float(stored.amax() - stored.amin())
    share = float(((free - stored).abs().amax(dim=1) > 0.02 * contrast).float().mean())
    _expect(share < 0.01, f"through a view's camera {share:.0%} of the pixels differ from the view's")


def _has_a_page(subject: Subject) -> None:
    net = subject.config.net
    if not net.page:
        raise Skipped("it has no web page (page is empty)")
    page = net.draw_page(subject.trained(), open_scene(subject.inputs.dataset))
    _expect(re.search(r"\bvec3\s+shade\s*\(", page.shader) is not None, "its shader has no function vec3 shade(...)")
    bad = [name for name in page.defines if not re.fullmatch("[A-Z][A-Z0-9_]*", name)]
    _expect(not bad, f"its define {', '.join(bad)} is not a name in capitals")
    _expect(all(np.isfinite(rows).all() for rows in page.weights), "its weights are not all finite")


def _runs_on_a_gpu(subject: Subject) -> None:
    if not torch.cuda.is_available():
        raise Skipped("torch finds no GPU")
    device = torch.device("cuda")
    subject.train("gpu", device)
    render_predictions(subject.folder / "gpu", subject.config, subject.inputs.dataset, device=device)


CHECKS: dict[str, Callable[[Subject], None]] = {
    "its record goes to JSON and back": _reads_its_record,
    "one seed gives one start": _starts_alike,
    "pictures have their shape, type and range": _draws_pictures,
    "an empty view is drawn": _draws_nothing,
    "one seed gives one run, which learns": _trains_alike,
    "a stopped run resumes to the bit": _resumes,
    "saved weights render the same pictures": _predicts,
    "a view's camera gives the view's picture": _draws_any_camera,
    "its web page has what it needs": _has_a_page,
    "it runs on a GPU": _runs_on_a_gpu,
}
"""Later ones use the runs of earlier ones."""
