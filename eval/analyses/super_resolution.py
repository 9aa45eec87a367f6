"""Owns super-resolution: what a run draws at twice the size and more, against truth of that size."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, open_dataset, read_image
from datagen.data.variants import ANGLES, annex_root, list_annex_folders, parent_views
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, to_json
from datagen.terminal.command import track
from eval.analyses.angle_scores import splits_json
from eval.score.runs import has_split, read_prediction, within
from eval.score.scores import RunScores, SceneScores, SplitScores, Truth, read_truth, score_picture, score_run
from eval.tables.grids import CEILING, MISSING, Column, Grid, format_number

KEYS = {"psnr_db": ("PSNR dB ↑", 2), "glass_psnr_db": ("PSNR glass dB ↑", 2), "ssim": ("SSIM ↑", 3)}
TRUTH_ENLARGED = "truth"
DRAWN, ENLARGED = "at that size", "enlarged"

SUPER_RESOLUTION_NOTES = (
    "At that size: the run, trained at the dataset's size, drew larger pictures. Enlarged: its pictures of the "
    "dataset's size, by cubic splines on sRGB (scikit-image). Truth, enlarged: the same of the true pictures.",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class ScaledScores:
    """Scores at one size, by the run's name; `truth` stands for the true pictures enlarged."""

    annex: Dataset
    """The truth of that size."""
    ceilings_db: dict[Split, float]
    drawn: dict[str, dict[Split, SplitScores | None]]
    enlarged: dict[str, dict[Split, SplitScores | None]]


def score_scaled(scene: SceneScores, errors: list[HyalineError]) -> list[ScaledScores]:
    """The scores at every size that a run has drawn; what pictures or truth lack is added to `errors`."""
    names = [folder.name for folder in list_annex_folders(scene.dataset.root) if folder.name != ANGLES]
    scored = []
    for name in names:
        if any((known.run.folder / name).is_dir() for known in scene.runs):
            try:
                scored.append(_score_annex(scene, open_dataset(annex_root(scene.dataset.root, name)), errors))
            except HyalineError as error:
                errors.append(error)
    return scored


def enlarge(image: UInt8[np.ndarray, "h w 3"], size: int) -> UInt8[np.ndarray, "size size 3"]:
    """A picture at another size by cubic splines through its pixels' centres, clipped; edges are repeated beyond."""
    from skimage.transform import resize

    values = np.asarray(resize(image / 255, (size, size), order=3, mode="edge", anti_aliasing=False))
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)


def super_resolution_grid(scene: SceneScores, scaled: list[ScaledScores]) -> Grid:
    """The table of all sizes."""
    rows: list[tuple[str, ...]] = []
    for scores in scaled:
        size = f"{scores.annex.config.resolution}²"
        listed = [(name, DRAWN, splits) for name, splits in scores.drawn.items()]
        listed += [(name, ENLARGED, splits) for name, splits in scores.enlarged.items()]
        order = {name: place for place, name in enumerate([*scores.drawn, TRUTH_ENLARGED])}
        for name, how, splits in sorted(listed, key=lambda row: order[row[0]]):
            rows.append((size, name, how, *(
                format_number(None if (values := splits[split]) is None else values.mean(key), decimals)
                for key, (_, decimals) in KEYS.items()
                for split in TEST_SPLITS
            )))  # fmt: skip
        ceilings = [format_number(scores.ceilings_db[split], 2) for split in TEST_SPLITS]
        rows.append((size, CEILING, "", *ceilings, *[MISSING] * (len(TEST_SPLITS) * (len(KEYS) - 1))))
    texts = ("size", "run", "pictures")
    return Grid(
        title=f"{scene.title}: super-resolution, trained at {scene.dataset.config.resolution}²",
        columns=(
            *(Column(group=text, is_number=False) for text in texts),
            *(Column(group=title, split=split) for title, _ in KEYS.values() for split in TEST_SPLITS),
        ),
        rows=tuple(rows),
        notes=SUPER_RESOLUTION_NOTES,
    )


def super_resolution_json(scaled: list[ScaledScores]) -> Json:
    """By size in pixels: noise ceilings, and of every run the scores of drawn and of enlarged pictures."""
    sizes: dict[str, Json] = {
        str(scores.annex.config.resolution): {
            "noise_ceiling_db": to_json(scores.ceilings_db),
            "drawn": {name: splits_json(splits) for name, splits in scores.drawn.items()},
            "enlarged": {name: splits_json(splits) for name, splits in scores.enlarged.items()},
        }
        for scores in scaled
    }
    return sizes


def _score_annex(scene: SceneScores, annex: Dataset, errors: list[HyalineError]) -> ScaledScores:
    truths: dict[Split, Truth] = {split: read_truth(annex, split) for split in annex.splits}
    scores = ScaledScores(
        annex=annex,
        ceilings_db={split: truth.ceiling_db for split, truth in truths.items()},
        drawn={},
        enlarged={TRUTH_ENLARGED: _enlarged(scene.dataset, annex, truths, None)},
    )
    for known in track(scene.runs, label=f"scoring {annex.root}", total=len(scene.runs)):
        try:
            run = within(known.run, known.run.folder / annex.root.name, annex)
            if any(has_split(run, split) for split in truths):
                scores.drawn[run.name] = score_run(run, truths).splits
                scores.enlarged[run.name] = _enlarged(scene.dataset, annex, truths, known)
        except HyalineError as error:
            errors.append(error)
    return scores


def _enlarged(dataset: Dataset, annex: Dataset, truths: dict[Split, Truth],
              scores: RunScores | None) -> dict[Split, SplitScores | None]:  # fmt: skip
    """The scores of enlarged predictions; of the enlarged truth without a run."""
    size = annex.config.resolution
    splits: dict[Split, SplitScores | None] = {}
    for split, truth in truths.items():
        if scores is not None and scores.splits[split] is None:
            splits[split] = None
            continue
        rows = []
        for place, view in enumerate(parent_views(annex, split)):
            small = read_image(dataset, split, view) if scores is None else read_prediction(scores.run, split, view)
            glass = None if truth.glass is None else truth.glass[place]
            rows.append(score_picture(enlarge(small, size), truth.images[place], glass))
        splits[split] = SplitScores(images={key: tuple(row[key] for row in rows) for key in rows[0]})
    return splits
