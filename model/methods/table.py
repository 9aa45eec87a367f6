"""The methods that `model train NAME` can train: those built in, and those that other distributions bring.

A distribution brings one by an entry point of the group `hyaline.methods`: its name is the method's, and it refers to a
class that derives from `MethodConfig`. Nothing is imported before it is asked for.
"""

import importlib
import re
import shlex
from functools import cache
from importlib import metadata

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.terminal.command import choose
from datagen.terminal.distribution import DISTRIBUTION
from model.methods.protocol import Inputs, MethodConfig

GROUP = "hyaline.methods"

BUILT_IN = {
    "paper": "model.methods.paper.config:PaperConfig",
    "mlp-first": "model.methods.paper.config:MlpFirstConfig",
    "dnr": "model.methods.dnr.config:DnrConfig",
    "dnr-layers": "model.methods.dnr.config:DnrLayersConfig",
    "authors-code": "model.methods.authors_code.config:AuthorsConfig",
    "light-path": "model.methods.light_path.config:LightPathConfig",
    "deepvoxels": "model.methods.deepvoxels.config:DeepVoxelsConfig",
}
"""The record of each method. A new one is a folder and a line here."""

OWN: dict[str, type[MethodConfig]] = {}
"""Methods whose records this process has handed to `name_of`, by name; no other process knows them."""


@cache
def list_methods() -> tuple[str, ...]:
    """The names of all methods, those of other distributions last."""
    others = sorted(point.name for point in metadata.entry_points(group=GROUP))
    names = (*BUILT_IN, *others, *OWN)
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        raise HyalineError(
            f"method {doubled[0]!r}: two distributions bring one of that name ({', '.join(_sources(doubled[0]))}); "
            "uninstall one"
        )
    return names


@cache
def find_method(name: str) -> type[MethodConfig]:
    """The record of a method."""
    choose("method", name, list_methods())
    if name in OWN:
        return OWN[name]
    if name in BUILT_IN:
        module, _, kind = BUILT_IN[name].partition(":")
        return getattr(importlib.import_module(module), kind)
    (point,) = metadata.entry_points(group=GROUP, name=name)
    where = f"method {name!r}: {point.value}, which {_sources(name)[0]} brings,"
    try:
        found = point.load()
    except Exception as error:  # A stranger's module may raise anything.
        raise HyalineError(f"{where} cannot be imported ({error}); mend or uninstall it") from error
    if not (isinstance(found, type) and issubclass(found, MethodConfig)):
        raise HyalineError(f"{where} is not a MethodConfig; see docs/adding-a-method.md")
    return found


def name_of(config: MethodConfig) -> str:
    """The name of a record's method; a class that no distribution brings is called after itself, and known from now on.

    `AlphaBlendConfig` becomes `alpha-blend`. A later class of the same name takes its place.
    """
    kind = type(config)
    place = f"{kind.__module__}:{kind.__qualname__}"
    brought = BUILT_IN | {point.name: point.value for point in metadata.entry_points(group=GROUP)}
    if named := next((name for name, value in brought.items() if value == place), None):
        return named
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", kind.__name__.removesuffix("Config")).lower()
    if name in brought:
        raise HyalineError(f"method {name!r}: {_sources(name)[0]} brings one of that name; rename {kind.__name__}")
    OWN[name] = kind
    list_methods.cache_clear()
    find_method.cache_clear()
    return name


def about(name: str) -> str:
    """One line about a method: its docstring's first paragraph, and its distribution if it is not built in."""
    source = "" if name in BUILT_IN else f"Brought by {_sources(name)[0]}."
    try:
        kind = find_method(name)
        line = " ".join((kind.__doc__ or "").partition("\n\n")[0].split())
        line = "" if line.startswith(f"{kind.__name__}(") else line  # dataclass's own docstring.
    except HyalineError:
        line = ""  # Training it shows the error; here the other methods are still listed.
    return f"{line} {source}".strip()


def open_inputs(config: MethodConfig, dataset: Dataset, geometry: str) -> Inputs:
    """The inputs of a method from a dataset."""
    if not config.reads_layers:
        return Inputs(dataset=dataset, geometry=geometry, num_layers=0, layers_seal=dataset.seal)
    store = dataset.layer_store(geometry)
    stored = min(store.head.num_layers, config.max_layers or store.head.num_layers)
    num_layers = _choose_layers(config.asked_layers, stored, dataset, geometry)
    return Inputs(dataset=dataset, geometry=geometry, num_layers=num_layers, layers_seal=store.seal)


def _choose_layers(asked: int | None, stored: int, dataset: Dataset, geometry: str) -> int:
    """How many layers a renderer looks up: all stored ones, or the nearest ones."""
    if asked is None or 1 <= asked <= stored:
        return asked or stored
    words = ["datagen", "peel", "--dataset", str(dataset.root), "--geometry", geometry]
    peel = shlex.join([*words, "--num-layers", str(asked), "--overwrite"])
    more = f" (`{peel}` stores more)" if asked > 0 else ""
    raise HyalineError(f"layers: is {asked}; expected 1 to {stored}, the number of stored layers{more}")


def _sources(name: str) -> list[str]:
    """The distributions that bring a method of a name."""
    built_in = [DISTRIBUTION] if name in BUILT_IN else []
    points = metadata.entry_points(group=GROUP, name=name)
    return built_in + [point.dist.name if point.dist else point.value for point in points]
