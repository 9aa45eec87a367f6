"""What the paper tried without success: larger pictures (section 8)."""

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import TEST_SPLITS, Resolution, Split
from datagen.data.variants import evenly
from datagen.disk.errors import HyalineError
from eval.score.runs import read_prediction
from eval.score.scores import RunScores, SceneScores, SplitScores, Truth, score_picture
from eval.tables.grids import CEILING, MISSING, Column, Grid, format_number
from eval.tables.plugins import Table
from eval.variants import VariantScores, score_variants
from hyaline_paper.comparisons import NOT_RUN, data_note

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

    def enlarged(scores: RunScores | None) -> dict[Split, SplitScores | None]:
        return {split: _enlarged(scene, truth, scores) for split, truth in scored.truths.items()}

    small = {scores.run.name: scores for scores in scene.runs}
    for name, scores in scored.runs.items():
        yield row(name, DRAWN, scores.splits)
        yield row(name, ENLARGED, enlarged(small[name]))
    yield row("truth", ENLARGED, enlarged(None))
    ceilings = [format_number(scored.truths[split].ceiling_db, 2) for split in TEST_SPLITS]
    yield (size, CEILING, "", *ceilings, *[MISSING] * (len(TEST_SPLITS) * (len(KEYS) - 1)))


def _enlarged(scene: SceneScores, truth: Truth, scores: RunScores | None) -> SplitScores | None:
    """The scores of a run's enlarged predictions of a split, if it has some; without a run, of the enlarged truth."""
    split, size = truth.split, truth.dataset.config.resolution
    if scores is not None and scores.splits[split] is None:
        return None
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
