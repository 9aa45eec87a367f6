"""Arrays of a glTF file: what its accessors say about bytes in its buffers.

Source: glTF 2.0 section 3.6.2.
"""

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.scene.importers.fields import Fields
from datagen.scene.importers.gltf_file import GltfFile

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MAX_VALUES = 1 << 27
"""Numbers in one array."""


class GltfArrays:
    """The arrays of a file, each decoded once."""

    def __init__(self, file: GltfFile) -> None:
        self.file = file
        self._made: dict[int, np.ndarray] = {}

    def count(self, index: int, *, where: str) -> int:
        """How many elements an accessor promises."""
        accessor = self.file.item("accessors", index, where=where)
        return accessor.integer("count", low=1)

    def array(self, index: int, kind: str, *, where: str) -> np.ndarray:
        """The elements of an accessor: (n, width) of floats, normalised where it says so; or (n,) of indices.

        Raises:
            HyalineError: its bytes do not lie in a buffer, or its numbers are no finite ones of this kind.
        """
        accessor = self.file.item("accessors", index, where=where)
        found = accessor.text("type")
        if found != kind:
            raise HyalineError(f"{accessor.where}: is of type {found!r}; expected {kind!r}")
        if index not in self._made:
            self._made[index] = self._decode(accessor, WIDTHS[kind])
        return self._made[index]

    def _decode(self, accessor: Fields, width: int) -> np.ndarray:
        component = accessor.integer("componentType")
        if component not in COMPONENTS:
            raise HyalineError(f"{accessor.where}.componentType: is {component}; expected one of {[*COMPONENTS]}")
        dtype = np.dtype(COMPONENTS[component])
        count = accessor.integer("count", low=1)
        if count * width > MAX_VALUES:
            raise HyalineError(f"{accessor.where}: promises {count:,} elements; expected at most {MAX_VALUES // width}")
        raw: np.ndarray
        if "bufferView" in accessor:
            view, stride = self.file.buffer_view(accessor.integer("bufferView"), where=accessor.where)
            raw = _strided(view, accessor.integer("byteOffset", 0), count, width, dtype, stride, where=accessor.where)
        else:
            raw = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            raw = self._with_sparse(raw.copy(), accessor.fields("sparse"), dtype)
        if dtype.kind == "f":
            with np.errstate(invalid="ignore"):  # Some kinds of NaN warn when they are cast.
                values = raw.astype(np.float64)
            if not np.isfinite(values).all():
                raise HyalineError(f"{accessor.where}: holds numbers that are not finite; export the file again")
            return values
        if width == 1 and not accessor.flag("normalized"):
            return raw[:, 0].astype(np.int64)
        largest = float(2 ** (8 * dtype.itemsize - (dtype.kind == "i")) - 1)
        return np.maximum(raw / largest, -1.0) if accessor.flag("normalized") else raw.astype(np.float64)

    def _with_sparse(self, raw: np.ndarray, sparse: Fields, dtype: np.dtype) -> np.ndarray:
        count = sparse.integer("count", low=1, high=len(raw))
        places, values = sparse.fields("indices"), sparse.fields("values")
        component = places.integer("componentType")
        if component not in (5121, 5123, 5125):
            raise HyalineError(f"{places.where}.componentType: is {component}; expected 5121, 5123 or 5125")
        where_bytes, _ = self.file.buffer_view(places.integer("bufferView"), where=places.where)
        index_type = np.dtype(COMPONENTS[component])
        offset = places.integer("byteOffset", 0)
        index = _strided(where_bytes, offset, count, 1, index_type, 0, where=places.where)[:, 0].astype(np.int64)
        if index.max() >= len(raw):
            raise HyalineError(f"{places.where}: names element {index.max()}; expected at most {len(raw) - 1}")
        value_bytes, _ = self.file.buffer_view(values.integer("bufferView"), where=values.where)
        offset = values.integer("byteOffset", 0)
        raw[index] = _strided(value_bytes, offset, count, raw.shape[1], dtype, 0, where=values.where)
        return raw


def _strided(
    view: memoryview, offset: int, count: int, width: int, dtype: np.dtype, stride: int, *, where: str
) -> np.ndarray:
    """(count, width) numbers, of which each row begins `stride` bytes after the last; 0: where the last one ends."""
    size = width * dtype.itemsize
    stride = stride or size
    if stride < size:
        raise HyalineError(f"{where}: has elements of {size} bytes every {stride}; expected no overlap")
    end = offset + (count - 1) * stride + size
    if end > len(view):
        raise HyalineError(f"{where}: needs {end:,} bytes, its buffer view has {len(view):,}; export the file again")
    return np.ndarray((count, width), dtype, view, offset, (stride, dtype.itemsize))
