"""Files of other programs as a source of scenes: what `datagen build vase.glb` finds."""

from pathlib import Path
from typing import TYPE_CHECKING

from datagen.scene.finding import SceneSource
from datagen.terminal.command import say, say_all

if TYPE_CHECKING:
    import numpy as np

    from datagen.data.config import Resolution
    from datagen.scene.description import Scene
    from datagen.scene.finding import ImportChoices


def _is_foreign(given: str) -> bool:
    from hyaline_import.foreign_files import OTHER_ENDINGS, READERS, ending_of

    path = Path(given)
    ending = ending_of(path)
    if ending in ("", "json") or path.is_dir():
        return False
    return ending in READERS.names() or ending in OTHER_ENDINGS or path.is_file()


def _find(given: str, resolution: "Resolution", imports: "ImportChoices") -> "Scene":
    from hyaline_import.confined_import import imported_scene
    from hyaline_import.foreign_files import check_ending

    check_ending(Path(given))
    say(f"scene {given}: importing it")
    scene, told, _ = imported_scene(Path(given), imports, resolution=resolution)
    say_all(told)
    return scene


def _read_mesh(path: Path) -> "tuple[np.ndarray, np.ndarray, np.ndarray | None]":
    import numpy as np

    from datagen.machine.processes import confined
    from hyaline_import.foreign_files import check_ending

    check_ending(path)
    with confined(write_arrays, path.absolute(), where=str(path)) as folder, np.load(folder / "mesh.npz") as found:
        return found["vertices"], found["faces"], found.get("uv")


def write_arrays(folder: Path, path: Path) -> None:
    """Reads all objects of a file as one mesh, in the process that `confined` starts."""
    import numpy as np

    from datagen.machine.processes import allow_triangles
    from hyaline_import.foreign import joined
    from hyaline_import.foreign_files import READERS, ending_of
    from hyaline_import.remarks import Remarks

    whole = joined(READERS.find(ending_of(path))(path, Remarks()).objects)
    allow_triangles(len(whole.faces))
    arrays = {"vertices": whole.positions, "faces": whole.faces}
    np.savez(folder / "mesh.npz", allow_pickle=False, **arrays, **({} if whole.uv is None else {"uv": whole.uv}))


FILES = SceneSource(has=_is_foreign, find=_find, is_of_files=True, read_mesh=_read_mesh)
