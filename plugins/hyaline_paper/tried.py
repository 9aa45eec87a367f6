"""What the paper tried without success: DeepVoxels (section 5.1), and larger pictures (section 8)."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import TEST_SPLITS, Resolution, Split
from datagen.data.dataset import Dataset
from datagen.data.geometries import NO_GEOMETRY
from datagen.data.variants import evenly
from datagen.disk.errors import HyalineError
from eval.score.metrics import psnr, psnr_uint8_wrap
from eval.score.runs import read_prediction
from eval.score.scores import RunScores, SceneScores, SplitScores, Truth, group_seeds, score_picture
from eval.tables.grids import CEILING, MISSING, Column, Grid, format_number
from eval.tables.plugins import Table
from eval.variants import VariantScores, score_variants
from hyaline_paper.comparisons import NOT_RUN, WRAPPED_NOTE, Line, data_note, spread_cell

DEEP_VOXELS = (
    Line(title="DeepVoxels, small", method="deepvoxels", geometry=NO_GEOMETRY),
    Line(title="DeepVoxels", method="deepvoxels-paper", geometry=NO_GEOMETRY),
)
SCORES = {
    "psnr_db": ("PSNR dB ↑", psnr),
    "psnr_uint8_wrap_db": ("wrapped (authors' script)", psnr_uint8_wrap),
}


def mean_picture_score(dataset: Dataset, split: Split, key: str) -> float:
    """The score of the mean of all training pictures, shown for every camera of a split."""
    mean = np.rint(np.mean([view.image for view in dataset.views("train")], axis=0)).astype(np.uint8)
    values = [SCORES[key][1](mean, view.image) for view in dataset.views(split)]
    return math.fsum(values) / len(values)


def deep_voxels_grid(scenes: Sequence[SceneScores]) -> Grid:
    """DeepVoxels on each scene beside the mean of the training pictures, scenes without glass first."""
    rows: list[tuple[str, ...]] = []
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
            "The paper shows blurred pictures of a room with glass, and names no number.",
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


KEYS = {"psnr_db": ("PSNR dB ↑", 2), "glass_psnr_db": ("PSNR glass dB ↑", 2), "ssim": ("SSIM ↑", 3)}
DRAWN, ENLARGED = "at that size", "enlarged"


def larger_grid(scene: SceneScores) -> Grid:
    """What runs draw at larger sizes than they were trained at, beside their small pictures enlarged."""
    errors: list[HyalineError] = []
    found = score_variants(
        scene, errors, of=lambda variant: variant.config.resolution != scene.dataset.config.resolution
    )
    if errors:
        raise errors[0]
    rows = [row for scored in found for row in _larger_rows(scene, scored)]
    columns = (
        *(Column(group=text, is_number=False) for text in ("size", "run", "pictures")),
        *(Column(group=title, split=split) for title, _ in KEYS.values() for split in TEST_SPLITS),
    )
    return Grid(
        title=f"{scene.title}: super-resolution, trained at {scene.dataset.config.resolution}",
        columns=columns,
        rows=tuple(rows) or ((NOT_RUN, *[MISSING] * (len(columns) - 1)),),
        notes=(
            "The paper expects larger pictures to be at least as good as the small ones, and found severe artifacts. "
            "At that size: the run, trained at the dataset's size, drew larger pictures. Enlarged: its pictures of the "
            "dataset's size, by cubic splines on sRGB (scikit-image). Truth, enlarged: the same of the true pictures.",
            data_note(scene),
        ),
    )


def _larger_rows(scene: SceneScores, scored: VariantScores) -> Iterator[tuple[str, ...]]:
    """Each run's drawn and enlarged pictures of one size, the enlarged truth, and the noise ceiling."""
    size = str(scored.variant.config.resolution)

    def row(name: str, how: str, splits: Mapping[Split, SplitScores | None]) -> tuple[str, ...]:
        cells = (
            format_number(None if (scores := splits[split]) is None else scores.mean(key), decimals)
            for key, (_, decimals) in KEYS.items()
            for split in TEST_SPLITS
        )
        return (size, name, how, *cells)

    small = {scores.run.name: scores for scores in scene.runs}
    for name, scores in scored.runs.items():
        yield row(name, DRAWN, scores.splits)
        yield row(name, ENLARGED, _enlarged(scene, scored, small[name]))
    yield row("truth", ENLARGED, _enlarged(scene, scored, None))
    ceilings = [format_number(scored.truths[split].ceiling_db, 2) for split in TEST_SPLITS]
    yield (size, CEILING, "", *ceilings, *[MISSING] * (len(TEST_SPLITS) * (len(KEYS) - 1)))


def _enlarged(scene: SceneScores, scored: VariantScores, scores: RunScores | None) -> dict[Split, SplitScores | None]:
    """The scores of a run's enlarged predictions; without a run, of the enlarged truth."""
    return {
        split: _score_enlarged(scene, truth, scores) if scores is None or scores.splits[split] is not None else None
        for split, truth in scored.truths.items()
    }


def _score_enlarged(scene: SceneScores, truth: Truth, scores: RunScores | None) -> SplitScores:
    split, size = truth.split, truth.dataset.config.resolution
    rows = []
    drawn = evenly(truth.dataset.config.split(split).views, scene.dataset.config.split(split).views)
    for place, view in enumerate(drawn):
        small = scene.dataset.view(split, view).image if scores is None else read_prediction(scores.run, split, view)
        glass = None if truth.glass is None else truth.glass[place]
        rows.append(score_picture(enlarge(small, size), truth.images[place], glass))
    return SplitScores(images={key: tuple(row[key] for row in rows) for key in rows[0]})


def enlarge(image: UInt8[np.ndarray, "h w 3"], size: Resolution) -> UInt8[np.ndarray, "tall wide 3"]:
    """A picture at another size by cubic splines through its pixels' centres, clipped; edges are repeated beyond."""
    from skimage.transform import resize

    values = np.asarray(resize(image / 255, size.shape, order=3, mode="edge", anti_aliasing=False))
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)


LARGER = Table(
    shows=lambda run: run.record.method in ("paper", "dnr-layers", "light-path"),
    grids=lambda scenes, _: [larger_grid(scene) for scene in scenes],
    needs_more=True,
)
