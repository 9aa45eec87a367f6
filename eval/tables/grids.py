"""Tables without formatting, and the numbers in them."""

import math
from dataclasses import dataclass

from datagen.data.config import Split

MISSING = "–"  # noqa: RUF001  An en dash, as tables have it.
CEILING = "noise ceiling"
SHORT_SPLITS: dict[Split, str] = {
    "train": "train",
    "interpolating": "inter",
    "extrapolating": "extra",
    "extrapolating-10deg": "10°",
    "extrapolating-20deg": "20°",
    "extrapolating-40deg": "40°",
}
TABLE_WIDTH = 120


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column's header; neighbours with the same group share it."""

    group: str
    split: Split | None = None
    is_number: bool = True


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table without formatting."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    last_row_apart: bool = False
    notes: tuple[str, ...] = ()
    best: frozenset[tuple[int, int]] = frozenset()
    """Row and column of the best values of their columns."""


def format_number(value: float | None, decimals: int) -> str:
    if value is None:
        return MISSING
    return "∞" if math.isinf(value) else f"{value:.{decimals}f}"


def ceiling_text(value: float | None) -> str:
    """A noise ceiling in dB; unknown for imported pictures."""
    return "unknown" if value is None else format_number(value, 2)


def psnr_text(value: float | None) -> str:
    """The PSNR of one picture for its caption; empty if it has none."""
    if value is None:
        return ""
    return "PSNR ∞ (identical)" if math.isinf(value) else f"PSNR {value:.2f} dB"
