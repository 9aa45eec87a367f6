"""Super-resolution: what a run draws at twice the size and more, against truth of that size."""

import dataclasses

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import TEST_SPLITS, Resolution, Split
from datagen.data.dataset import Dataset
from datagen.data.variants import parent_views
from datagen.disk.records import Json
from eval.analyses.variants import VariantScores, splits_json, variant_json
from eval.score.kept import Kept, picture_digests
from eval.score.runs import read_prediction
from eval.score.scores import (
    RunScores,
    SceneScores,
    SplitScores,
    Truth,
    score_picture,
    scores_from_json,
    scores_json,
)
from eval.tables.grids import CEILING, MISSING, Column, Grid, format_number

KEYS = {"psnr_db": ("PSNR dB ↑", 2), "glass_psnr_db": ("PSNR glass dB ↑", 2), "ssim": ("SSIM ↑", 3)}
TRUTH_ENLARGED = "truth"
DRAWN, ENLARGED = "at that size", "enlarged"

SUPER_RESOLUTION_NOTES = (
    "At that size: the run, trained at the dataset's size, drew larger pictures. Enlarged: its pictures of the "
    "dataset's size, by cubic splines on sRGB (scikit-image). Truth, enlarged: the same of the true pictures.",
)


Enlarged = dict[str, dict[Split, SplitScores | None]]
"""Scores of enlarged pictures by the run's name; `TRUTH_ENLARGED` stands for the true ones."""


def score_enlarged(scene: SceneScores, scored: VariantScores, kept: Kept) -> Enlarged:
    """What the small pictures of each run that drew a larger variant are worth when they are enlarged."""
    runs = [scores for scores in scene.runs if scores.run.name in scored.runs]
    return {
        TRUTH_ENLARGED: _enlarged(scene.dataset, scored, None, kept),
        **{scores.run.name: _enlarged(scene.dataset, scored, scores, kept) for scores in runs},
    }


def enlarge(image: UInt8[np.ndarray, "h w 3"], size: Resolution) -> UInt8[np.ndarray, "tall wide 3"]:
    """A picture at another size by cubic splines through its pixels' centres, clipped; edges are repeated beyond."""
    from skimage.transform import resize

    values = np.asarray(resize(image / 255, size.shape, order=3, mode="edge", anti_aliasing=False))
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)


def super_resolution_grid(scene: SceneScores, scaled: list[tuple[VariantScores, Enlarged]]) -> Grid:
    """The table of all sizes."""
    rows: list[tuple[str, ...]] = []
    for scored, enlarged in scaled:
        size = str(scored.variant.config.resolution)
        listed = [(name, DRAWN, scores.splits) for name, scores in scored.runs.items()]
        listed += [(name, ENLARGED, splits) for name, splits in enlarged.items()]
        order = {name: place for place, name in enumerate([*scored.runs, TRUTH_ENLARGED])}
        for name, how, splits in sorted(listed, key=lambda row: order[row[0]]):
            rows.append(
                (
                    size,
                    name,
                    how,
                    *(
                        format_number(None if (values := splits[split]) is None else values.mean(key), decimals)
                        for key, (_, decimals) in KEYS.items()
                        for split in TEST_SPLITS
                    ),
                )
            )
        ceilings = [format_number(scored.truths[split].ceiling_db, 2) for split in TEST_SPLITS]
        rows.append((size, CEILING, "", *ceilings, *[MISSING] * (len(TEST_SPLITS) * (len(KEYS) - 1))))
    texts = ("size", "run", "pictures")
    return Grid(
        title=f"{scene.title}: super-resolution, trained at {scene.dataset.config.resolution}",
        columns=(
            *(Column(group=text, is_number=False) for text in texts),
            *(Column(group=title, split=split) for title, _ in KEYS.values() for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=SUPER_RESOLUTION_NOTES,
    )


def super_resolution_json(scored: VariantScores, enlarged: Enlarged) -> dict[str, Json]:
    """The scores of the drawn pictures, and those of enlarged ones beside them."""
    return {
        **variant_json(scored),
        "resolution": dataclasses.asdict(scored.variant.config.resolution),
        "enlarged": {name: splits_json(splits) for name, splits in enlarged.items()},
    }


def _enlarged(
    dataset: Dataset, scored: VariantScores, scores: RunScores | None, kept: Kept
) -> dict[Split, SplitScores | None]:
    """The scores of enlarged predictions; of the enlarged truth without a run."""
    splits: dict[Split, SplitScores | None] = {}
    for split, truth in scored.truths.items():
        if scores is not None and scores.splits[split] is None:
            splits[split] = None
            continue
        small: Json = list(picture_digests(dataset, split) if scores is None else scores.digests[split])
        about: Json = [truth.digest, small, list(parent_views(scored.variant, split))]
        data = kept.get("enlarged", about, lambda truth=truth: scores_json(_score_enlarged(dataset, truth, scores)))
        splits[split] = scores_from_json(data)
    return splits


def _score_enlarged(dataset: Dataset, truth: Truth, scores: RunScores | None) -> SplitScores:
    split, size = truth.split, truth.dataset.config.resolution
    rows = []
    for place, view in enumerate(parent_views(truth.dataset, split)):
        small = dataset.view(split, view).image if scores is None else read_prediction(scores.run, split, view)
        glass = None if truth.glass is None else truth.glass[place]
        rows.append(score_picture(enlarge(small, size), truth.images[place], glass))
    return SplitScores(images={key: tuple(row[key] for row in rows) for key in rows[0]})
