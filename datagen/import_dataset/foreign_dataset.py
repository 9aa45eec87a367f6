"""What the folder of another project's dataset holds, whatever its layout, before any picture is decoded."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from datagen.data.cameras import Lens

Role = Literal["train", "val", "test"]
ROLES: tuple[Role, ...] = get_args(Role)

Layout = Literal["refref", "openmaterial", "blender", "nerfstudio"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignView:
    """One picture and its camera."""

    picture: Path
    mask: Path | None
    """Not black where the object is seen."""
    depth: Path | None
    world_from_camera: Float[np.ndarray, "4 4"]
    """OpenGL convention, in the folder's units and axes."""


@dataclass(frozen=True, kw_only=True)
class ForeignSurface:
    """A mesh of the scene, and what is said of its material."""

    name: str
    file: Path
    ior: float | None = None
    absorption: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """1 over the folder's unit."""
    is_thin: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignDataset:
    """Everything that a folder names."""

    root: Path
    layout: Layout
    lens: Lens
    views: dict[Role, tuple[ForeignView, ...]]
    surfaces: tuple[ForeignSurface, ...]
    remarks: tuple[str, ...]
    """What is left out."""
    license: str | None = None
    """What its transforms file says of it, as exports of ours do."""

    @property
    def files(self) -> list[Path]:
        """Every file whose content becomes a part of the dataset."""
        views = [view for role in ROLES for view in self.views[role]]
        parts = [part for view in views for part in (view.picture, view.mask, view.depth) if part is not None]
        return [*parts, *(surface.file for surface in self.surfaces)]
