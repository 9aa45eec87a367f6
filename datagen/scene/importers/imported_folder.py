"""The folder of an imported scene: scene.json, meshes, textures, and import.json, which makes the folder ours."""

from collections.abc import Mapping
from pathlib import Path
from typing import cast

from datagen.disk.errors import HyalineError
from datagen.disk.names import check_relative
from datagen.disk.ownership import FolderKind, begin, holding, is_ours, refuse_others, refuse_taken, remove_files
from datagen.disk.records import Json
from datagen.disk.storage import commit, commit_sealed, load_sealed, seal_bytes

RECORD = "import.json"
IMPORTED = FolderKind(what="imported scene", head=RECORD, folders=("meshes", "textures", "baked"))


def check_free(root: Path, *, overwrite: bool) -> None:
    """Refuses a folder that something else stands in, before work is done for it.

    Raises:
        HyalineError: naming what stands there.
    """
    if is_ours(root, IMPORTED):
        if not overwrite:
            raise HyalineError(f"{root}: holds an imported scene; pass --overwrite to replace it, or another --out")
        return
    refuse_others(root, IMPORTED)


def write_imported(files: Mapping[str, bytes], record: Mapping[str, Json], root: Path, *, overwrite: bool) -> None:
    """Writes a scene's files and the record of its import; what an earlier import wrote there is removed.

    Raises:
        HyalineError: something else stands there.
    """
    content: dict[str, Json] = {**record, "files": cast(list[Json], sorted(files))}
    with holding(root, IMPORTED):
        check_free(root, overwrite=overwrite)
        before = _listed(root) if is_ours(root, IMPORTED) else []
        refuse_taken(root, IMPORTED, files, before)
        # What a killed command leaves is ours, and no scene, since scene.json comes last.
        remove_files(root, [path for path in before if path not in files or path == "scene.json"])
        begin(root, IMPORTED, seal_bytes(content), files)
        commit_sealed(root / RECORD, content)
        for path in sorted(files, key=lambda path: (path == "scene.json", path)):
            commit(root / path, files[path])


def _listed(root: Path) -> list[str]:
    listed = load_sealed(root / RECORD).get("files")
    paths = listed if isinstance(listed, list) else []
    return [check_relative(path, where=str(root / RECORD)) for path in paths if isinstance(path, str)]
