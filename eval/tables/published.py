"""The paper's own numbers, printed for reference."""

from dataclasses import dataclass

from datagen.data.config import TEST_SPLITS, Split
from datagen.disk.records import Json, to_json
from eval.tables.grids import Column, Grid


@dataclass(frozen=True, kw_only=True)
class PublishedRow:
    """One line of the paper's tables."""

    source: str
    method: str
    interpolating_db: float
    extrapolating_db: float

    def value_db(self, split: Split) -> float:
        return self.interpolating_db if split == "interpolating" else self.extrapolating_db


NO_EXTRINSICS = PublishedRow(source="Table 1", method="no extrinsics", interpolating_db=33.09, extrapolating_db=32.96)
VIEW_VECTOR = PublishedRow(
    source="Table 1, 2", method="view vector (Ours)", interpolating_db=33.19, extrapolating_db=32.99
)
SPHERICAL_HARMONICS = PublishedRow(
    source="Table 1", method="spherical harmonics", interpolating_db=33.80, extrapolating_db=32.52
)
DNR = PublishedRow(source="Table 2", method="DNR", interpolating_db=33.52, extrapolating_db=30.86)

PUBLISHED = (NO_EXTRINSICS, VIEW_VECTOR, SPHERICAL_HARMONICS, DNR)
"""Source: the paper's Tables 1 and 2, PSNR in dB."""

PUBLISHED_NOTE = (
    "Not comparable with the tables above: other scenes, and most likely the wrapped PSNR, since the authors' released "
    "script squares 8-bit differences in 8 bits."
)


def published_grid() -> Grid:
    """The paper's own numbers."""
    return Grid(
        title="Published: the paper's PSNR dB, for reference only",
        columns=(
            Column(group="paper", is_number=False),
            Column(group="method", is_number=False),
            *(Column(group="PSNR dB", split=split) for split in TEST_SPLITS),
        ),
        rows=tuple(
            (row.source, row.method, f"{row.interpolating_db:.2f}", f"{row.extrapolating_db:.2f}") for row in PUBLISHED
        ),
        notes=(PUBLISHED_NOTE,),
    )


def published_json() -> Json:
    """The paper's own numbers for results.json."""
    return {"note": PUBLISHED_NOTE, "rows": [to_json(row) for row in PUBLISHED]}
