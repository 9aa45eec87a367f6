"""The paper's four claims: what each states about runs, and whether the runs support it."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.paths import TRUTH
from eval.papers.comparisons import NOT_RUN, Comparison, Entry, Line, difference, find_entries, spread_cell
from eval.papers.tables import BEST
from eval.score.scores import SceneScores
from eval.score.seeds import SeedGroup, Spread, group_seeds, spread
from eval.tables.grids import MISSING, SHORT_SPLITS, Column, Grid
from eval.tables.named import EditedPsnr, Table
from eval.tables.published import DNR, SPHERICAL_HARMONICS, VIEW_VECTOR, PublishedRow

Measure = Callable[[SeedGroup, EditedPsnr], Spread]


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What must be so of the first run of a pair, against the second."""

    what: str
    measure: Measure
    should_be: Literal["higher", "lower"]


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim, and the pairs of runs on which it is tried; it holds where all conditions do."""

    text: str
    pairs: tuple[Comparison, ...]
    """Pairs of lines: the one that should win, then the other."""
    conditions: tuple[Condition, ...]
    published: tuple[PublishedRow, PublishedRow] | None = None


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A claim tried on one pair."""

    claim: str
    scene: str
    pair: str
    numbers: str
    verdict: str


def _psnr(split: Split) -> Measure:
    return lambda group, _: group.score("psnr_db", split)


def _edited(split: Split) -> Measure:
    return lambda group, edited: spread([_mean_of_edits(edited, run.run.name, split) for run in group.runs])


def _mean_of_edits(edited: EditedPsnr, name: str, split: Split) -> float | None:
    values = [value for by_split in edited.get(name, {}).values() if (value := by_split[split]) is not None]
    return sum(values) / len(values) if values else None


def _shared_edits(edited: EditedPsnr, groups: Sequence[SeedGroup]) -> EditedPsnr:
    """The edits that all runs of these groups have drawn."""
    names = [run.run.name for group in groups for run in group.runs]
    shared = set.intersection(*(set(edited.get(name, {})) for name in names))
    return {name: {edit: edited[name][edit] for edit in sorted(shared)} for name in names if name in edited}


def _pair(first: Line, second: Line, varied: str | None = None) -> Comparison:
    return Comparison(title=f"{first.title} against {second.title}", lines=(first, second), varied=varied)


def _paper(title: str, geometry: str = TRUTH, flags: Mapping[str, str] = MappingProxyType({})) -> Line:
    return Line(title=title, method="paper", flags=flags, geometry=geometry)


U_NET, U_NET_LAYERS = Line(title="DNR", method="dnr"), Line(title="U-Net on all layers", method="dnr-layers")

CLAIMS = (
    Claim(
        text="1. The per-pixel network loses less when extrapolating than the U-Net",
        pairs=(
            _pair(_paper("paper"), U_NET),
            _pair(_paper("paper"), U_NET_LAYERS),
            _pair(BEST, U_NET),
            _pair(BEST, U_NET_LAYERS),
            _pair(Line(title="per pixel on the first layer", method="mlp-first"), U_NET),
        ),
        conditions=(Condition(what="drop", measure=lambda group, _: group.drop_db, should_be="lower"),),
        published=(VIEW_VECTOR, DNR),
    ),
    Claim(
        text="2. Spherical harmonics help near and hurt far",
        pairs=(_pair(_paper("spherical harmonics", flags={"extrinsics": "sh"}), _paper("view vector"), "extrinsics"),),
        conditions=(
            Condition(what="inter", measure=_psnr("interpolating"), should_be="higher"),
            Condition(what="extra", measure=_psnr("extrapolating"), should_be="lower"),
        ),
        published=(SPHERICAL_HARMONICS, VIEW_VECTOR),
    ),
    Claim(
        text="3. Ellipsoids beat boxes",
        pairs=(
            _pair(_paper("paper on ellipsoids", "ellipsoid"), _paper("paper on boxes", "box"), "geometry"),
            _pair(
                Line(title="light-path on ellipsoids", method="light-path", geometry="ellipsoid"),
                Line(title="light-path on boxes", method="light-path", geometry="box"),
                "geometry",
            ),
        ),
        conditions=(
            Condition(what="inter", measure=_psnr("interpolating"), should_be="higher"),
            Condition(what="extra", measure=_psnr("extrapolating"), should_be="higher"),
        ),
    ),
    Claim(
        text="4. Zero layers make edits possible",
        pairs=(_pair(_paper("with zero layers", flags={"zero-layer": ""}), _paper("without"), "zero-layer"),),
        conditions=tuple(
            Condition(what=f"edited {SHORT_SPLITS[split]}", measure=_edited(split), should_be="higher")
            for split in TEST_SPLITS
        ),
    ),
)
"""Source: the paper, sections 4.3 and 5.1 (1), 4.6 (2), 5.2 (3), 4.4 (4)."""


def find_claims(scenes: Sequence[SceneScores], edited: Mapping[str, EditedPsnr]) -> list[Finding]:
    """Every claim on every pair of runs that it can be tried on; one finding `not run` where there is no pair.

    A difference below twice its standard error, where there are several seeds, is said to be within the spread.

    Args:
        edited: by the scene's title.
    """
    findings = []
    for claim in CLAIMS:
        tried = [
            _try(claim, scene.title, first, second, edited.get(scene.title, {}))
            for scene in scenes
            for comparison in claim.pairs
            for first, second in _find_pairs(comparison, group_seeds(scene.runs))
        ]
        found = [finding for finding in tried if finding is not None]
        if claim.published is not None:
            found.insert(0, _published(claim, *claim.published))
        if not any(finding.verdict for finding in found):
            found.append(Finding(claim=claim.text, scene=MISSING, pair=MISSING, numbers=MISSING, verdict=NOT_RUN))
        findings += found
    return findings


def claims_grid(scenes: Sequence[SceneScores], edited: Mapping[str, EditedPsnr]) -> Grid:
    """The findings as a table."""
    texts = ("claim", "scene", "first run against second", "dB of the first against the second", "verdict")
    findings = find_claims(scenes, edited)
    seals = ", ".join(f"{scene.title} {scene.dataset.seal[:12]}" for scene in scenes)
    return Grid(
        title="The paper's claims",
        columns=tuple(Column(group=text, is_number=False) for text in texts),
        rows=tuple(
            (finding.claim, finding.scene, finding.pair, finding.numbers, finding.verdict or MISSING)
            for finding in findings
        ),
        notes=(
            _in_short(findings),
            "Published: what the paper printed, most likely the wrapped PSNR; no verdict rests on it. Drop: PSNR "
            "interpolating minus extrapolating. Edited: PSNR where the edited object is or was. Within the spread: a "
            "difference is below twice its standard error over seeds.",
            f"Data: dataset seals {seals or 'none'}.",
        ),
    )


def _in_short(findings: Sequence[Finding]) -> str:
    """For each claim, how many pairs confirm or contradict it."""
    counts = {
        claim.text: Counter(f.verdict for f in findings if f.claim == claim.text and f.verdict) for claim in CLAIMS
    }
    return " ".join(f"{text}: {_listed(found)}." for text, found in counts.items())


def _listed(found: Counter[str]) -> str:
    return "; ".join(f"{verdict} ({count})" if verdict != NOT_RUN else verdict for verdict, count in found.items())


def _find_pairs(comparison: Comparison, groups: Sequence[SeedGroup]) -> list[tuple[Entry, Entry]]:
    """Both lines of a comparison; of several runs in the second, the one of the size nearest to the first."""
    winner, loser = comparison.lines
    pairs = []
    for part in find_entries(comparison, groups):
        others = [entry for entry in part if entry.line is loser]
        for entry in part:
            if entry.line is winner and others:
                size = entry.group.first.num_parameters or 0
                pairs.append(
                    (entry, min(others, key=lambda other: abs((other.group.first.num_parameters or 0) - size)))
                )
    return pairs


def _try(claim: Claim, scene: str, first: Entry, second: Entry, edited: EditedPsnr) -> Finding | None:
    """None where a score is missing."""
    edited = _shared_edits(edited, (first.group, second.group))
    numbers, holds, is_clear = [], [], []
    for condition in claim.conditions:
        one, other = (condition.measure(entry.group, edited) for entry in (first, second))
        gap, error = difference(one, other)
        if gap is None:
            return None
        holds.append(gap > 0 if condition.should_be == "higher" else gap < 0)
        is_clear.append(abs(gap) >= 2 * error)
        numbers.append(f"{condition.what} {spread_cell(one)} against {spread_cell(other)}")
    # One condition that clearly fails contradicts a claim; all must clearly hold to confirm it.
    decisive = is_clear if all(holds) else [clear for clear, hold in zip(is_clear, holds) if not hold]
    clear = all(decisive) if all(holds) else any(decisive)
    verdict = ("confirmed" if all(holds) else "contradicted") + ("" if clear else ", within the spread")
    pair = f"{first.group.name} against {second.group.name}"
    return Finding(claim=claim.text, scene=scene, pair=pair, numbers="; ".join(numbers), verdict=verdict)


def _published(claim: Claim, first: PublishedRow, second: PublishedRow) -> Finding:
    numbers = []
    for condition in claim.conditions:
        values = {
            "inter": lambda row: row.interpolating_db,
            "extra": lambda row: row.extrapolating_db,
            "drop": lambda row: row.interpolating_db - row.extrapolating_db,
        }[condition.what]
        numbers.append(f"{condition.what} {values(first):.2f} against {values(second):.2f}")
    pair = f"{first.method} against {second.method}"
    return Finding(claim=claim.text, scene="published", pair=pair, numbers="; ".join(numbers), verdict="")


CLAIMS_TABLE = Table(
    shows=lambda run: any(line.fits(run) for claim in CLAIMS for pair in claim.pairs for line in pair.lines),
    grids=lambda scenes, edited: [claims_grid(scenes, {scene.title: edited(scene) for scene in scenes})],
    needs_more=True,
)
