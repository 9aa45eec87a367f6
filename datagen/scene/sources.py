"""Where scenes come from that are not built in: plug-ins that read files, or make scenes from names."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.terminal.plugins import Group

if TYPE_CHECKING:
    import numpy as np

    from datagen.data.config import Resolution
    from datagen.scene.description import Scene
    from datagen.scene.import_choices import ImportChoices


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
    built_in={},
    guide="docs/adding-a-reader.md",
    kind="datagen.scene.sources:SceneSource",
)
