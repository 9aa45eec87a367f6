"""NumPy files of one plane of numbers, which anybody may have written."""

import io

import numpy as np
from jaxtyping import Float32

from datagen.disk.errors import HyalineError

MAX_NPY_BYTES = 1 << 30


def read_npy(data: bytes, *, where: str) -> Float32[np.ndarray, "h w"]:
    """A plane of finite numbers from the bytes of a .npy file; nothing in it is ever run.

    Raises:
        HyalineError: no such file, or not a plane of finite numbers.
    """
    buffer = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(buffer)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, _, dtype = read_header[version](buffer)
        if len(shape) == 3 and shape[2] == 1:
            shape = shape[:2]
        # A header may promise more than a machine has.
        if len(shape) != 2 or dtype.kind != "f" or np.prod(shape) * dtype.itemsize != len(data) - buffer.tell():
            raise ValueError(f"shape {shape} of {dtype} in {len(data):,} bytes")
        values = np.load(io.BytesIO(data), allow_pickle=False).reshape(shape).astype(np.float32)
    except (ValueError, KeyError, TypeError, OSError, OverflowError) as error:
        raise HyalineError(f"{where}: not a .npy of height x width numbers ({error}); expected floats") from error
    if not np.isfinite(values).all():
        raise HyalineError(f"{where}: holds numbers that are not finite; expected metres, 0 where nothing is")
    return values


def npy_bytes(values: np.ndarray) -> bytes:
    """The NumPy file of an array."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(values), allow_pickle=False)
    return buffer.getvalue()
