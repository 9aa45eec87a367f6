"""Runs that only differ in their seed, and the mean and spread of their scores."""

import math
import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from datagen.data.config import Split
from datagen.disk.records import dump_json
from datagen.disk.storage import sha256
from eval.score.runs import Run
from eval.score.scores import RunScores


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A score over seeds."""

    mean: float | None
    """Mean; None if a run has no such score."""
    deviation: float | None
    """Sample standard deviation (n - 1); None for one seed, or if a score is infinite."""
    count: int


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
        return re.sub(r"-seed\d+", "", self.first.name) if len(self.runs) > 1 else self.first.name

    def score(self, key: str, split: Split) -> Spread:
        """Mean and spread of a metric on a split."""
        return spread([scores.mean(key, split) for scores in self.runs])

    @property
    def drop_db(self) -> Spread:
        """Mean and spread of PSNR interpolating minus extrapolating."""
        return spread([scores.drop_db for scores in self.runs])


def spread(values: Sequence[float | None]) -> Spread:
    """Mean and sample standard deviation; without a mean if a value is missing."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return Spread(mean=None, deviation=None, count=len(values))
    if any(math.isinf(value) for value in known):
        return Spread(mean=math.inf, deviation=None, count=len(values))
    deviation = statistics.stdev(known) if len(known) > 1 else None
    return Spread(mean=statistics.fmean(known), deviation=deviation, count=len(values))


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
