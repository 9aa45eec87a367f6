"""What the paper tried without success: DeepVoxels (section 5.1), and larger pictures (section 8)."""

import dataclasses
import functools
import math
from collections.abc import Sequence

import numpy as np

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import NO_GEOMETRY
from datagen.data.variants import is_larger
from datagen.disk.errors import HyalineError
from eval.analyses.variants import Enlarged, VariantScores, score_enlarged, score_variants, super_resolution_grid
from eval.score.metrics import psnr, psnr_uint8_wrap
from eval.score.scores import SceneScores
from eval.score.seeds import group_seeds
from eval.tables.grids import MISSING, SHORT_SPLITS, Column, Grid, format_number
from eval.tables.named import Table
from hyaline_paper.comparisons import NOT_RUN, WRAPPED_NOTE, Line, data_note, spread_cell

DEEP_VOXELS = (
    Line(title="DeepVoxels, small", method="deepvoxels", geometry=NO_GEOMETRY),
    Line(title="DeepVoxels", method="deepvoxels-paper", geometry=NO_GEOMETRY),
)
SCORES = {
    "psnr_db": ("PSNR dB ↑", psnr),
    "psnr_uint8_wrap_db": ("wrapped (authors' script)", psnr_uint8_wrap),
}
FAILS_BELOW_DB = 3.0
"""What gains less over one picture that is shown for all cameras has hardly learned the scene."""


def mean_picture_score(dataset: Dataset, split: Split, key: str) -> float:
    """The score of the mean of all training pictures, shown for every camera of a split."""
    mean = np.rint(np.mean([view.image for view in dataset.views("train")], axis=0)).astype(np.uint8)
    values = [SCORES[key][1](mean, view.image) for view in dataset.views(split)]
    return math.fsum(values) / len(values)


def deep_voxels_grid(scenes: Sequence[SceneScores]) -> Grid:
    """DeepVoxels on each scene beside the mean of the training pictures, scenes without glass first."""
    rows: list[tuple[str, ...]] = []
    findings = []
    for scene in sorted(scenes, key=_has_glass):
        floors = {
            (key, split): mean_picture_score(scene.dataset, split, key) for key in SCORES for split in TEST_SPLITS
        }
        about = (scene.title, "glass" if _has_glass(scene) else "no glass")
        for line in DEEP_VOXELS:
            groups = [group for group in group_seeds(scene.runs) if line.fits(group.first)]
            for group in groups:
                scores = {(key, split): group.score(key, split) for key in SCORES for split in TEST_SPLITS}
                rows.append((*about, line.title, str(len(group.runs)), *map(spread_cell, scores.values())))
                gain = (scores["psnr_db", "interpolating"].mean or 0.0) - floors["psnr_db", "interpolating"]
                verdict = "fails" if gain < FAILS_BELOW_DB else "works"
                findings.append(f"{line.title} {verdict} on {scene.title} ({about[1]}, {gain:+.2f} dB)")
            if not groups:
                rows.append((*about, line.title, NOT_RUN, *[MISSING] * len(floors)))
        rows.append((*about, "mean of the training pictures", MISSING, *(f"{floor:.2f}" for floor in floors.values())))
    seals = ", ".join(f"{scene.title} {scene.dataset.seal[:12]}" for scene in scenes)
    return Grid(
        title="DeepVoxels with and without glass",
        columns=(
            *(Column(group=text, is_number=False) for text in ("scene", "glass", "run")),
            Column(group="seeds"),
            *(Column(group=title, split=split) for title, _ in SCORES.values() for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=(
            f"Interpolating, against the mean of the training pictures: {'; '.join(findings) or NOT_RUN}. Below "
            f"{FAILS_BELOW_DB:.0f} dB it is said to fail. The paper shows blurred pictures of a room with glass, and "
            "names no number.",
            WRAPPED_NOTE,
            f"Data: dataset seals {seals}.",
        ),
    )


def _has_glass(scene: SceneScores) -> bool:
    return any(item.is_glass for item in scene.dataset.objects)


DEEP_VOXELS_TABLE = Table(
    shows=lambda run: any(line.fits(run) for line in DEEP_VOXELS),
    grids=lambda scenes, _: [deep_voxels_grid(scenes)] if scenes else [],
    needs_more=True,
)


def larger_grid(scene: SceneScores) -> Grid:
    """What runs draw at larger sizes than they were trained at, beside their small pictures enlarged."""
    scaled = [(scored, score_enlarged(scene, scored)) for scored in _score_larger(scene)]
    grid = super_resolution_grid(scene, scaled)
    note = (
        "The paper expects larger pictures to be at least as good as the small ones, and found severe artifacts. Drawn "
        f"larger against the same run's small pictures enlarged, dB: {'; '.join(_gains(scaled)) or NOT_RUN}."
    )
    rows = grid.rows or ((NOT_RUN, *[MISSING] * (len(grid.columns) - 1)),)
    return dataclasses.replace(grid, rows=rows, notes=(note, *grid.notes, data_note(scene)))


@functools.lru_cache(maxsize=8)
def _score_larger(scene: SceneScores) -> list[VariantScores]:
    """The scores of larger pictures, which a scene's table and its sheet share."""
    errors: list[HyalineError] = []
    found = score_variants(scene, errors, of=is_larger)
    if errors:
        raise errors[0]
    return found


def _gains(scaled: Sequence[tuple[VariantScores, Enlarged]]) -> list[str]:
    texts = []
    for scored, enlarged in scaled:
        for name, scores in scored.runs.items():
            for split in TEST_SPLITS:
                drawn, small = scores.mean("psnr_db", split), enlarged[name][split]
                other = None if small is None else small.mean("psnr_db")
                gain = None if drawn is None or other is None else drawn - other
                size = scored.variant.config.resolution
                texts.append(f"{name} at {size}, {SHORT_SPLITS[split]}, {format_number(gain, 2)}")
    return texts


def _picture(scene: SceneScores) -> bytes | None:
    """The runs' pictures at the largest size."""
    from eval.figures import comparison_sheet

    largest = max(_score_larger(scene), key=lambda scored: scored.variant.config.resolution.pixels, default=None)
    if largest is None:
        return None
    drawn = dataclasses.replace(
        scene, dataset=largest.variant, truths=largest.truths, runs=tuple(largest.runs.values())
    )
    sizes = scene.dataset.config.resolution, largest.variant.config.resolution
    return comparison_sheet(drawn, f"trained at {sizes[0]}, drawn at {sizes[1]}")


LARGER = Table(
    shows=lambda run: run.method in ("paper", "dnr-layers", "light-path"),
    grids=lambda scenes, _: [larger_grid(scene) for scene in scenes],
    picture=_picture,
    needs_more=True,
)
