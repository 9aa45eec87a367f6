"""The scene that a word means: a built-in one, a folder, or one of a plug-in, such as an imported file."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from datagen.data.config import Resolution, square
from datagen.disk.errors import HyalineError, UsageError
from datagen.terminal.command import say
from datagen.terminal.plugins import Group

if TYPE_CHECKING:
    import numpy as np

    from datagen.scene.description import Scene

DEFAULT_RESOLUTION = square(128)


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
    ground: Literal["auto", "always", "never"] = "auto"
    """Add a checkered ground: if nothing lies below the glass (auto), always or never."""
    repair: bool = False
    """Close holes in glass meshes (open ones otherwise become thin panes); import.json records the volume before and
    after. Glass whose volume that would change by more than 5 % is left out, unless there is no other."""
    crease: float | None = None
    """Recompute the shading normals, with an edge where faces meet at more than this many degrees, such as 30; 0 makes
    every face flat. Default: the file's normals; if it has none, 0 for glTF, 40 for OBJ, PLY and STL."""

    def __post_init__(self) -> None:
        if self.scale is not None and not 1e-9 < self.scale < 1e9:
            raise HyalineError(f"--scale: is {self.scale:g}; expected metres per unit, such as 0.001 for millimetres")
        if self.crease is not None and not 0 <= self.crease <= 180:
            raise HyalineError(f"--crease: is {self.crease:g}; expected 0 to 180 degrees")

    def given(self) -> list[str]:
        """The flags that differ from their defaults."""
        names = (item.name for item in dataclasses.fields(self) if getattr(self, item.name) != item.default)
        return [f"--{name.replace('_', '-')}" for name in names]


@dataclass(frozen=True, kw_only=True)
class SceneSource:
    """Scenes that a plug-in brings: those of files, or those that code makes again from their names."""

    has: Callable[[str], bool]
    """Whether a word means one of its scenes, even one that cannot be made."""
    find: "Callable[[str, Resolution, ImportChoices], Scene]"
    """Makes the scene of a word, for pictures of this size."""
    is_of_files: bool
    """Its words are paths of files."""
    read_mesh: "Callable[[Path], tuple[np.ndarray, np.ndarray, np.ndarray | None]] | None" = None
    """Vertices, faces and uv of all objects in a file as one mesh."""
    name_of: Callable[[int, str | None], str] | None = None
    """The scene of a seed and a family, where the source's own name stands for any of them, as `random` does."""
    families: Callable[[], tuple[str, ...]] = tuple


SOURCES: Group[SceneSource] = Group(
    name="hyaline.scene_sources",
    what="source of scenes",
    guide="docs/extending.md",
    kind="datagen.scene.finding:SceneSource",
)


def find_source(given: str, *, is_of_files: bool) -> SceneSource | None:
    """The source of a scene, if one has it."""
    sources = (SOURCES.find(name) for name in SOURCES.names())
    return next((source for source in sources if source.is_of_files is is_of_files and source.has(given)), None)


def list_families() -> list[str]:
    """The families of random scenes."""
    return [family for name in SOURCES.names() for family in SOURCES.find(name).families()]


def numbered_scenes(given: str) -> SceneSource | None:
    """The source that numbers its scenes, if that is what a word means: `random`."""
    source = SOURCES.find(given) if given in SOURCES.names() else None
    return source if source is not None and source.name_of is not None else None


def find_scene(
    given: str,
    *,
    resolution: Resolution = DEFAULT_RESOLUTION,
    imports: ImportChoices = ImportChoices(),  # noqa: B008
) -> "Scene":
    """The scene of a folder with a scene.json, a built-in one by its name, or one of a plug-in.

    Args:
        resolution: of the pictures, which the ground of an imported scene is made for.
        imports: how a file is imported.
    """
    from datagen.data.meshes import is_there
    from datagen.scene.builtin import make_scene
    from datagen.scene.folder import load_scene

    if (source := find_source(given, is_of_files=True)) is not None:
        return source.find(given, resolution, imports)
    if flags := imports.given():
        raise HyalineError(f"{flags[0]}: goes with a file that is imported, such as vase.glb; leave it out")
    kind = "file" if Path(given).is_file() else given.partition("-")[0]
    if Path(given).name != "scene.json" and (package := SOURCES.absent().get(kind)):
        raise UsageError(f"scene {given}: needs the plug-in {package}, which is not here")
    if (Path(given) / "scene.json").is_file():
        say(f"scene {given}: reading and checking it")
        scene = load_scene(Path(given))
        # That of an edit lists the objects that it removed.
        return dataclasses.replace(scene, objects=tuple(item for item in scene.objects if is_there(item.mesh)))
    if "/" in given:
        return load_scene(Path(given))
    if (source := find_source(given, is_of_files=False)) is not None:
        return source.find(given, resolution, imports)
    return make_scene(given)
