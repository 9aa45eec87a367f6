"""Scores of a submission against the truth: each scene's, what they average to, and the worst views with pictures."""

import base64
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float

from datagen.data.config import Split
from datagen.data.dataset import Dataset, View, open_dataset
from datagen.data.images import png_bytes
from datagen.data.paths import list_datasets
from datagen.data.variants import has_variant, open_variant
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import refuse_file
from datagen.disk.records import Json, from_json, load_json, shown, to_json
from datagen.disk.storage import commit_sealed, load_sealed, sha256, sha256_file
from datagen.machine.doctor import code_version
from datagen.terminal.command import say, track
from datagen.terminal.signals import replacing_at_the_end
from eval.bench.protocol import ALL, EDITS, Bootstrap, Protocol, is_of_preset, left_out
from eval.bench.submission import MAX_WORDS, Submission, list_predictions, opened_submission, read_submission
from eval.score.kept import Kept
from eval.score.metrics import mean_of
from eval.score.runs import Run, read_costs, read_prediction
from eval.score.scores import METRICS, SplitScores, Truth, read_truth, score_run

COSTS = ("cpu_seconds", "peak_memory_bytes", "frames_per_second")
"""What scores repeat of a run's costs.json."""
ABOVE_CEILING = 1.0
"""dB by which a score may exceed the noise ceiling, because the ceiling is an estimate."""
MOST_FAILURES = 3
"""Worst views that a scored submission has pictures of, each of another scene."""


@dataclass(frozen=True, kw_only=True)
class SplitResult:
    """The scores of one split, or of one split after an edit."""

    metrics: dict[str, float | None]
    """Means over the split's pictures, by the metric's key; None if undefined."""
    psnr_db: tuple[float | None, ...]
    """PSNR of each picture; None, in files of earlier versions, if it equals the truth."""
    ceiling_db: float | None
    """PSNR of the truth's own noise; None if it is unknown."""


@dataclass(frozen=True, kw_only=True)
class SceneResult:
    """The scores of one scene, and how they came about."""

    dataset: str
    """Digest of the dataset."""
    seed: int | None
    num_parameters: int | None
    costs: dict[str, float]
    """What the run's costs.json has of `COSTS`."""
    splits: dict[str, SplitResult]
    """By split; `EDIT/SPLIT` after an edit."""

    def values(self, column: str) -> list[SplitResult]:
        """The splits that a column averages."""
        if column == ALL:
            return [result for name, result in self.splits.items() if "/" not in name]
        if column == EDITS:
            return [result for name, result in self.splits.items() if "/" in name]
        return [self.splits[column]] if column in self.splits else []

    def psnr_db(self, column: str) -> float | None:
        return _mean([result.metrics["psnr_db"] for result in self.values(column)])

    def gap_db(self, column: str) -> float | None:
        """How far the PSNR is below the noise ceiling."""
        pairs = [(result.ceiling_db, result.metrics["psnr_db"]) for result in self.values(column)]
        return _mean([None if ceiling is None or psnr is None else ceiling - psnr for ceiling, psnr in pairs])


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A view that was predicted badly, with its pictures as base64 of PNG files."""

    scene: str
    split: str
    view: int
    psnr_db: float
    truth: str
    prediction: str


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A scored submission."""

    version: int
    """Version of the protocol."""
    preset: str
    name: str
    track: str
    method: str | None
    knowledge: str | None
    """What the method was told besides pictures and cameras, by its record."""
    submission: str
    """SHA-256 of the submission."""
    packed_by: str
    """Version of the code that packed the submission."""
    scored_by: str
    """Version of the code that scored it."""
    scenes: dict[str, SceneResult]
    failures: tuple[Failure, ...]
    truths: str = ""
    """Digest of the datasets, variants and test views that it was scored against; earlier files have none, or leave the
    views out."""


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A column's PSNR over scenes in dB."""

    mean: float
    low: float | None
    """Ends of the mean's confidence interval; None for a single scene."""
    high: float | None
    median: float
    worst: float
    worst_scene: str
    gap: float | None
    """Mean distance to the noise ceiling; None if one is unknown."""


@replacing_at_the_end()
def score_submission(path: Path, data_root: Path, out: Path, protocol: Protocol, *, overwrite: bool) -> Scored:
    """Scores a submission, and writes the result; one that was scored before is read again.

    Raises:
        HyalineError: the submission is damaged or incomplete, its truth is missing, or `out` has another one's scores.
    """
    if out.is_file() and not overwrite:
        before, truths = read_scored(out), _digest_of_truths(read_submission(path), find_truths(data_root), protocol)
        if (before.submission, before.scored_by, before.truths) == (sha256_file(path), code_version(), truths):
            say(f"{out}: is finished")
            return before
    refuse_file(out, overwrite=overwrite)
    with opened_submission(path, find_truths(data_root)) as (index, runs):
        withheld = [scene for scene, run in runs.items() if run.dataset.withheld]
        if len(withheld) == len(runs):
            raise HyalineError(
                f"{path}: predicts hidden scenes alone, whose truth a verifier keeps; send it to the verifier"
            )
        if withheld:
            say(f"left out: {', '.join(withheld)}: a verifier keeps the truth of their test views")
        scored = _score(path, index, {scene: run for scene, run in runs.items() if scene not in withheld}, protocol)
    commit_sealed(out, cast(dict[str, Json], to_json(scored)))
    return scored


def say_lost_costs(runs: Iterable[Run]) -> None:
    """Says which costs of runs are no numbers, so that their scores will lack them."""
    for path in (run.folder / "costs.json" for run in runs):
        with left_out():
            found = load_json(path) if path.is_file() else {}
            for key in sorted({*COSTS} & {*found} - {*read_costs(path.parent)}):
                raise HyalineError(f"{path}: {key} is {shown(found[key])}; expected a number of at least 0")


def read_scored(path: Path) -> Scored:
    """A scored submission from its file."""
    return from_json(Scored, cast(Json, load_sealed(path)), where=str(path))


def find_truths(root: Path) -> dict[str, Dataset]:
    """All datasets in a folder, by their digest; one that cannot be opened is named and left out.

    Of a hidden scene's two datasets, which have one digest, the one with the truth.
    """
    found: dict[str, Dataset] = {}
    for folder in list_datasets(root):
        with left_out():
            dataset = open_dataset(folder)
            if dataset.seal not in found or not dataset.withheld:
                found[dataset.seal] = dataset
    return found


def _digest_of_truths(index: Submission, truths: Mapping[str, Dataset], protocol: Protocol) -> str:
    """A hash of the truth: of each dataset and variant with the files of its test views."""
    words: list[str] = []
    for scene, seal in index.datasets.items():
        if seal not in truths or truths[seal].withheld:
            continue
        variants = [name for name in protocol.variant_splits(scene) if has_variant(truths[seal], name)]
        for part in (truths[seal], *(open_variant(truths[seal], name) for name in variants)):
            words.append(part.seal)
            for split in part.splits:
                words += [digest for view in part.views(split) if split != "train" for digest in _files_of(view)]
    return sha256(" ".join(words).encode())


def _files_of(view: View) -> list[str]:
    """SHA-256 of a view's files, by its record; nothing if it is not built."""
    try:
        return [digest for _, digest in sorted(view.record.files.items())]
    except HyalineError:
        return []


def _score(path: Path, index: Submission, runs: Mapping[str, Run], protocol: Protocol) -> Scored:
    scenes, worst = {}, []
    for scene, run in track(runs.items(), label=f"scoring {index.name}", total=len(runs)):
        if not is_of_preset(run.dataset, index.preset, protocol):
            raise HyalineError(
                f"{path}: {scene} is not a scene of {index.preset}; submit it to the preset of its dataset"
            )
        splits: dict[str, SplitResult] = {}
        shown: list[tuple[float, Run, Split, int]] = []
        for part, names in list_predictions(run, protocol):
            home = "" if part.dataset.edit is None else f"{part.dataset.name}/"
            for split, (truth, scores) in _score_part(part, names):
                splits[f"{home}{split}"] = _result(f"{path}: {scene}: {home}{split}", truth, scores)
                if scene in protocol.public_scenes(index.preset) and not home:
                    for view, value in enumerate(scores.images["psnr_db"]):
                        if value is not None:
                            shown.append((value, part, split, view))
        edits = {name.partition("/")[0] for name in splits if "/" in name}
        if edits != set(protocol.edit_variants(scene)):  # Means over some edits cannot be compared.
            splits = {name: result for name, result in splits.items() if "/" not in name}
        scenes[scene] = SceneResult(
            dataset=run.dataset.seal,
            seed=run.seed,
            num_parameters=run.num_parameters,
            costs={key: value for key, value in read_costs(run.folder).items() if key in COSTS},
            splits=splits,
        )
        worst += [_failure(scene, *min(shown, key=lambda item: item[0]))] if shown else []
    first = next(iter(runs.values()))
    return Scored(
        version=protocol.version,
        preset=index.preset,
        name=index.name,
        track=index.track,
        method=None if first.method is None else first.method[:MAX_WORDS],
        knowledge=None if first.knowledge is None else first.knowledge[:MAX_WORDS],
        submission=sha256_file(path),
        packed_by=index.code,
        scored_by=code_version(),
        scenes=scenes,
        failures=tuple(sorted(worst, key=lambda failure: failure.psnr_db)[:MOST_FAILURES]),
        truths=_digest_of_truths(index, {run.dataset.seal: run.dataset for run in runs.values()}, protocol),
    )


def _score_part(run: Run, splits: Sequence[Split]) -> Iterator[tuple[Split, tuple[Truth, SplitScores]]]:
    truths: dict[Split, Truth] = {split: read_truth(run.dataset, split) for split in splits}
    scored = score_run(run, truths, Kept())
    for split in splits:
        scores = scored.splits[split]
        assert scores is not None, "list_predictions lists splits that are there"
        yield split, (truths[split], scores)


def _result(where: str, truth: Truth, scores: SplitScores) -> SplitResult:
    means = {metric.key: scores.mean(metric.key) for metric in METRICS}
    if math.inf in scores.images["psnr_db"]:
        raise HyalineError(f"{where}: pictures equal the truth with its noise, which no method can predict")
    if truth.ceiling_db is not None and (psnr := means["psnr_db"] or 0.0) > truth.ceiling_db + ABOVE_CEILING:
        raise HyalineError(
            f"{where}: a PSNR of {psnr:.1f} dB is above the noise ceiling of {truth.ceiling_db:.1f} dB, so these "
            "pictures know the truth's noise"
        )
    return SplitResult(
        # A glass PSNR may be infinite where few pixels see glass.
        metrics={key: None if value == math.inf else value for key, value in means.items()},
        psnr_db=tuple(scores.images["psnr_db"]),
        ceiling_db=truth.ceiling_db,
    )


def _failure(scene: str, psnr_db: float, run: Run, split: Split, view: int) -> Failure:
    pictures = (run.dataset.view(split, view).image, read_prediction(run, split, view))
    truth, prediction = (base64.b64encode(png_bytes(picture)).decode() for picture in pictures)
    return Failure(scene=scene, split=split, view=view, psnr_db=psnr_db, truth=truth, prediction=prediction)


# Averages


def summarise(
    scored: Scored, column: str, bootstrap: Bootstrap, *, among: Collection[str] | None = None
) -> Summary | None:
    """A column over the scenes that have it; None if there are none, or a score is undefined.

    Args:
        among: only these scenes, each of which must have the column.
    """
    scenes = {name: scene for name, scene in scored.scenes.items() if scene.values(column)}
    if among is not None:
        scenes = {name: scene for name, scene in scenes.items() if name in among}
        if len(scenes) < len(among):
            return None
    known = {name: value for name, scene in scenes.items() if (value := scene.psnr_db(column)) is not None}
    if not known or len(known) < len(scenes):
        return None
    values = np.array(list(known.values()))
    low, high = mean_interval(values, bootstrap)
    worst = min(known, key=lambda name: known[name])
    return Summary(
        mean=float(values.mean()),
        low=low,
        high=high,
        median=float(np.median(values)),
        worst=known[worst],
        worst_scene=worst,
        gap=_mean([scene.gap_db(column) for scene in scenes.values()]),
    )


def mean_interval(
    values: Float[np.ndarray, "scene"],
    bootstrap: Bootstrap,
) -> tuple[float, float] | tuple[None, None]:
    """The percentile bootstrap's interval of the mean; None for a single value.

    Source: Efron and Tibshirani 1993, chapter 13.
    """
    if len(values) < 2:
        return None, None
    rng = np.random.default_rng(bootstrap.seed)
    means = rng.choice(values, (bootstrap.resamples, len(values))).mean(axis=1)
    tail = (1 - bootstrap.confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean; None if there are none, or one is missing."""
    return mean_of(values) if None not in values else None
