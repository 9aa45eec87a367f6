"""The table of the splits by angle: cameras 10, 20 and 40 degrees outside of what training covers."""

from datagen.data.config import ANGLE_SPLITS, Split
from eval.analyses.variants import VariantScores
from eval.score.scores import SceneScores
from eval.tables.grids import CEILING, MISSING, Column, Grid, format_number

KEYS = {"psnr_db": "PSNR dB ↑", "glass_psnr_db": "PSNR glass dB ↑"}

ANGLE_NOTES = (
    "10°, 20°, 40°: cameras so far outside of the directions that training cameras cover, at the training distance and "
    "aimed at the centre (datagen/build/angles.py); inter are those inside.",
)


def angle_grid(scene: SceneScores, scored: VariantScores) -> Grid:
    """The table of these scores, beside those of the interpolating split."""
    splits: list[Split] = ["interpolating", *ANGLE_SPLITS]
    inside = {scores.run.name: scores for scores in scene.runs}
    rows = []
    for name, scores in scored.runs.items():
        values = [
            (inside[name] if split == "interpolating" else scores).mean(key, split) for key in KEYS for split in splits
        ]
        rows.append((name, *(format_number(value, 2) for value in values)))
    ceilings = [scene.ceilings_db["interpolating"], *(scored.truths[split].ceiling_db for split in ANGLE_SPLITS)]
    rows.append((CEILING, *(format_number(value, 2) for value in ceilings), *[MISSING] * len(splits)))
    return Grid(
        title=f"{scene.title}: extrapolating by angle",
        columns=(
            Column(group="run", is_number=False),
            *(Column(group=title, split=split) for title in KEYS.values() for split in splits),
        ),
        rows=tuple(rows),
        last_row_apart=True,
        notes=ANGLE_NOTES,
    )
