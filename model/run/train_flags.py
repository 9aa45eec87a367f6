"""`model train`: from its words to a finished run; torch is not needed before the dataset is open."""

import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.data.paths import TRUTH, find_dataset
from datagen.disk.errors import HyalineError
from datagen.terminal.command import say
from datagen.terminal.parsing import Command, changed_flags, parse
from model.methods.protocol import METHODS, MethodConfig, about, open_inputs
from model.runtime import choose_device
from model.settings import FETCH, NO_VGG, RUNS, Optimisation, RunFlags, decided, suffixes

if TYPE_CHECKING:
    from datagen.data.dataset import Dataset
    from model.run.run_folder import TrainConfig


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What `model train METHOD [DATASET] --flags` asks for."""

    dataset: str | None
    run: RunFlags
    method: MethodConfig
    optimisation: Optimisation
    """Decided: names of folders and recorded flags follow from it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "optimisation", decided(self.optimisation))


def make_command(method: str, words: Sequence[str], then: Callable[[str, Asked], None]) -> Command:
    """The command `model train METHOD`: its flags are the method's, and their defaults suit the geometry in the words.

    Raises:
        HyalineError: no such method.
    """
    geometry = TRUTH  # Some methods have other defaults on proxies.
    for place, word in enumerate(words, start=1):
        flag, equals, value = word.partition("=")
        if flag == "--geometry":
            geometry = value if equals else "".join(words[place : place + 1])
    usual = METHODS.find(method)().usual(geometry)
    optimised = usual.optimisation()

    def train(
        dataset: str | None = None,
        /,
        *,
        choices: RunFlags = RunFlags(),  # noqa: B008
        renderer: MethodConfig = usual,
        optimisation: Optimisation = optimised,
    ) -> None:
        then(method, Asked(dataset=dataset, run=choices, method=renderer, optimisation=optimisation))

    train.__annotations__ |= {"renderer": type(usual), "optimisation": type(optimised)}
    train.__doc__ = about(method)
    return train


def parse_train(method: str, words: tuple[str, ...]) -> Asked:
    """What words ask of a method.

    Raises:
        HyalineError: no such method or flag, or a value that its flag does not take.
    """
    # An experiment asks for the same flags on many datasets, and they take 25 ms to parse.
    if words and not words[0].startswith("-") and (asked := _parse_train(method, words[1:])).dataset is None:
        return dataclasses.replace(asked, dataset=words[0])
    return _parse_train(method, words)


@functools.cache
def _parse_train(method: str, words: tuple[str, ...]) -> Asked:
    found: list[Asked] = []
    command = make_command(method, words, lambda _, asked: found.append(asked))
    parse(f"model train {method}", command, words)()
    return found[0]


def folder_name(method: str, asked: Asked) -> str:
    """The default name of a run's folder: the method, and a suffix for each choice that is not usual."""
    usual = asked.method.usual(asked.run.geometry)
    geometry = [] if asked.run.geometry == TRUTH else [asked.run.geometry]
    pairs = ((asked.method, usual), (asked.optimisation, usual.optimisation()), (asked.run, RunFlags()))
    return "-".join([method, *geometry, *(word for pair in pairs for word in suffixes(*pair))])


def flags_asked(asked: Asked) -> dict[str, str]:
    """The flags on which a run's result depends, without dashes, where they are not as usual; a switch has no value."""
    usual, kept = asked.method.usual(asked.run.geometry), RunFlags(geometry=asked.run.geometry, seed=asked.run.seed)
    pairs = ((kept, RunFlags()), (asked.method, usual), (asked.optimisation, usual.optimisation()))
    return dict(flag for pair in pairs for flag in changed_flags(*pair))


def complete_run(method: str, asked: Asked) -> Path:
    """Trains what was asked for and renders the test splits; a run that was stopped resumes, a finished one stays.

    Returns:
        The run's folder.
    """
    from datagen.data.dataset import open_dataset

    run, dataset = asked.run, open_dataset(find_dataset(asked.dataset))
    out = run.out or RUNS / dataset.name / folder_name(method, asked)
    if not run.overwrite and _is_finished(method, asked, dataset, out):
        say(f"{out}: finished before, nothing to do; --overwrite trains it again")
        return out
    config = configure(method, asked, dataset)
    label, device = run.label or out.name, choose_device(run.device)
    for where, text in (("--label", label), ("dataset", dataset.root.as_posix())):
        if not text.isprintable():  # The run's record could not be read again.
            raise HyalineError(f"{where}: is {text!r}; expected text without control characters")

    from datagen.disk.ownership import holding, is_ours, refuse_others
    from model.run.logs import add_frames, measured
    from model.run.predict import render_predictions
    from model.run.run_folder import CHECKPOINT, FOLDER, WEIGHTS, check_trained_on
    from model.run.train import train

    with holding(out, FOLDER):
        refuse_others(out, FOLDER)
        is_new = run.overwrite or not is_ours(out, FOLDER)
        if not is_new:
            check_trained_on(out, config, dataset)
        if is_new or not (out / WEIGHTS).is_file():
            with measured(out) if run.costs else nullcontext():
                flags = flags_asked(asked)
                train(config, dataset, out, label=label, device=device, flags=flags, overwrite=run.overwrite)
        else:
            (out / CHECKPOINT).unlink(missing_ok=True)
            say(f"{out}: is trained; continuing with its predictions")
        start = time.monotonic()
        frames = render_predictions(out, config, dataset, device=device)
        if run.costs:
            add_frames(out, frames, time.monotonic() - start)
    return out


def _is_finished(method: str, asked: Asked, dataset: "Dataset", out: Path) -> bool:
    """True if `out` holds all of such a run, which is found without torch."""
    from model.run.run_folder import is_all_drawn, read_run

    try:
        record, inputs = read_run(out), open_inputs(asked.method, dataset, asked.run.geometry)
    except HyalineError:  # `configure` names it.
        return False
    found = (record.method, record.flags, record.dataset_seal, record.layers_seal)
    return found == (method, flags_asked(asked), dataset.seal, inputs.layers_seal) and is_all_drawn(out, dataset)


def configure(method: str, asked: Asked, opened: "Dataset") -> "TrainConfig":
    """The configuration that flags make on a dataset.

    Raises:
        HyalineError: a choice that cannot be, or no such geometry.
    """
    from datagen.data.geometries import check_geometry
    from model.run.run_folder import TrainConfig

    if opened.parent is not None:
        raise HyalineError(f"{opened.root}: is a variant, without training views; train on {opened.parent.root}")
    if "torch" not in sys.modules:
        say(f"{opened.root}: loading torch")  # This takes seconds without other output.
    geometry = asked.run.geometry
    if not asked.method.uses_geometry and geometry != TRUTH:
        raise HyalineError(f"--geometry {geometry}: method {method} uses no geometry; leave it out")
    check_geometry(opened, geometry)
    inputs = open_inputs(asked.method, opened, geometry)
    config = TrainConfig(
        method=method,
        geometry=geometry,
        net=asked.method.complete(inputs),
        seed=asked.run.seed,
        **{item.name: getattr(asked.optimisation, item.name) for item in dataclasses.fields(asked.optimisation)},
    )
    if config.loss.has_vgg:
        from model.methods.patch_losses import find_vgg

        config = dataclasses.replace(config, loss=find_vgg(config.loss))
    elif ("vgg-weights", NO_VGG) in flags_asked(asked).items():
        say(f"{method}: learns by L1 alone, without the paper's perceptual loss; if you lack its weights, {FETCH}")
    return config
