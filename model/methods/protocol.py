"""Methods: the configuration record that builds a renderer and loads its pixels, and the list of all of them.

A method is a frozen dataclass that derives from `MethodConfig`. Its fields are the flags of `model train NAME` (see
model/settings.py); its methods make everything else. Importing it must not import torch, so that `--help` answers
at once. docs/extending.md shows how to write one, and how other distributions bring theirs.
"""

import functools
import importlib
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

from datagen.data.config import Split
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.terminal.plugins import Group
from model.settings import Optimisation, PixelOptimisation, check_limits

if TYPE_CHECKING:
    import datagen.scene.description
    import model.batches.rays
    import model.methods.page
    import model.methods.renderer
    from datagen.data.cameras import Cameras
    from datagen.data.dataset import Dataset


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What a method is given besides its configuration."""

    dataset: "Dataset"
    geometry: str
    """`truth`, fitted glass, or the kind of proxy whose surfaces the method may know."""
    num_layers: int
    """Stored layers that it looks up, the nearest ones; 0 where it looks up none."""
    layers_seal: str
    """Digest of those layers; where there are none, of fitted glass, or of the dataset."""


@dataclass(frozen=True, kw_only=True)
class MethodConfig:
    """A method's configuration, and the way from it to a renderer."""

    room: ClassVar[str] = ""
    """A module that may import torch, whose functions `complete`, `build` and (unless stored layers are read)
    `load_cameras` take the record first. Empty: the record itself overrides these methods."""
    reads_layers: ClassVar[bool] = False
    """True when it looks up the layers that were peeled; False when it traces its own, or needs none."""
    whole_views: ClassVar[bool] = False
    """True when the layers of neighbouring pixels belong together, as for U-Nets."""
    max_layers: ClassVar[int | None] = None
    """The nearest peeled layers that it looks at; None: all of them."""
    knowledge: ClassVar[str] = ""
    """What it is given besides geometry, images and cameras, in words; empty for nothing."""
    uses_geometry: ClassVar[bool] = True
    """False: surfaces are not known to it, and `knowledge` says all that is."""
    draws_cameras: ClassVar[bool] = False
    """True when `load_cameras` gives the pixels of cameras that no view of the dataset has."""
    page: ClassVar[str] = ""
    """A module that may import torch, whose function `draw_page` takes the record first. Empty: no exported page."""
    has_radiance: ClassVar[bool] = False
    """True when it predicts linear radiance, of which its colours are the sRGB curve, unclipped."""

    def __post_init__(self) -> None:
        """Check the fields' numbers against their limits; a method that checks more calls this first."""
        check_limits(self)

    @property
    def traces_layers(self) -> bool:
        """True when no stored layer is read: rays are traced for each batch, or not needed."""
        return not self.reads_layers

    @property
    def asked_layers(self) -> int | None:
        """How many stored layers it was told to look up; None: all of them."""
        return None

    def usual(self, geometry: str) -> Self:  # noqa: ARG002
        """The record that flags change: the method's defaults on a geometry."""
        return type(self)()

    def optimisation(self) -> Optimisation:
        """How it is trained unless flags say otherwise; a `PixelOptimisation` takes the flags of further losses."""
        return PixelOptimisation()

    def complete(self, inputs: Inputs) -> Self:
        """The same record with what was left for the dataset to decide.

        Raises:
            HyalineError: a choice that cannot be on this dataset.
        """
        return importlib.import_module(self.room).complete(self, inputs) if self.room else self

    def hurried(self) -> Self:
        """The same for pictures that are drawn in haste, with one ray a pixel, from the same parameters."""
        return self

    def build(self, inputs: Inputs) -> "model.methods.renderer.Renderer":
        """A fresh renderer, of a complete record; its random start is drawn from torch's default generator."""
        return importlib.import_module(self.room).build(self, inputs)

    def load(
        self, inputs: Inputs, split: Split, views: Sequence[int], *, with_images: bool
    ) -> "model.batches.rays.PixelSource":
        """The pixels of some views, on the CPU: with stored layers, or as `load_cameras` traces them.

        Args:
            with_images: without, their colours are black: rendering a test view never opens its truth.
        """
        if self.traces_layers:
            from model.batches.rays import load_views_of

            trace = functools.partial(self.load_cameras, inputs)
            return load_views_of(trace, inputs.dataset, split, views, with_images=with_images)
        from model.batches.layers import load_pixels

        return load_pixels(
            inputs.dataset,
            inputs.geometry,
            split,
            views,
            with_images=with_images,
            max_layers=inputs.num_layers,
            whole_views=self.whole_views,
        )

    def load_cameras(self, inputs: Inputs, cameras: "Cameras") -> "model.batches.rays.PixelSource":
        """The pixels of any cameras, black, on the CPU.

        Through the camera of a view the renderer draws what it draws of `load`'s pixels.

        Raises:
            HyalineError: it cannot draw pictures of this size.
        """
        if self.traces_layers:
            return importlib.import_module(self.room).load_cameras(self, inputs, cameras)
        from model.batches.layers import peel_cameras

        return peel_cameras(inputs.dataset, inputs.geometry, inputs.num_layers, cameras, whole_views=self.whole_views)

    def draw_page(
        self, renderer: "model.methods.renderer.Renderer", scene: "datagen.scene.description.Scene"
    ) -> "model.methods.page.MethodPage":
        """What a page in a browser needs to draw a trained renderer as Python does; a method with a `page` has it."""
        return importlib.import_module(self.page).draw_page(self, renderer, scene)


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
    guide="docs/extending.md",
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
    asked = config.asked_layers
    if asked is not None and not 1 <= asked <= stored:
        words = ["datagen", "peel", str(dataset.root), "--geometry", geometry]
        peel = shlex.join([*words, "--num-layers", str(asked), "--overwrite"])
        more = f" (`{peel}` stores more)" if asked > 0 else ""
        raise HyalineError(f"layers: is {asked}; expected 1 to {stored}, the number of stored layers{more}")
    return Inputs(dataset=dataset, geometry=geometry, num_layers=asked or stored, layers_seal=store.seal)
