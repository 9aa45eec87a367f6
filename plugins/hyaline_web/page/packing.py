"""Arrays as text in a page: in few bits where asked for, sorted by bytes, deflated, base64."""

import base64
import zlib
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Int32, Shaped, UInt16, UInt32

from datagen.disk.records import Json

Quality = Literal["small", "exact"]
"""small: texels, normals and uv in few bits. exact: every number as it is."""

DTYPES = ("uint8", "uint16", "uint32", "float32", "float64")
"""Number types that unpack.js reads."""

MEMORY = 6
"""zlib's memory level: with a low one, few numbers share a code table, which then fits them better."""

POSITION_STEPS = 0xFFFF
"""Steps of a vertex's position along each side of its object's box."""

NORMAL_STEPS = 0xFFFFFE
"""Steps of a coordinate of an octahedral normal in 24 bits: an even number, so that 0 is exact."""


@dataclass(kw_only=True)
class Packed:
    """Named arrays in the order in which they are added."""

    entries: list[Json] = field(default_factory=list)
    """The description of each array for unpack.js."""
    parts: list[bytes] = field(default_factory=list)

    def add(self, name: str, values: Shaped[np.ndarray, "*shape"], *, differences: bool = False) -> None:
        """One more array.

        Args:
            differences: store how each row differs from the one before it, of whole numbers that change little.
        """
        assert values.dtype.name in DTYPES
        self.entries.append(
            {"name": name, "dtype": values.dtype.name, "shape": list(values.shape), "differences": differences}
        )
        if differences:
            # In as many bits as the numbers have: a difference that does not fit wraps around, there and back.
            signed = np.dtype(f"i{values.itemsize}")
            steps = np.diff(values, axis=0, prepend=np.zeros_like(values[:1])).view(signed)
            values = ((steps << 1) ^ (steps >> (8 * values.itemsize - 1))).view(values.dtype)
        rows = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1)
        # Equal bytes of numbers that belong together lie side by side: they deflate well.
        raw = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), rows.shape[1], values.itemsize)
        self.parts.append(np.ascontiguousarray(raw.transpose(1, 2, 0)).tobytes())

    def text(self) -> str:
        """All arrays, as unpack.js reads them; equal arrays give equal text."""
        packer = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, MEMORY, zlib.Z_FILTERED)
        return base64.b64encode(packer.compress(b"".join(self.parts)) + packer.flush()).decode()


def fold_normals(normals: Float32[np.ndarray, "vertex 3"]) -> Float32[np.ndarray, "vertex 2"]:
    """Unit vectors as points of an unfolded octahedron (as `data.number_formats.encode_directions`), in floats."""
    d = normals.astype(np.float64)
    d /= np.abs(d).sum(axis=1, keepdims=True)
    folded = (1 - np.abs(d[:, [1, 0]])) * np.where(d[:, :2] >= 0, 1, -1)
    return np.where(d[:, 2:] < 0, folded, d[:, :2]).astype(np.float32)


def quantize_normals(normals: Float32[np.ndarray, "vertex 3"]) -> UInt32[np.ndarray, "vertex 2"]:
    """The same in 24 bits each way: in 16, refraction through curved glass would lose 4 dB."""
    return np.rint((fold_normals(normals).astype(np.float64) + 1) / 2 * NORMAL_STEPS).astype(np.uint32)


def quantize_positions(
    vertices: Float32[np.ndarray, "vertex 3"],
) -> tuple[UInt16[np.ndarray, "vertex 3"], list[float], list[float]]:
    """Positions as whole numbers, the corner of their box, and how long a step is; where a side is flat it is 0."""
    if not len(vertices):
        return np.zeros((0, 3), np.uint16), [0.0] * 3, [0.0] * 3
    wide = vertices.astype(np.float64)
    low = wide.min(axis=0)
    step = np.ptp(wide, axis=0) / POSITION_STEPS
    codes = np.rint((wide - low) / np.where(step > 0, step, 1)).astype(np.uint16)
    return codes, low.tolist(), step.tolist()


def residuals(codes: Int32[np.ndarray, "h w c"], counts: Bool[np.ndarray, "h w"]) -> Int32[np.ndarray, "h w c"]:
    """How each number differs from its guess: left plus above less above left, but not beyond left and above.

    Args:
        counts: texels that matter; the others become equal to their prediction, so that their residual is 0.

    Source: the predictor of LOCO-I (Weinberger et al. 2000). floats.js reads it back.
    """
    height, width, _ = codes.shape
    known, left_over = codes.copy(), np.zeros_like(codes)
    # All texels of a diagonal have their neighbours on the two before it.
    for diagonal in range(height + width - 1):
        y = np.arange(max(0, diagonal - width + 1), min(diagonal, height - 1) + 1)
        x = diagonal - y
        has_left, has_above = (x > 0)[:, None], (y > 0)[:, None]
        above = np.where(has_above, known[y - 1, x], 0)
        left = np.where(has_left, known[y, x - 1], above)
        above = np.where(has_above, above, left)
        corner = np.where(has_left & has_above, known[y - 1, x - 1], above)
        guess = np.clip(left + above - corner, np.minimum(left, above), np.maximum(left, above))
        left_over[y, x] = np.where(counts[y, x, None], codes[y, x] - guess, 0)
        known[y, x] = guess + left_over[y, x]
    return left_over


def zigzag(values: Int32[np.ndarray, "*shape"]) -> np.ndarray:
    """0, -1, 1, -2, 2, ... as 0, 1, 2, 3, 4, ...: (*shape,) int32, the high bytes of little numbers are 0."""
    return np.where(values < 0, -2 * values - 1, 2 * values).astype(np.int32)
