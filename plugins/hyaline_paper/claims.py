"""The paper's claims: what each states about runs, and whether an interval over scenes confirms or contradicts it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.paths import TRUTH
from eval.score.scores import RunScores, SceneScores, SeedGroup, group_seeds
from eval.tables.grids import MISSING, SHORT_SPLITS, Column, Grid
from eval.tables.plugins import EditedPsnr, Table
from hyaline_paper.comparisons import (
    NOT_RUN,
    Comparison,
    Entry,
    Line,
    find_entries,
    loss_mark,
)

CONFIRMED, CONTRADICTED, UNDECIDED = "confirmed", "contradicted", "not decided"
OF_VIDEOS = "not judged: no score of videos"
LEAST = 5
"""Scenes (or pictures) below which no interval is computed: nothing is decided."""
RESAMPLES = 10_000

Scores = Sequence[Float[np.ndarray, "seed unit"]]
"""Of the interpolating, then of the extrapolating split: scores in dB of pictures (or scenes) by seed."""
Weights = tuple[float, float]
"""Of both splits in what a claim is about."""
NEAR: Weights = (1, 0)
FAR: Weights = (0, 1)
DROP: Weights = (1, -1)
NAMES = {NEAR: SHORT_SPLITS["interpolating"], FAR: SHORT_SPLITS["extrapolating"], DROP: "drop"}


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim, and the pairs of runs on which it is tried."""

    text: str
    pairs: tuple[Comparison, ...]
    """Pairs of lines: the one that should win, then the other."""
    higher: tuple[Weights, ...] = (NEAR, FAR)
    """Where the first should have the higher score."""
    lower: tuple[Weights, ...] = ()
    is_edited: bool = False
    """True if it is about the pixels where edited objects are or were."""
    is_of_videos: bool = False
    """True if it is about the consistency of a video, which no score measures."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A difference of two runs in dB; 95 % of its bootstrap's resamples lie from `low` to `high`."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        if self.low == -np.inf:
            return f"{self.mean:+.2f}"
        return f"{self.mean:+.2f} ({self.low:+.2f} to {self.high:+.2f})"


class Finding(NamedTuple):
    """A claim tried on one pair of runs: a row of the table."""

    claim: str
    scenes: str
    pair: str
    numbers: str
    verdict: str


def bootstrap(first: Scores, second: Scores, weights: Weights, *, of_scenes: bool = False) -> Interval:
    """The interval of a difference of runs on the same pictures, by resampling pictures, and each run's seeds.

    Unbounded where there are fewer than `LEAST` pictures. Source: Efron and Tibshirani 1993, chapter 13.

    Args:
        of_scenes: both splits have a score for each scene, and are resampled together.
    """
    rng = np.random.default_rng(0)
    seeds = [rng.integers(len(run[0]), size=(RESAMPLES, len(run[0]))) for run in (first, second)]
    means = np.zeros(RESAMPLES)
    mean, least = 0.0, np.inf
    units = np.zeros(0, int)
    for one, other, weight in zip(first, second, weights, strict=True):
        if weight:
            gaps = one[seeds[0]].mean(axis=1) - other[seeds[1]].mean(axis=1)
            units = units if of_scenes and units.size else rng.integers(gaps.shape[1], size=gaps.shape)
            means += weight * np.take_along_axis(gaps, units, axis=1).mean(axis=1)
            mean += weight * float(one.mean() - other.mean())
            least = min(least, gaps.shape[1])
    low, high = np.quantile(means, [0.025, 0.975]) if least >= LEAST else (-np.inf, np.inf)
    return Interval(mean=mean, low=float(low), high=float(high))


def judge(higher: Sequence[Interval], lower: Sequence[Interval]) -> str:
    """A claim holds if all differences have the sign that it states, and fails if one has the other sign."""
    if all(gap.low > 0 for gap in higher) and all(gap.high < 0 for gap in lower):
        return CONFIRMED
    return CONTRADICTED if any(gap.high < 0 for gap in higher) or any(gap.low > 0 for gap in lower) else UNDECIDED


def _pair(first: Line, second: Line, varied: str | None = None) -> Comparison:
    return Comparison(title=f"{first.title} against {second.title}", lines=(first, second), varied=varied)


def _paper(title: str, geometry: str = TRUTH, flags: Mapping[str, str] = MappingProxyType({})) -> Line:
    return Line(title=title, method="paper", flags=flags, geometry=geometry)


PAPER, FIRST_LAYER = _paper("paper"), Line(title="per pixel on the first layer", method="mlp-first")
U_NET, U_NET_LAYERS = Line(title="DNR", method="dnr"), Line(title="U-Net on all layers", method="dnr-layers")

CLAIMS = (
    Claim(
        text="1. The paper's method beats Deferred Neural Rendering",
        pairs=(_pair(PAPER, U_NET), _pair(PAPER, Line(title="DNR, as the paper ran it", method="dnr-authors"))),
    ),
    Claim(text="2. All layers beat the first one", pairs=(_pair(PAPER, FIRST_LAYER), _pair(U_NET_LAYERS, U_NET))),
    Claim(
        text="3. The per-pixel network beats the U-Net on the same layers",
        pairs=(_pair(PAPER, U_NET_LAYERS), _pair(FIRST_LAYER, U_NET)),
    ),
    Claim(
        text="4. The per-pixel network loses less when extrapolating than the U-Net",
        pairs=(_pair(PAPER, U_NET), _pair(PAPER, U_NET_LAYERS), _pair(FIRST_LAYER, U_NET)),
        higher=(),
        lower=(DROP,),
    ),
    Claim(
        text="5. Spherical harmonics help near and hurt far",
        pairs=(_pair(_paper("spherical harmonics", flags={"extrinsics": "sh"}), _paper("view vector"), "extrinsics"),),
        higher=(NEAR,),
        lower=(FAR,),
    ),
    Claim(
        text="6. Ellipsoids beat boxes",
        pairs=(_pair(_paper("paper on ellipsoids", "ellipsoid"), _paper("paper on boxes", "box"), "geometry"),),
        is_of_videos=True,
    ),
    Claim(
        text="7. Zero layers improve generalisation",
        pairs=(_pair(_paper("with zero layers", flags={"zero-layer": ""}), _paper("without"), "zero-layer"),),
        higher=(FAR,),
    ),
    Claim(
        text="8. Zero layers make edits possible",
        pairs=(_pair(_paper("with zero layers", flags={"zero-layer": ""}), _paper("without"), "zero-layer"),),
        is_edited=True,
    ),
    Claim(
        text="9. On boxes, a U-Net shows edits worse",
        pairs=(_pair(_paper("paper on boxes", "box"), Line(title="DNR on boxes", method="dnr", geometry="box")),),
        is_edited=True,
    ),
)
"""Source: the paper, sections 5.1 (1 to 4), 4.6 (5), 5.2 (6), 4.4 (7, 8), 4.3 (9)."""


def find_claims(scenes: Sequence[SceneScores], edited: Mapping[str, EditedPsnr]) -> list[Finding]:
    """Every claim on every pair of runs that it can be tried on; one finding `not run` where there is no pair.

    Args:
        edited: by the scene's title.
    """
    findings = []
    for claim in CLAIMS:
        found: dict[str, dict[str, tuple[Scores, Scores]]] = {}
        for scene in scenes:
            groups = group_seeds(scene.runs)
            for first, second in (entries for pair in claim.pairs for entries in _find_pairs(pair, groups)):
                edits = _shared_edits(edited.get(scene.title, {}), (first, second)) if claim.is_edited else None
                one, other = (_scores(entry.group, edits) for entry in (first, second))
                if one is not None and other is not None:
                    names = " against ".join(f"{each.group.name}{loss_mark(each.group)}" for each in (first, second))
                    found.setdefault(names, {})[scene.title] = one, other
        findings += [decide(claim, pair, of_scenes) for pair, of_scenes in found.items()]
        if not found:
            findings.append(Finding(claim.text, scenes=MISSING, pair=MISSING, numbers=MISSING, verdict=NOT_RUN))
    return findings


def decide(claim: Claim, pair: str, scores: Mapping[str, tuple[Scores, Scores]]) -> Finding:
    """A claim tried on two runs' scores by scene: each counts once, with the mean of its pictures and seeds."""
    first, second = (over_scenes([both[run] for both in scores.values()]) for run in (0, 1))
    higher, lower = (
        [bootstrap(first, second, weights, of_scenes=True) for weights in of] for of in (claim.higher, claim.lower)
    )
    edited = "edited " if claim.is_edited else ""
    gaps = zip((*claim.higher, *claim.lower), (*higher, *lower), strict=True)
    return Finding(
        claim=claim.text,
        scenes=str(len(scores)) if len(scores) > 1 else next(iter(scores)),
        pair=pair,
        numbers="; ".join(f"{edited}{NAMES[weights]} {gap}" for weights, gap in gaps),
        verdict=OF_VIDEOS if claim.is_of_videos else judge(higher, lower),
    )


def over_scenes(scores: Sequence[Scores]) -> Scores:
    """The means of each scene, as scores of one seed."""
    return [np.array([[np.mean(each[split]) for each in scores]]) for split in range(len(TEST_SPLITS))]


def claims_grid(scenes: Sequence[SceneScores], edited: Mapping[str, EditedPsnr]) -> Grid:
    """The findings as a table."""
    texts = ("claim", "scenes", "first run against second", "first minus second in dB (95 % interval)", "verdict")
    seals = ", ".join(f"{scene.title} {scene.dataset.seal[:12]}" for scene in scenes)
    return Grid(
        title="The paper's claims",
        columns=tuple(Column(group=text, is_number=False) for text in texts),
        rows=tuple(find_claims(scenes, edited)),
        notes=(
            "Intervals: bootstrap over scenes, each of which counts once. An interval that contains 0 decides nothing, "
            f"nor do fewer than {LEAST} scenes: pictures and seeds of one scene are no sample of scenes.",
            "Drop: PSNR interpolating minus extrapolating. Edited: PSNR where the edited object is or was, averaged by "
            "edit.",
            f"Data: dataset seals {seals or 'none'}.",
        ),
    )


def _find_pairs(comparison: Comparison, groups: Sequence[SeedGroup]) -> list[tuple[Entry, Entry]]:
    """Both lines of a comparison; of several runs in the second, the one of the size nearest to the first."""
    winner, loser = comparison.lines
    pairs = []
    for part in find_entries(comparison, groups):
        others = [entry for entry in part if entry.line is loser]
        for entry in part:
            if entry.line is winner and others:
                size = entry.group.first.record.num_parameters or 0
                pairs.append(
                    (entry, min(others, key=lambda other: abs((other.group.first.record.num_parameters or 0) - size)))
                )
    return pairs


def _scores(group: SeedGroup, edited: EditedPsnr | None) -> Scores | None:
    """PSNR of every picture, or of every edit; None where one is missing."""
    scores = [[_values(run, split, edited) for run in group.runs] for split in TEST_SPLITS]
    if any(not run or {None, np.inf} & set(run) for split in scores for run in split):
        return None
    return [np.array(split, float) for split in scores]


def _values(run: RunScores, split: Split, edited: EditedPsnr | None) -> Sequence[float | None]:
    if edited is not None:
        return [edit[split] for edit in edited.get(run.run.name, {}).values()]
    scores = run.splits[split]
    return () if scores is None else scores.images["psnr_db"]


def _shared_edits(edited: EditedPsnr, entries: Sequence[Entry]) -> EditedPsnr:
    """The edits that all runs of these groups have drawn."""
    names = [run.run.name for entry in entries for run in entry.group.runs]
    shared = set.intersection(*(set(edited.get(name, {})) for name in names))
    return {name: {edit: edited[name][edit] for edit in sorted(shared)} for name in names if name in edited}


CLAIMS_TABLE = Table(
    shows=lambda run: any(line.fits(run) for claim in CLAIMS for pair in claim.pairs for line in pair.lines),
    grids=lambda scenes, edited: [claims_grid(scenes, {scene.title: edited(scene) for scene in scenes})],
    needs_more=True,
)
