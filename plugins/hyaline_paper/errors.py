"""Where methods err: their squared errors by what pixels show, over scenes, and their highlights."""

import shlex
from collections.abc import Sequence

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
BAR = 20
"""Letters in a bar."""
NOTES = (
    "Squared errors in levels of 255, averaged over all pixels, both splits and all scenes: the classes add up to the "
    "mean squared error (MSE). Shares: by their first letters.",
    "Glass: the centre ray meets glass before anything opaque; so all that is seen through glass or mirrored on it "
    "counts. Mirrored and lit: other pixels that change if all glass is removed, on metal and coats or on matt things "
    "(shadows, caustics). Opaque, sky: the rest.",
    "Highlights (the paper's section 4.6): the brightest 2 % of each picture's glass pixels by the truth; their PSNR "
    "and their mean error in levels of 255, below 0 if they are too dark. Means over both splits and all scenes.",
)


def errors_grid(scenes: Sequence[SceneScores]) -> Grid:
    """A row for each run that has both splits, over the scenes that it has; the one with the least error first."""
    groups: dict[str, list[SeedGroup]] = {}
    for group in (group for scene in scenes for group in group_seeds(scene.runs)):
        if all(None not in scores.splits.values() for scores in group.runs):
            groups.setdefault(f"{group.name}{loss_mark(group)}", []).append(group)
    classes = {scene.dataset.seal: [show_classes(scene.dataset, split) for split in TEST_SPLITS] for scene in scenes}
    rows = []
    for name, of in groups.items():
        errors = np.mean([mean_errors(group, classes[group.first.dataset.seal]) for group in of], axis=0)
        ends = np.rint(BAR * errors.cumsum() / max(errors.sum(), 1e-9)).astype(int)
        bar = "".join(word[0] * length for word, length in zip(CLASSES, np.diff(ends, prepend=0), strict=True))
        scores = [
            mean_of([group.score(f"highlight_{key}", split).mean for group in of for split in TEST_SPLITS])
            for key in ("psnr_db", "error")
        ]
        cells = (*(f"{error:.1f}" for error in (*errors, errors.sum())), bar, *(format_number(s, 1) for s in scores))
        rows.append((errors.sum(), (name, str(len(of)), *cells)))
    texts = {"run", "shares"}
    names = ("run", "scenes", *CLASSES, "MSE", "shares", "highlights dB ↑", "their error")
    return Grid(
        title="Squared errors by what pixels show",
        columns=tuple(Column(group=name, is_number=name not in texts) for name in names),
        rows=tuple(row for _, row in sorted(rows)),
        notes=NOTES,
    )


def show_classes(dataset: Dataset, split: Split) -> UInt8[np.ndarray, "view h w"]:
    """What each pixel of each view shows: a place in `CLASSES`.

    Raises:
        HyalineError: there is no twin without glass, whose edit masks tell where glass casts light.
    """
    if not has_variant(dataset, TWINS[0]):
        words = ["datagen", "add", str(dataset.root), "--edit", TWINS[0]]
        raise HyalineError(f"{dataset.root}: has no twin without glass; make it with `{shlex.join(words)}`")
    twin = open_variant(dataset, TWINS[0])
    materials = [item.material for item in open_scene(dataset, TRUTH).objects]
    mirrors = np.array([False, *(isinstance(material, (Conductor, Plastic)) for material in materials)])
    shown = []
    for view in dataset.views(split):
        first, is_lit = view.object_ids()[0], read_edit_mask(twin, split, view.index) == LIGHT
        kinds = {GLASS: view.mask("glass"), SKY: first == 0, MIRRORED: is_lit & mirrors[first], LIT: is_lit}
        shown.append(np.select([*kinds.values()], [*kinds], OPAQUE))
    return np.array(shown, np.uint8)


def mean_errors(group: SeedGroup, classes: Sequence[UInt8[np.ndarray, "view h w"]]) -> Float[np.ndarray, " class"]:
    """What each class adds to the mean squared error in levels of 255, over a run's seeds and splits.

    Args:
        classes: of the pixels, by split.
    """
    errors = []
    for run in (scores.run for scores in group.runs):
        for split, shown in zip(TEST_SPLITS, classes, strict=True):
            truth = [view.image.astype(float) for view in run.dataset.views(split)]
            drawn = [read_prediction(run, split, view) for view in range(len(truth))]
            squares = np.square(np.subtract(drawn, truth)).mean(axis=-1)
            errors.append(np.bincount(shown.ravel(), squares.ravel(), minlength=len(CLASSES)) / squares.size)
    return np.mean(errors, axis=0)


ERRORS = Table(shows=lambda _: True, grids=lambda scenes, _: [errors_grid(scenes)], is_swept=False)
