"""Meshes of a glTF file that Draco has compressed; decoded in a process of its own, since that is native code.

Source: KHR_draco_mesh_compression.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.machine.child_python import ChildError, arrays_from_child
from datagen.scene.importers.fields import Fields
from datagen.scene.importers.gltf_arrays import WIDTHS, GltfArrays
from datagen.terminal.distribution import install_command

TIMEOUT_S = 60


def read_draco(arrays: GltfArrays, draco: Fields, wanted: dict[str, str]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Attributes of the vertices, and the vertices of the corners in order.

    Args:
        wanted: the type of each attribute by its name.

    Raises:
        HyalineError: DracoPy is not installed, or the bytes cannot be decoded.
    """
    if importlib.util.find_spec("DracoPy") is None:
        raise HyalineError(
            f"{draco.where}: is compressed by Draco; `{install_command('generate')}` brings what reads it, "
            "or export the file without compression"
        )
    ids = draco.fields("attributes")
    names = [name for name in wanted if name in ids]
    if "POSITION" not in names:
        raise HyalineError(f"{ids.where}: has no POSITION; export the file again")
    view, _ = arrays.file.buffer_view(draco.integer("bufferView"), where=draco.where)
    found = _decode(bytes(view), {name: ids.integer(name) for name in names}, where=draco.where)
    attributes = {name: found[name].astype(np.float64) for name in names}
    for name, values in attributes.items():
        if values.shape != (len(attributes["POSITION"]), WIDTHS[wanted[name]]) or not np.isfinite(values).all():
            raise HyalineError(f"{draco.where}: its {name} are no {wanted[name]} of finite numbers; export it again")
    return attributes, found["faces"].astype(np.int64).reshape(-1)


def _decode(data: bytes, ids: dict[str, int], *, where: str) -> dict[str, np.ndarray]:
    words = tuple(f"{name}={unique}" for name, unique in ids.items())
    try:
        return arrays_from_child(
            "datagen.scene.importers.gltf_draco",
            {"draco": np.frombuffer(data, np.uint8)},
            timeout_s=TIMEOUT_S,
            words=words,
        )
    except ChildError as error:
        raise HyalineError(f"{where}: Draco cannot read it ({error}); export the file again") from None


def _child(source: Path, target: Path, ids: dict[str, int]) -> None:
    import DracoPy  # pyright: ignore[reportMissingImports]

    with np.load(source) as arrays:
        mesh = DracoPy.decode(arrays["draco"].tobytes())
    found = {"faces": np.asarray(mesh.faces)}
    for attribute in mesh.attributes:
        for name, unique in ids.items():
            if attribute["unique_id"] == unique:
                found[name] = np.asarray(attribute["data"])
    np.savez(target, allow_pickle=False, **found)


if __name__ == "__main__":
    _child(Path(sys.argv[1]), Path(sys.argv[2]), {k: int(v) for k, v in (word.split("=") for word in sys.argv[3:])})
