"""Submissions and their scores against the truth: each scene's, and what they average to.

A submission is the runs of one method, RUNS/SCENE/METHOD, each with its predictions of all splits of the protocol.
Folders come from anybody. Of a run that names another dataset than there is truth of, nothing is scored.
"""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.paths import list_datasets
from datagen.data.variants import ANGLES, has_variant, open_variant, variant_root
from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import Json, dump_json, from_json, load_sealed
from datagen.disk.storage import sha256
from datagen.machine.doctor import code_version
from datagen.terminal.command import say
from datagen.terminal.command import track as progress
from eval.score.metrics import mean_of
from eval.score.runs import (
    Run,
    has_predictions,
    has_split,
    list_run_folders,
    open_run,
    prediction_digests,
    prediction_path,
    read_costs,
)
from eval.score.scores import METRICS, SplitScores, Truth, read_truth, score_run
from eval.variants import run_of_variant
from hyaline_bench.protocol import ALL, EDITS, Bootstrap, Protocol, choose_track, is_of_preset, left_out, load_protocol

COSTS = ("cpu_seconds", "peak_memory_bytes", "frames_per_second")
"""What scores repeat of a run's costs.json."""
MEAN_ABOVE_CEILING, ABOVE_CEILING = 1.0, 3.0
"""dB by which a split's mean and a single picture's score may exceed the noise ceiling, which is an estimate. Against
pictures of 64 times the samples, those of `pool` with 32 x 32 pixels are off by 0.6 dB (standard deviation)."""


# Submissions


def find_runs(root: Path, data_root: Path, preset: str, protocol: Protocol) -> dict[str, dict[str, Run]]:
    """The runs on datasets of a preset, by their name and scene, each with the dataset that has the truth.

    A dataset or run that cannot be opened, or has another size, is named and left out; so is a second run on a scene.
    """
    truths: dict[str, Dataset] = {}
    for folder in list_datasets(data_root):
        with left_out():
            dataset = open_dataset(folder)
            # Of a hidden scene's two datasets, which have one digest, the one with the truth.
            if dataset.seal not in truths or not dataset.withheld:
                truths[dataset.seal] = dataset
    runs: list[Run] = []
    for folder in list_run_folders(root, besides=root / "report"):
        with left_out():
            if not has_predictions(folder):
                continue
            run = open_run(folder, data_root)
            if run.dataset.seal not in truths:
                raise HyalineError(
                    f"{folder}: predicts {run.dataset.root} (dataset {run.dataset.seal[:12]}), which is not in "
                    f"{data_root}; set --data to the folder that contains it"
                )
            # A record must not choose which of a hidden scene's two datasets is scored against.
            run = dataclasses.replace(run, dataset=truths[run.dataset.seal])
            runs += [run] if is_of_preset(run.dataset, preset, protocol) else []
    found: dict[str, dict[str, Run]] = {}
    for run in sorted(runs, key=lambda run: run.folder.parent.name != f"{run.dataset.config.scene}-{preset}"):
        scene = run.dataset.config.scene
        first = found.setdefault(run.name, {}).setdefault(scene, run)
        if first is not run:
            say(f"left out: {run.folder}: is a second run of {run.name} on {scene}, beside {first.folder}")
    return found


def list_predictions(run: Run, protocol: Protocol) -> list[tuple[Run, list[Split]]]:
    """A run and its predictions of variants, each with the splits that it has.

    Raises:
        HyalineError: a split that the protocol asks for is missing.
    """
    listed: list[tuple[Run, list[Split]]] = [(run, list(TEST_SPLITS))]
    for name, splits in protocol.variant_splits(run.dataset.config.scene).items():
        if not has_variant(run.dataset, name):
            if name == ANGLES:
                raise HyalineError(f"{run.dataset.root}: has no {name}; make them with `datagen add --angles`")
            continue
        found = run_of_variant(run, open_variant(run.dataset, name))
        if found is not None:
            listed.append((found, list(splits)))
        elif name == ANGLES:
            folder = variant_root(run.folder, name) / "predictions"
            raise HyalineError(f"{folder}: missing; the protocol asks for {', '.join(splits)}")
    for part, splits in listed:
        for split in splits:
            if not has_split(part, split):
                raise HyalineError(
                    f"{part.folder / 'predictions' / split}: missing; the protocol asks for all its views"
                )
    return listed


# Scores


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
    """Digest of the predictions; in files of earlier versions, that of the archive that they came in."""
    packed_by: str = ""
    """Version of the code that packed the archive, in files of earlier versions."""
    scored_by: str
    """Version of the code that scored it."""
    scenes: dict[str, SceneResult]
    truths: str = ""
    """Digest of the truth that it was scored against; files of earlier versions have none, or another kind."""


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


def score_runs(runs: Mapping[str, Run], protocol: Protocol, *, preset: str, track: str | None) -> Scored:
    """Scores a method's runs, by scene.

    Args:
        track: None: the first track that allows what the method was told, by its record.

    Raises:
        HyalineError: predictions are damaged or incomplete.
    """
    order = list(protocol.tracks)
    track = max((choose_track(run, track, protocol.tracks) for run in runs.values()), key=order.index)
    if withheld := [scene for scene, run in runs.items() if run.dataset.withheld]:
        say(f"left out: {', '.join(withheld)}: a verifier keeps the truth of their test views")
    runs = {scene: run for scene, run in runs.items() if scene not in withheld}
    if not runs:
        raise HyalineError(f"{', '.join(withheld)}: a verifier keeps their truth; send the runs to the verifier")
    parts = {scene: _parts(run, protocol) for scene, run in runs.items()}
    asked = [part for of_scene in parts.values() for part in of_scene]
    pictures = [dump_json([run.dataset.seal, split, *prediction_digests(run, split)]) for run, split, _ in asked]
    arrays = (array for *_, truth in asked for array in (*truth.images, *(truth.glass or ())))
    first = next(iter(runs.values()))
    every = progress(runs.items(), label=f"scoring {first.name}", total=len(runs))
    return Scored(
        version=protocol.version,
        preset=preset,
        name=first.name,
        track=track,
        method=first.record.method,
        knowledge=first.record.knowledge,
        submission=sha256(b"".join(pictures)),
        scored_by=code_version(),
        scenes={scene: _score_scene(run, parts[scene]) for scene, run in every},
        truths=sha256(b"".join(array.tobytes() for array in arrays)),
    )


def read_scored(path: Path) -> Scored:
    """A scored submission from its file."""
    content = load_sealed(path)
    content.pop("failures", None)  # Files of earlier versions have pictures of the worst views.
    return from_json(Scored, cast(Json, content), where=str(path))


def read_scores(folder: Path) -> list[Scored]:
    """The scored submissions in a folder; a file of another version, or of an unknown track, is named and left out."""
    found: list[Scored] = []
    protocol = load_protocol()
    for path in sorted(folder.glob("*.json")):
        with left_out():
            scored = read_scored(path)
            if scored.version != protocol.version:
                raise HyalineError(f"{path}: was scored with protocol {scored.version}; expected {protocol.version}")
            if scored.track not in protocol.tracks:
                known = ", ".join(protocol.tracks)
                raise HyalineError(f"{path}: is of the track {shown(scored.track)}; expected one of {known}")
            found.append(scored)
    return found


Part = tuple[Run, Split, Truth]
"""The predictions of a dataset or a variant on one split, and their truth."""


def _parts(run: Run, protocol: Protocol) -> list[Part]:
    """What is scored of a run; means over some edits cannot be compared, so there are all or none."""
    listed = list_predictions(run, protocol)
    edits = {part.dataset.name for part, _ in listed if part.dataset.edit is not None}
    has_all = edits == set(protocol.edit_variants(run.dataset.config.scene))
    return [
        (part, split, read_truth(part.dataset, split))
        for part, splits in listed
        if has_all or part.dataset.edit is None
        for split in splits
    ]


def _score_scene(run: Run, parts: Sequence[Part]) -> SceneResult:
    splits: dict[str, SplitResult] = {}
    for part, split, truth in parts:
        scores = score_run(part, {split: truth}).splits[split]
        assert scores is not None, "list_predictions lists splits that are there"
        home = "" if part.dataset.edit is None else f"{part.dataset.name}/"
        splits[f"{home}{split}"] = _result(part, split, truth, scores)
    return SceneResult(
        dataset=run.dataset.seal,
        seed=run.record.seed,
        num_parameters=run.record.num_parameters,
        costs={key: value for key, value in read_costs(run.folder).items() if key in COSTS},
        splits=splits,
    )


def _result(run: Run, split: Split, truth: Truth, scores: SplitScores) -> SplitResult:
    """A split's scores.

    Raises:
        HyalineError: pictures are nearer to the truth than the truth's own noise lets any method come.
    """
    limits = {}
    for view, psnr in zip(run.dataset.views(split), scores.images["psnr_db"], strict=True):
        limits[prediction_path(run, split, view.index)] = (psnr, view.record.ceiling_db, ABOVE_CEILING)
    mean = scores.mean("psnr_db")
    limits[run.folder / "predictions" / split] = (mean, truth.ceiling_db, MEAN_ABOVE_CEILING)
    for path, (psnr, ceiling, above) in limits.items():
        assert ceiling is not None and psnr is not None, "the benchmark's datasets are rendered here"
        if psnr > ceiling + above:
            raise HyalineError(
                f"{path}: a PSNR of {psnr:.1f} dB is above the noise ceiling of {ceiling:.1f} dB; expected pictures "
                "that do not know the truth's noise"
            )
    means = {metric.key: scores.mean(metric.key) for metric in METRICS}
    return SplitResult(
        # A glass PSNR may be infinite where few pixels see glass.
        metrics={key: None if value == math.inf else value for key, value in means.items()},
        psnr_db=tuple(scores.images["psnr_db"]),
        ceiling_db=truth.ceiling_db,
    )


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
