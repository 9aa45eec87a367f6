"""From the words behind `model train` to what a run does; torch is not needed before the dataset is open."""

import contextlib
import dataclasses
import difflib
import functools
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, NoReturn, TypeVar

import tyro

from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import check_geometry
from datagen.data.paths import TRUTH, find_dataset
from datagen.disk.errors import HyalineError, UsageError
from datagen.terminal.command import say
from model.methods.protocol import MethodConfig
from model.methods.table import BUILT_IN, METHODS, about, open_inputs
from model.run.run_folder import TrainConfig
from model.settings.flags import flags_of, name_flags, suffixes
from model.settings.losses import LossConfig
from model.settings.optimisation import Optimisation
from model.settings.run_flags import RunFlags

CONFIG = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
"""As in datagen.terminal.command.run."""

NetT = TypeVar("NetT", bound=MethodConfig)
HowT = TypeVar("HowT", bound=Optimisation)


@dataclass(frozen=True, kw_only=True)
class Asked(Generic[NetT, HowT]):
    """What `model train METHOD --flags` was told."""

    run: RunFlags
    method: NetT
    optimisation: HowT


def parse_train(method: str, words: Sequence[str]) -> Asked[MethodConfig, Optimisation]:
    """What flags ask of a method; `--help` is printed, and ends the process.

    Raises:
        HyalineError: no such method, or a value that cannot be.
        UsageError: a flag that the method does not have.
        SystemExit: a word that its flag does not take; tyro has printed which.
    """
    usual = _usual_of_words(method, words)
    net, optimisation = type(usual.method), type(usual.optimisation)
    for record in (RunFlags, net, optimisation):
        name_flags(record)
    asked, unknown = tyro.cli(
        Asked[net, optimisation],
        default=usual,
        prog=f"model train {method}",
        description=about(method),
        args=list(words),
        config=CONFIG,
        return_unknown_args=True,
    )
    if unknown:
        _refuse(method, unknown[0])
    return asked


def _usual_of_words(method: str, words: Sequence[str]) -> Asked[MethodConfig, Optimisation]:
    """The defaults of all flags: presets, and proxies, change those of others, and so are looked for first."""
    net = METHODS.find(method)
    name_flags(net)
    presets = [item for item in dataclasses.fields(net) if item.metadata.get("is_preset")]
    named = dataclasses.make_dataclass(
        "Presets",
        [("geometry", str, TRUTH), *((item.name, net.__annotations__[item.name], item.default) for item in presets)],
    )
    found, _ = tyro.cli(
        named, prog=f"model train {method}", args=list(words), config=CONFIG, add_help=False, return_unknown_args=True
    )
    return usual_of(net(**{item.name: getattr(found, item.name) for item in presets}), found.geometry)


def usual_of(net: MethodConfig, geometry: str = TRUTH) -> Asked[MethodConfig, Optimisation]:
    """What a method does when no flags but those of its presets, and the geometry, are given."""
    usual = net.usual(geometry)
    return Asked(run=RunFlags(), method=usual, optimisation=usual.optimisation())


@functools.cache
def flags_of_method(method: str) -> dict[str, str]:
    """The field behind each flag of `model train METHOD`, without dashes in front."""
    net = METHODS.find(method)()
    return flags_of(RunFlags) | flags_of(type(net)) | flags_of(type(net.optimisation()))


def _refuse(method: str, word: str) -> NoReturn:
    """Raises what a word deserves that is no flag of a method."""
    name = word.partition("=")[0].removeprefix("--").replace("_", "-")
    if not word.startswith("--"):
        raise UsageError(f"{word!r}: method {method} takes flags alone; see `model train {method} --help`")
    having = [other for other in BUILT_IN if name in flags_of_method(other)]
    if having:
        raise HyalineError(f"--{name}: method {method} has no such flag ({', '.join(having)} has); leave it out")
    near = difflib.get_close_matches(name[:100], flags_of_method(method), n=1, cutoff=0.5)
    hint = f"did you mean --{near[0]}? " if near else ""
    raise UsageError(f"--{name}: method {method} has no such flag; {hint}see `model train {method} --help`")


@functools.cache
def check_words(method: str, words: tuple[str, ...]) -> Asked[MethodConfig, Optimisation]:
    """The same for words that a file holds: nothing is printed.

    Raises:
        HyalineError: an unknown method or flag, or a value that its flag does not take.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return parse_train(method, words)
    except SystemExit:
        raise HyalineError(
            f"{' '.join(words)}: `model train {method}` does not take it; see `model train {method} --help`"
        ) from None


def folder_name(method: str, asked: Asked[MethodConfig, Optimisation]) -> str:
    """The default name of a run's folder: the method, and a suffix for each choice that is not usual."""
    usual = usual_of(asked.method, asked.run.geometry)
    geometry = [] if asked.run.geometry == TRUTH else [asked.run.geometry]
    pairs = ((asked.method, usual.method), (asked.optimisation, usual.optimisation), (asked.run, usual.run))
    return "-".join([method, *geometry, *(word for pair in pairs for word in suffixes(*pair))])


def configure(method: str, asked: Asked[MethodConfig, Optimisation]) -> tuple[TrainConfig, Dataset]:
    """The configuration that flags make on their dataset, which is opened.

    Raises:
        HyalineError: a choice that cannot be, no such dataset or geometry.
    """
    opened = open_dataset(find_dataset(asked.run.dataset))
    if opened.parent is not None:
        raise HyalineError(f"{opened.root}: is a variant, without training views; train on {opened.parent.root}")
    if "torch" not in sys.modules:
        say(f"{opened.root}: loads torch")  # Seconds, in which nothing else is heard.
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
    return dataclasses.replace(config, loss=_find_weights(config.loss)), opened


def _find_weights(loss: LossConfig) -> LossConfig:
    if not loss.has_vgg:
        return loss
    from model.losses.patch_losses import find_vgg

    return find_vgg(loss)
