"""What a user may say about an import."""

from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro

from datagen.disk.errors import HyalineError

Thin = Literal["open", "file", "all"]


@dataclass(frozen=True, kw_only=True)
class ImportChoices:
    """The flags of `datagen import`, which `datagen build --scene FILE` takes, too."""

    scale: float | None = None
    """Metres per unit of the file, such as 0.001 for millimetres. Unless given, the format's own unit; or a guess,
    which is said, where the scene would be smaller than 2 cm or larger than 5 m."""
    up: Literal["auto", "x", "y", "z"] = "auto"
    """The file's axis that points up; auto: as the format has it (y in glTF, OBJ and PLY, z in STL and 3MF)."""
    material: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A material by name for all objects (glass, green-glass, water, diamond, thin-glass, plaster, plastic, mirror,
    gold, ...), or for those whose name matches a pattern: 'leg*=gold'. May be repeated; later ones win."""
    thin: Thin = "open"
    """Glass that is drawn as thin panes: open meshes, also what the file calls thin-walled (file), or all."""
    cameras: str = "around"
    """Cameras all around the glass (around), those that the file brings (file), or those of a transforms.json or of a
    folder of COLMAP's, in the file's own axes and units."""
    lights: Literal["soft", "file"] = "soft"
    """Softboxes and dark flags all around in soft light, or the lamps that a glTF file brings, with a little of it."""
    ground: Literal["auto", "always", "never"] = "auto"
    """Add a checkered ground: where nothing lies below the glass, always or never."""
    repair: bool = False
    """Close the holes of glass that is open, which else becomes thin, and join overlapping parts of glass into one
    solid; import.json says the volume before and after, and a change of more than 5 % is refused."""
    merge: bool = False
    """Make one object of all surfaces of a material: a scene has at most 255 objects."""
    crease: float | None = None
    """Shade the file's surfaces anew, with an edge where faces meet at more than this many degrees, such as 30; 0 makes
    every face flat. Default: the file's normals, or 40 degrees where it has none."""
    max_triangles: int | None = None
    """Reduce surfaces until the scene has about this many triangles, each by the same share; needs the extra `proxies`.
    Surfaces with images keep theirs. A solid may change its volume by 5 %."""
    strict: bool = False
    """Refuse a file of which anything would be drawn other than it asks for."""

    def __post_init__(self) -> None:
        if self.scale is not None and not 1e-9 < self.scale < 1e9:
            raise HyalineError(f"--scale: is {self.scale:g}; expected metres a unit, such as 0.001 for millimetres")
        if self.crease is not None and not 0 <= self.crease <= 180:
            raise HyalineError(f"--crease: is {self.crease:g}; expected 0 to 180 degrees")

    def given(self) -> list[str]:
        """The flags that differ from their defaults."""
        names = (item.name for item in fields(self) if getattr(self, item.name) != item.default)
        return [f"--{name.replace('_', '-')}" for name in names]
