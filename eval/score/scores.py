"""The scores of runs: every metric of every predicted picture, what the truth itself allows, and means over seeds."""

import math
import re
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, has_glass_mask
from datagen.data.paths import view_name
from datagen.disk.errors import NumericsError
from datagen.disk.records import dump_json
from datagen.disk.storage import sha256
from eval.score import metrics
from eval.score.metrics import mean_of
from eval.score.runs import (
    Run,
    has_split,
    prediction_digests,
    prediction_path,
    read_prediction,
)


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A metric's names and format."""

    key: str
    """Name in JSON."""
    title: str
    """Title; ends in ↑ if more is better, in ↓ if less is."""
    decimals: int
    in_db: bool = False
    is_printed: bool = True
    """False: only in JSON."""

    @property
    def sign(self) -> int:
        """1 if more is better, -1 if less is, 0 if neither."""
        return {"↑": 1, "↓": -1}.get(self.title[-1], 0)


METRICS = (
    Metric(key="psnr_db", title="PSNR dB ↑", decimals=2, in_db=True),
    Metric(key="glass_psnr_db", title="PSNR glass dB ↑", decimals=2, in_db=True),
    Metric(key="ssim", title="SSIM ↑", decimals=3),
    Metric(key="delta_e", title="ΔE2000 ↓", decimals=2),
    Metric(key="delta_e_p95", title="ΔE2000 p95 ↓", decimals=2, is_printed=False),
    Metric(key="flip", title="FLIP ↓", decimals=4, is_printed=False),
    Metric(key="lpips", title="LPIPS ↓", decimals=4, is_printed=False),
    Metric(key="highlight_psnr_db", title="PSNR highlights dB ↑", decimals=2, in_db=True, is_printed=False),
    Metric(key="highlight_error", title="mean error of highlights", decimals=1, is_printed=False),
    Metric(
        key="psnr_uint8_wrap_db",
        title="PSNR wrapped (authors' script)",
        decimals=2,
        in_db=True,
        is_printed=False,
    ),
)

METRIC_NOTES = (
    "Each score is the mean over a split's pictures of one value per picture. All compare 8-bit sRGB, peak 255.",
    "PSNR glass: pixels whose centre ray meets glass before anything opaque; pictures without such pixels are left "
    "out. SSIM: Wang et al. 2004, Gaussian window, sigma 1.5. ΔE2000: CIE DE2000 under D65, mean over pixels (p95: "
    "the pixels' 95th percentile).",
    "Drop: PSNR interpolating minus extrapolating. Noise ceiling: the PSNR that a perfect method would get "
    "against these noisy pictures, both rounded to 8 bits.",
)
WRAPPED_NOTE = (
    "PSNR wrapped (authors' script): squared errors modulo 256, as the script that the paper's authors released counts "
    "them. This is not a PSNR; it is shown only for comparison with the paper's tables."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """The ground truth of one split."""

    dataset: Dataset
    split: Split
    images: tuple[UInt8[np.ndarray, "h w 3"], ...]
    glass: tuple[Bool[np.ndarray, "h w"], ...] | None
    """Pixels that see glass; None without layers of the true geometry and imported masks."""
    ceiling_db: float | None
    """PSNR of the pictures' noise in dB; None if it is unknown."""


@dataclass(frozen=True, kw_only=True)
class SplitScores:
    """The scores of one run on one split: per metric, one value per picture."""

    images: dict[str, tuple[float | None, ...]]
    """Values by the metric's key; None if it is undefined for the picture, inf dB if both are identical."""

    def mean(self, key: str) -> float | None:
        return mean_of(self.images[key])

    def identical(self, key: str) -> int:
        """How many pictures the mean leaves out because they equal the truth."""
        values = self.images[key]
        infinite = sum(value is not None and math.isinf(value) for value in values)
        return 0 if self.mean(key) == math.inf else infinite

    def undefined(self, key: str) -> int:
        """How many pictures the mean leaves out because the metric is undefined for them."""
        return sum(value is None for value in self.images[key])


@dataclass(frozen=True, kw_only=True, eq=False)
class RunScores:
    """The scores of one run on all test splits; None for a split that it did not predict."""

    run: Run
    splits: dict[Split, SplitScores | None]
    digests: Mapping[Split, Sequence[str]]
    """SHA-256 of each picture by split."""

    @property
    def predictions_sha256(self) -> str:
        """One hash over all pictures: of the lines `SPLIT/0000.png SHA-256`."""
        lines = [
            f"{split}/{view_name(view)}.png {digest}\n"
            for split, digests in self.digests.items()
            for view, digest in enumerate(digests)
        ]
        return sha256("".join(lines).encode())

    def mean(self, key: str, split: Split) -> float | None:
        scores = self.splits[split]
        return None if scores is None else scores.mean(key)

    @property
    def drop_db(self) -> float | None:
        """PSNR interpolating minus extrapolating."""
        near, far = (self.mean("psnr_db", split) for split in TEST_SPLITS)
        if near is None or far is None or math.isinf(near) or math.isinf(far):
            return None
        return near - far


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneScores:
    """The scores of all runs on one dataset."""

    dataset: Dataset
    title: str
    has_glass_mask: bool
    truths: dict[Split, Truth]
    """Truth of the test splits that every dataset has."""
    runs: tuple[RunScores, ...]

    @property
    def ceilings_db(self) -> dict[Split, float | None]:
        """The PSNR of a perfect method in dB, limited by the truth's noise."""
        return {split: truth.ceiling_db for split, truth in self.truths.items()}


def read_truth(dataset: Dataset, split: Split) -> Truth:
    """Pictures, glass masks and noise ceiling of a split, every byte verified."""
    views = list(dataset.views(split))
    return Truth(
        dataset=dataset,
        split=split,
        images=tuple(view.image for view in views),
        glass=tuple(view.mask("glass") for view in views) if has_glass_mask(dataset) else None,
        ceiling_db=dataset.noise_ceiling_db(split),
    )


def score_run(run: Run, truths: dict[Split, Truth]) -> RunScores:
    """Every metric of every picture that the run predicted.

    Args:
        truths: the truth of each test split, all in the run's dataset.

    Raises:
        NumericsError: a score is not a number.
    """
    predicted: list[Split] = [split for split in truths if has_split(run, split)]
    digests: dict[Split, list[str]] = {split: prediction_digests(run, split) for split in predicted}
    splits: dict[Split, SplitScores | None] = dict.fromkeys(truths)
    for split in predicted:
        splits[split] = _score_split(run, truths[split])
    return RunScores(run=run, splits=splits, digests=digests)


def _score_split(run: Run, truth: Truth) -> SplitScores:
    rows = []
    for view, target in enumerate(truth.images):
        glass = None if truth.glass is None else truth.glass[view]
        row = score_picture(read_prediction(run, truth.split, view), target, glass)
        if bad := [key for key, value in row.items() if value is not None and math.isnan(value)]:
            raise NumericsError(
                f"{prediction_path(run, truth.split, view)}: its {bad[0]} is not a number; run not scored"
            )
        rows.append(row)
    return SplitScores(images={key: tuple(row[key] for row in rows) for key in rows[0]})


def score_picture(
    pred: UInt8[np.ndarray, "h w 3"], target: UInt8[np.ndarray, "h w 3"], glass: Bool[np.ndarray, "h w"] | None
) -> dict[str, float | None]:
    """Every metric of one picture by its key; None if it is undefined."""
    delta_e = metrics.delta_e_2000(pred, target)
    bright = None if glass is None or not glass.any() else metrics.highlights(target, glass)
    return {
        "psnr_db": metrics.psnr(pred, target),
        "glass_psnr_db": metrics.masked_psnr(pred, target, glass) if glass is not None and glass.any() else None,
        "ssim": metrics.ssim(pred, target) if min(target.shape[:2]) >= metrics.SSIM_WINDOW else None,
        "delta_e": float(delta_e.mean()),
        "delta_e_p95": float(np.percentile(delta_e, 95)),
        "flip": metrics.flip(pred, target),
        "lpips": metrics.lpips(pred, target),
        "highlight_psnr_db": None if bright is None else metrics.masked_psnr(pred, target, bright),
        "highlight_error": None if bright is None else float((pred[bright].astype(float) - target[bright]).mean()),
        "psnr_uint8_wrap_db": metrics.psnr_uint8_wrap(pred, target),
    }


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A score over seeds."""

    mean: float | None
    """Mean; None if a run has no such score."""
    deviation: float | None
    """Sample standard deviation (n - 1); None for one seed, or if a score is infinite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeedGroup:
    """Runs of one configuration on the same data, by seed; may be a single run."""

    runs: tuple[RunScores, ...]

    @property
    def first(self) -> Run:
        return self.runs[0].run

    @property
    def name(self) -> str:
        """The runs' name without their seed."""
        return name_of_seeds([scores.run.name for scores in self.runs])

    def score(self, key: str, split: Split) -> Spread:
        """Mean and spread of a metric on a split."""
        return spread([scores.mean(key, split) for scores in self.runs])

    @property
    def drop_db(self) -> Spread:
        """Mean and spread of PSNR interpolating minus extrapolating."""
        return spread([scores.drop_db for scores in self.runs])


def name_of_seeds(names: Sequence[str]) -> str:
    """What runs that only differ in their seed are called together."""
    return re.sub(r"-seed\d+", "", names[0]) if len(names) > 1 else names[0]


def spread(values: Sequence[float | None]) -> Spread:
    """Mean and sample standard deviation; without a mean if a value is missing."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return Spread(mean=None, deviation=None)
    if any(math.isinf(value) for value in known):
        return Spread(mean=math.inf, deviation=None)
    deviation = statistics.stdev(known) if len(known) > 1 else None
    return Spread(mean=statistics.fmean(known), deviation=deviation)


def group_seeds(runs: Sequence[RunScores]) -> tuple[SeedGroup, ...]:
    """The runs in groups, in the order of each group's first run.

    A run without a configuration stays alone, because other differences are unknown. So do runs of one configuration
    that share a seed, because repeated runs would make the spread look smaller.
    """
    by_description: dict[str, list[RunScores]] = {}
    for place, scores in enumerate(runs):
        by_description.setdefault(describe_run(scores.run) or f"alone {place}", []).append(scores)
    groups = []
    for members in by_description.values():
        seeds = [scores.run.record.seed for scores in members]
        if len(members) > 1 and (None in seeds or len(set(seeds)) < len(seeds)):
            groups += [SeedGroup(runs=(scores,)) for scores in members]
        else:
            groups.append(SeedGroup(runs=tuple(sorted(members, key=lambda scores: scores.run.record.seed or 0))))
    return tuple(groups)


def describe_run(run: Run) -> str | None:
    """A hash of a run's configuration and data without the seed; None without a configuration."""
    if run.record.config is None:
        return None
    config = {key: value for key, value in run.record.config.items() if key != "seed"}
    about = [run.dataset.seal, run.record.layers_seal, run.record.method, run.record.geometry, config]
    return sha256(dump_json(about))
