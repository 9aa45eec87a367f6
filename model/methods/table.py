"""The methods that `model train NAME` can train: those built in, and those that other distributions bring.

A distribution brings one by an entry point of the group `hyaline.methods`: its name is the method's, and it refers to a
class that derives from `MethodConfig`.
"""

import re
import shlex
from typing import TYPE_CHECKING

from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.terminal.plugins import Group
from model.methods.protocol import Inputs, MethodConfig

if TYPE_CHECKING:
    from datagen.data.dataset import Dataset

BUILT_IN = {
    "paper": "model.methods.paper.config:PaperConfig",
    "paper-best": "model.methods.paper.config:PaperBestConfig",
    "mlp-first": "model.methods.paper.config:MlpFirstConfig",
    "dnr": "model.methods.paper.config:DnrConfig",
    "dnr-layers": "model.methods.paper.config:DnrLayersConfig",
    "dnr-authors": "model.methods.paper.config:DnrAuthorsConfig",
    "light-path": "model.methods.light_path.config:LightPathConfig",
}
"""The record of each method. A new one is a folder and a line here."""

METHODS: Group[type[MethodConfig]] = Group(
    name="hyaline.methods",
    what="method",
    built_in=BUILT_IN,
    guide="docs/adding-a-method.md",
    kind="model.methods.protocol:MethodConfig",
    is_class=True,
)


def name_of(config: MethodConfig) -> str:
    """The name of a record's method; a class that no distribution brings is called after itself, and known from now on.

    `AlphaBlendConfig` becomes `alpha-blend`. A later class of the same name takes its place.
    """
    kind = type(config)
    place = f"{kind.__module__}:{kind.__qualname__}"
    brought = METHODS.places()
    if named := next((name for name, value in brought.items() if value == place), None):
        return named
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", kind.__name__.removesuffix("Config")).lower()
    if name in brought:
        raise HyalineError(
            f"method {name!r}: {METHODS.sources(name)[0]} brings one of that name; rename {kind.__name__}"
        )
    METHODS.own[name] = kind
    return name


def about(name: str) -> str:
    """One line about a method: its docstring's first paragraph, and who brings it if it is not built in."""
    source = "" if name in BUILT_IN else f"Brought by {METHODS.sources(name)[0]}."
    try:
        kind = METHODS.find(name)
        line = " ".join((kind.__doc__ or "").partition("\n\n")[0].split())
        line = "" if line.startswith(f"{kind.__name__}(") else line  # dataclass's own docstring.
    except HyalineError:
        line = ""  # Training it shows the error; here the other methods are still listed.
    return f"{line} {source}".strip()


def open_inputs(config: MethodConfig, dataset: "Dataset", geometry: str) -> Inputs:
    """What a method is given of a dataset."""
    if not config.reads_layers:
        seal = dataset.seal
        if config.uses_geometry and geometry != TRUTH:
            from datagen.data.geometries import geometry_digest  # Not before: lists of methods need no NumPy.

            seal = geometry_digest(dataset, geometry)
        return Inputs(dataset=dataset, geometry=geometry, num_layers=0, layers_seal=seal)
    store = dataset.layer_store(geometry)
    stored = min(store.head.num_layers, config.max_layers or store.head.num_layers)
    num_layers = _choose_layers(config.asked_layers, stored, dataset, geometry)
    return Inputs(dataset=dataset, geometry=geometry, num_layers=num_layers, layers_seal=store.seal)


def _choose_layers(asked: int | None, stored: int, dataset: "Dataset", geometry: str) -> int:
    """How many layers a renderer looks up: all stored ones, or the nearest ones."""
    if asked is None or 1 <= asked <= stored:
        return asked or stored
    words = ["datagen", "peel", str(dataset.root), "--geometry", geometry]
    peel = shlex.join([*words, "--num-layers", str(asked), "--overwrite"])
    more = f" (`{peel}` stores more)" if asked > 0 else ""
    raise HyalineError(f"layers: is {asked}; expected 1 to {stored}, the number of stored layers{more}")
