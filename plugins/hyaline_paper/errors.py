"""Where methods err: squared errors by what pixels show, and errors of highlights, over scenes."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float, UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.data.variants import LIGHT, TWINS, has_variant, open_variant, read_edit_mask
from datagen.disk.errors import HyalineError
from datagen.scene.folder import open_scene
from datagen.scene.materials import Conductor, Plastic
from eval.score.metrics import mean_of
from eval.score.runs import read_prediction
from eval.score.scores import SceneScores, SeedGroup, group_seeds
from eval.tables.grids import Column, Grid, format_number
from eval.tables.plugins import Table
from hyaline_paper.comparisons import loss_mark

CLASSES = ("glass", "mirrored", "lit", "opaque", "sky")
GLASS, MIRRORED, LIT, OPAQUE, SKY = range(len(CLASSES))
BAR = 30
"""Letters in a bar."""
NOTES = (
    "Squared errors in levels of 255, averaged over all pixels, both splits and all scenes: the classes add up to the "
    "mean squared error (MSE). Bar: their shares, by their first letters.",
    "Glass: the centre ray meets glass before anything opaque; so all that is seen through glass or mirrored on it "
    "counts. Mirrored and lit: other pixels that change if all glass is removed, on metal and coats or on matt things "
    "(shadows, caustics). Opaque, sky: the rest.",
)
SCORES = {"glass_psnr_db": "PSNR glass dB ↑", "highlight_psnr_db": "PSNR highlights dB ↑", "highlight_error": "error"}
HIGHLIGHTS_NOTE = (
    "Highlights (the paper's section 4.6): the brightest 2 % of each picture's glass pixels by the truth. Error: their "
    "mean in levels of 255; below 0, they are too dark. Means over scenes."
)

Groups = Mapping[str, Sequence[tuple[SceneScores, SeedGroup]]]
"""The scenes of each run with its seeds there, by its name."""


def errors_grids(scenes: Sequence[SceneScores]) -> list[Grid]:
    """Squared errors by class, and highlights; a row for each run that has both splits."""
    groups: dict[str, list[tuple[SceneScores, SeedGroup]]] = {}
    for scene in scenes:
        for group in group_seeds(scene.runs):
            if all(None not in scores.splits.values() for scores in group.runs):
                groups.setdefault(f"{group.name}{loss_mark(group)}", []).append((scene, group))
    return [_classes_grid(groups), _highlights_grid(groups)]


def show_classes(dataset: Dataset, split: Split) -> Iterator[UInt8[np.ndarray, "h w"]]:
    """What each pixel of each view shows: a place in `CLASSES`.

    Raises:
        HyalineError: there is no twin without glass, whose edit masks tell where glass casts light.
    """
    if not has_variant(dataset, TWINS[0]):
        raise HyalineError(f"{dataset.root}: has no twin without glass; `datagen add {dataset.root} --edit {TWINS[0]}`")
    twin = open_variant(dataset, TWINS[0])
    materials = [item.material for item in open_scene(dataset, TRUTH).objects]
    mirrors = np.array([False, *(isinstance(material, (Conductor, Plastic)) for material in materials)])
    for view in dataset.views(split):
        first, is_lit = view.object_ids()[0], read_edit_mask(twin, split, view.index) == LIGHT
        conditions = [view.mask("glass"), first == 0, is_lit & mirrors[first], is_lit]
        yield np.select(conditions, [GLASS, SKY, MIRRORED, LIT], OPAQUE).astype(np.uint8)


def mean_errors(
    group: SeedGroup, truths: Mapping[Split, Sequence[tuple[np.ndarray, np.ndarray]]]
) -> Float[np.ndarray, "class"]:
    """What each class adds to the mean squared error of a run's pictures, in levels of 255; the mean of its seeds.

    Args:
        truths: each view's true picture and the classes of its pixels.
    """
    errors = []
    for scores in group.runs:
        for split, views in truths.items():
            for index, (truth, classes) in enumerate(views):
                squares = np.square(read_prediction(scores.run, split, index) - truth.astype(float)).mean(axis=-1)
                sums = np.bincount(classes.ravel(), squares.ravel(), minlength=len(CLASSES))
                errors.append(sums / squares.size)
    return np.mean(errors, axis=0)


def _classes_grid(groups: Groups) -> Grid:
    scenes = {scene.title: scene for of in groups.values() for scene, _ in of}
    truths = {
        title: {
            split: list(zip(scene.truths[split].images, show_classes(scene.dataset, split), strict=True))
            for split in TEST_SPLITS
        }
        for title, scene in scenes.items()
    }
    rows = []
    for name, of in groups.items():
        errors = np.mean([mean_errors(group, truths[scene.title]) for scene, group in of], axis=0)
        ends = np.rint(BAR * errors.cumsum() / max(errors.sum(), 1e-9)).astype(int)
        bar = "".join(word[0] * length for word, length in zip(CLASSES, np.diff(ends, prepend=0), strict=True))
        numbers = [f"{error:.1f}" for error in (*errors, errors.sum())]
        rows.append((errors.sum(), (name, str(len(of)), *numbers, bar)))
    numbers = (Column(group=text) for text in ("scenes", *CLASSES, "MSE"))
    return Grid(
        title="Squared errors by what pixels show",
        columns=(Column(group="run", is_number=False), *numbers, Column(group="shares", is_number=False)),
        rows=tuple(row for _, row in sorted(rows)),
        notes=NOTES,
    )


def _highlights_grid(groups: Groups) -> Grid:
    rows = []
    for name, of in groups.items():
        means = (mean_of([group.score(key, split).mean for _, group in of]) for key in SCORES for split in TEST_SPLITS)
        rows.append((name, str(len(of)), *(format_number(mean, 2) for mean in means)))
    columns = (Column(group=title, split=split) for title in SCORES.values() for split in TEST_SPLITS)
    return Grid(
        title="Highlights on glass",
        columns=(Column(group="run", is_number=False), Column(group="scenes"), *columns),
        rows=tuple(rows),
        notes=(HIGHLIGHTS_NOTE,),
    )


ERRORS = Table(shows=lambda _: True, grids=lambda scenes, _: errors_grids(scenes), is_swept=False)
