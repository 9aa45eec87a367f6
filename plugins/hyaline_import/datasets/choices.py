"""The choices for importing a dataset: what its folder lacks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.disk.errors import HyalineError


@dataclass(frozen=True, kw_only=True)
class DatasetImportChoices:
    """The flags of `datagen import-dataset`."""

    mesh: tuple[Path, ...] = ()
    """A mesh of the scene in the cameras' own axes and units (PLY, OBJ, STL, GLB, ...), where the folder has none;
    may be repeated. Without meshes nothing can be peeled."""
    material: tuple[str, ...] = ()
    """A material by name for all meshes, or for those that match a pattern: 'foot*=gold', as `datagen import` takes
    them. Default: the material in the file, or else glass of the index --ior."""
    ior: float = 1.5
    """Index of refraction of glass."""
    scale: float = 1.0
    """Metres per unit of the cameras and the meshes."""
    up: Literal["x", "y", "z"] = "z"
    """The axis of the cameras' world that points up."""
    background: Literal["white", "black"] = "white"
    """Background for images with transparency."""

    def __post_init__(self) -> None:
        if not 1 < self.ior < 10:
            raise HyalineError(f"--ior: is {self.ior:g}; expected more than 1, and less than 10")
        if not 1e-9 < self.scale < 1e9:
            raise HyalineError(f"--scale: is {self.scale:g}; expected metres per unit, such as 0.001 for millimetres")
