"""`model check-method NAME`: the requirements on every method, checked on a tiny dataset."""

import contextlib
import dataclasses
import io
import re
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.optim.optimizer import register_optimizer_step_post_hook

from datagen.data.dataset import Dataset
from datagen.data.images import read_png
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.records import to_json
from datagen.scene.folder import open_scene
from datagen.terminal.command import Stopped
from model.batches.rays import cameras_of
from model.methods.protocol import Inputs
from model.methods.renderer import Renderer
from model.methods.table import METHODS, open_inputs
from model.run.checkpoint import fingerprint, load_state
from model.run.predict import load_renderer, predict_colors, predict_pixels, render_predictions
from model.run.run_folder import WEIGHTS, TrainConfig, parse_config
from model.run.train import train

STEPS = 4
MOST_PIXELS = 256
"""Largest batch of a step."""
CPU = torch.device("cpu")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The result of one check."""

    name: str
    problem: str
    """What is wrong; empty if the check passed."""
    skipped: str = ""
    """Why the check was skipped; empty if it was not."""


class Broken(Exception):
    """A requirement that a method does not meet."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A method on a dataset, and a folder for its runs."""

    config: TrainConfig
    inputs: Inputs
    folder: Path

    @property
    def dataset(self) -> Dataset:
        return self.inputs.dataset

    def build(self) -> Renderer:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.seed)
            return self.config.net.build(self.inputs)

    def train(self, name: str, device: torch.device = CPU) -> Path:
        out = self.folder / name
        train(self.config, self.dataset, out, label=name, device=device)
        return out


def check_method(name: str, dataset: Dataset, folder: Path) -> Iterator[Verdict]:
    """Runs every check of a method, from cheap to expensive.

    Args:
        folder: an empty folder, for runs.
    """
    net = METHODS.find(name)().usual(TRUTH)
    optimisation = net.optimisation()
    inputs = open_inputs(net, dataset, TRUTH)
    settings = {item.name: getattr(optimisation, item.name) for item in dataclasses.fields(optimisation)}
    settings |= {"steps": STEPS, "batch": min(optimisation.batch, MOST_PIXELS)}
    config = TrainConfig(
        method=name, geometry=TRUTH, net=net.complete(inputs), checkpoint_every=2, evaluate_every=2, **settings
    )
    subject = Subject(config=config, inputs=inputs, folder=folder)
    for title, check in CHECKS.items():
        yield _verdict(title, check, subject)


def _verdict(title: str, check: Callable[[Subject], str], subject: Subject) -> Verdict:
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            return Verdict(name=title, problem="", skipped=check(subject))
    except (Broken, HyalineError) as error:
        return Verdict(name=title, problem=str(error))
    except Exception as error:
        # A method is other people's code: any exception is the result of the check.
        return Verdict(name=title, problem=f"{type(error).__name__}: {error}")


def _expect(holds: bool, problem: str) -> None:
    if not holds:
        raise Broken(problem)


def _reads_its_record(subject: Subject) -> str:
    again = parse_config(to_json(subject.config), where="config")
    _expect(again == subject.config, "the record changes when it is written to JSON and read back")
    return ""


def _starts_alike(subject: Subject) -> str:
    first, second = (fingerprint(dict(subject.build().state_dict())) for _ in range(2))
    _expect(first == second, "two renderers built from one seed differ; use only torch's default generator")
    return ""


def _draws_pictures(subject: Subject) -> str:
    pixels = subject.config.net.load(subject.inputs, "interpolating", [0], with_images=False)
    _expect(not bool(pixels.rgb.any()), "load gives a picture's colours although with_images is False")
    colors = predict_colors(subject.build(), pixels)
    count = subject.dataset.config.resolution.pixels
    _expect(tuple(colors.shape) == (count, 3), f"render gives {tuple(colors.shape)}; expected ({count}, 3)")
    _expect(colors.dtype == torch.float32, f"render gives {colors.dtype}; expected torch.float32")
    _expect(bool(colors.isfinite().all()), "a rendered colour is not finite")
    far = float(colors.abs().max())
    _expect(far < 100, f"a rendered colour is {far:.3g}; expected sRGB, about 0 to 1")
    return ""


def _trains_alike(subject: Subject) -> str:
    fresh = subject.build()
    before = fingerprint(dict(fresh.state_dict()))
    first, second = subject.train("first"), subject.train("second")
    _expect(_bytes(first) == _bytes(second), "two runs of one seed end with different weights; draw only from `rng`")
    after = load_state(first / WEIGHTS)["renderer"]
    has_learned = before != fingerprint(after) or not list(fresh.parameters())
    _expect(has_learned, f"no weight changed in {STEPS} steps")
    return ""


def _resumes(subject: Subject) -> str:
    steps = 0

    def stop(*_: object) -> None:
        nonlocal steps
        steps += 1
        if steps == STEPS // 2 * subject.config.updates:
            signal.raise_signal(signal.SIGTERM)  # Training ends after the current step.

    hook = register_optimizer_step_post_hook(stop)
    try:
        with contextlib.suppress(Stopped):
            subject.train("parts")
    finally:
        hook.remove()
    out = subject.train("parts")
    _expect(
        _bytes(out) == _bytes(subject.folder / "first"),
        "a stopped and resumed run ends with different weights; keep all state in parameters and buffers",
    )
    return ""


def _predicts(subject: Subject) -> str:
    out = subject.folder / "first"
    render_predictions(out, subject.config, subject.dataset, device=CPU)
    renderer = load_renderer(out, subject.config, subject.dataset)
    pixels = subject.config.net.load(subject.inputs, "extrapolating", [0], with_images=False)
    drawn = predict_pixels(renderer, pixels).reshape(*subject.dataset.config.resolution.shape, 3)
    saved = read_png(out / "predictions" / "extrapolating" / "0000.png")
    _expect(np.array_equal(drawn, saved), "saved and loaded weights render a different picture")
    return ""


def _draws_nothing(subject: Subject) -> str:
    views = range(subject.dataset.config.split("extrapolating").views)
    for view in views:
        if subject.inputs.dataset.config.scene != "synthetic":
            return "the given dataset may have no empty view"
        pixels = subject.config.net.load(subject.inputs, "extrapolating", [view], with_images=False)
        colors = predict_colors(subject.build(), pixels)
        _expect(bool(colors.isfinite().all()), f"extrapolating view {view}: a colour is not finite")
    return ""


def _draws_any_camera(subject: Subject) -> str:
    net, inputs = subject.config.net, subject.inputs
    if not net.draws_cameras:
        return "it only draws the views of its dataset (draws_cameras is False)"
    renderer = load_renderer(subject.folder / "first", subject.config, subject.dataset)
    camera = cameras_of(subject.dataset, "extrapolating", [0])
    free = predict_colors(renderer, net.load_cameras(inputs, camera))
    stored = predict_colors(renderer, net.load(inputs, "extrapolating", [0], with_images=False))
    # Layers may have been stored by another machine, where rays along an edge may hit its other side.
    contrast = float(stored.amax() - stored.amin())
    share = float(((free - stored).abs().amax(dim=1) > 0.02 * contrast).float().mean())
    _expect(share < 0.01, f"through a view's camera {share:.0%} of the pixels differ from the view's")
    return ""


def _has_a_page(subject: Subject) -> str:
    net = subject.config.net
    if not net.page:
        return "it has no web page (page is empty)"
    renderer = load_renderer(subject.folder / "first", subject.config, subject.dataset)
    page = net.draw_page(renderer, open_scene(subject.dataset))
    _expect(re.search(r"\bvec3\s+shade\s*\(", page.shader) is not None, "its shader has no function vec3 shade(...)")
    bad = [name for name in page.defines if not re.fullmatch("[A-Z][A-Z0-9_]*", name)]
    _expect(not bad, f"its define {', '.join(bad)} is not a name in capitals")
    rows = np.concatenate([np.zeros((0, 4), np.float32), *page.weights])
    _expect(bool(np.isfinite(rows).all()), "its weights are not all finite")
    return ""


def _runs_on_a_gpu(subject: Subject) -> str:
    if not torch.cuda.is_available():
        return "torch finds no GPU"
    device = torch.device("cuda")
    out = subject.train("gpu", device)
    render_predictions(out, subject.config, subject.dataset, device=device)
    return ""


def _bytes(run: Path) -> bytes:
    return (run / WEIGHTS).read_bytes()


CHECKS: dict[str, Callable[[Subject], str]] = {
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
"""Each returns why it was skipped, or an empty string; later ones use the runs of earlier ones."""
