"""The protocol of methods: a configuration record, which builds a renderer and loads the pixels that it learns from.

A method is a frozen dataclass that derives from `MethodConfig`. Its fields are the flags of `model train NAME` (see
model/settings.py); its methods make everything else. Importing it must not import torch, so that `--help` answers
at once. docs/adding-a-method.md shows how to write one.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

from datagen.data.config import Split
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
    """A module that may import torch, whose functions `complete`, `build`, `load` and (with `draws_cameras`)
    `load_cameras` take the record first. Empty: the record itself overrides these methods."""
    reads_layers: ClassVar[bool] = False
    """True when it looks up the layers that were peeled; False when it traces its own, or needs none."""
    max_layers: ClassVar[int | None] = None
    """The nearest peeled layers that it looks at; None: all of them."""
    knowledge: ClassVar[str] = ""
    """What it is given besides geometry, images and cameras, in words; empty for nothing."""
    uses_geometry: ClassVar[bool] = True
    """False: surfaces are not known to it, and `knowledge` says all that is."""
    draws_cameras: ClassVar[bool] = False
    """True when `load_cameras` gives the pixels of cameras that no view of the dataset has."""
    page: ClassVar[str] = ""
    """A module that may import torch, whose function `draw_page` takes the record first. Empty: `model export` makes no
    page of its runs."""
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
        """The pixels of some views, on the CPU.

        Args:
            with_images: without, their colours are black: rendering a test view never opens its truth.
        """
        load = importlib.import_module(self.room).load
        return load(self, inputs, split, views, with_images=with_images)

    def load_cameras(self, inputs: Inputs, cameras: "Cameras") -> "model.batches.rays.PixelSource":
        """The pixels of any cameras, black, on the CPU; a method with `draws_cameras` has it.

        Through the camera of a view the renderer draws what it draws of `load`'s pixels.

        Raises:
            HyalineError: it cannot draw pictures of this size.
        """
        return importlib.import_module(self.room).load_cameras(self, inputs, cameras)

    def draw_page(
        self, renderer: "model.methods.renderer.Renderer", scene: "datagen.scene.description.Scene"
    ) -> "model.methods.page.MethodPage":
        """What a page in a browser needs to draw a trained renderer as Python does; a method with a `page` has it."""
        return importlib.import_module(self.page).draw_page(self, renderer, scene)
