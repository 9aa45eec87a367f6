"""What a user may say about a file that is imported: the flags of `datagen import`, and of `datagen build FILE`."""

from dataclasses import dataclass, fields
from typing import Literal

from datagen.disk.errors import HyalineError

Thin = Literal["open", "file", "all"]


@dataclass(frozen=True, kw_only=True)
class ImportChoices:
    """For files from other programs: what the file lacks, and how to read it."""

    scale: float | None = None
    """Metres per unit of the file, such as 0.001 for millimetres. Default: the format's own unit, or a reported guess
    if the scene would be smaller than 2 cm or larger than 5 m."""
    up: Literal["auto", "x", "y", "z"] = "auto"
    """The file's axis that points up; auto: as usual for the format (y in glTF, OBJ and PLY, z in STL)."""
    material: tuple[str, ...] = ()
    """A material by name for all objects (glass, green-glass, water, diamond, thin-glass, plaster, plastic, mirror,
    gold, ...), or for those whose name matches a pattern: 'leg*=gold'. May be repeated; later ones win."""
    thin: Thin = "open"
    """Which glass becomes thin panes. open: only open meshes; file: also materials that the file marks as thin-walled;
    all: all glass."""
    cameras: str = "around"
    """Cameras all around the glass (around), those in the file (file), or those of a transforms.json or a COLMAP
    folder, in the file's own axes and units."""
    ground: Literal["auto", "always", "never"] = "auto"
    """Add a checkered ground: if nothing lies below the glass (auto), always or never."""
    repair: bool = False
    """Close holes in glass meshes (open ones otherwise become thin panes); import.json records the volume before and
    after. Glass that cannot be closed without changing its volume by more than 5 % is left
    out, unless no other glass is in the file."""
    merge: bool = False
    """Merge all surfaces of a material into one object: a scene has at most 255 objects."""
    crease: float | None = None
    """Recompute the shading normals, with an edge where faces meet at more than this many degrees, such as 30; 0 makes
    every face flat. Default: the file's normals; if it has none, 0 for glTF, 40 for OBJ, PLY and STL."""
    strict: bool = False
    """Fail if any feature of the file cannot be reproduced."""

    def __post_init__(self) -> None:
        if self.scale is not None and not 1e-9 < self.scale < 1e9:
            raise HyalineError(f"--scale: is {self.scale:g}; expected metres per unit, such as 0.001 for millimetres")
        if self.crease is not None and not 0 <= self.crease <= 180:
            raise HyalineError(f"--crease: is {self.crease:g}; expected 0 to 180 degrees")

    def given(self) -> list[str]:
        """The flags that differ from their defaults."""
        names = (item.name for item in fields(self) if getattr(self, item.name) != item.default)
        return [f"--{name.replace('_', '-')}" for name in names]
