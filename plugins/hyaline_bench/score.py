"""Submissions and their scores against the truth.

A submission is the runs of one method, RUNS/SCENE/METHOD, each with its predictions of all splits of the protocol.
Folders come from anybody. Of a run that names another dataset than there is truth of, nothing is scored.
"""

import dataclasses
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Bool

from datagen.data.config import ANGLE_SPLITS, ROUNDING_MSE, TEST_SPLITS, Split
from datagen.data.dataset import Dataset, View, open_dataset
from datagen.data.images import srgb_from_linear
from datagen.data.paths import list_datasets
from datagen.data.variants import (
    ANGLES,
    ELSEWHERE,
    has_variant,
    open_variant,
    read_edit_mask,
    variant_root,
)
from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import Json, dump_json, from_json, load_sealed
from datagen.disk.storage import sha256
from datagen.machine.doctor import code_version
from datagen.terminal.command import say
from datagen.terminal.command import track as progress
from eval.score.metrics import masked_psnr, mean_of
from eval.score.runs import (
    Run,
    has_predictions,
    has_split,
    list_run_folders,
    open_run,
    prediction_digests,
    prediction_path,
    read_costs,
    read_prediction,
)
from eval.score.scores import METRICS, SplitScores, Truth, read_truth, score_run
from eval.variants import run_of_variant
from hyaline_bench.protocol import (
    ALL,
    EDITS,
    GLASS,
    NO_GLASS,
    Protocol,
    choose_track,
    glass_masks,
    is_of_preset,
    left_out,
    load_protocol,
)

CHANGED = "changed_psnr_db"
"""Key of the PSNR of pixels that change with an edit, or if all glass is removed."""
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


Part = tuple[Run, Split, Truth]
"""The predictions of a dataset or a variant on one split, and their truth."""


def list_parts(run: Run, protocol: Protocol) -> list[Part]:
    """What is scored of a run: its test splits, angles, and edits, of which there are all or none.

    Raises:
        HyalineError: a split that the protocol asks for is missing.
    """
    dataset = run.dataset
    glass_masks(dataset)  # Raises if they are missing.
    wanted = protocol.variant_splits(dataset.config.scene)
    found = {
        name: run_of_variant(run, open_variant(dataset, name)) if has_variant(dataset, name) else None
        for name in wanted
    }
    has_edits = any(found[name] for name in found if name != ANGLES)
    for name, part in found.items():
        if part is None and (has_edits or name == ANGLES):
            add = f"`datagen add {shlex.quote(str(dataset.root))} --angles`"
            hint = f"whose cameras {add} makes" if name == ANGLES else "as of other edits, or for none"
            missing = f"{variant_root(run.folder, name) / 'predictions'}: missing"
            raise HyalineError(f"{missing}; the protocol asks for {', '.join(wanted[name])}, {hint}")
    listed = [(run, TEST_SPLITS)] + [(part, wanted[name]) for name, part in found.items() if part]
    for part, splits in listed:
        for split in splits:
            if not has_split(part, split):
                raise HyalineError(
                    f"{part.folder / 'predictions' / split}: missing; the protocol asks for all its views"
                )
    return [(part, split, read_truth(part.dataset, split)) for part, splits in listed for split in splits]


# Scores


@dataclass(frozen=True, kw_only=True)
class SplitResult:
    """The scores of one split, or of one split after an edit."""

    metrics: dict[str, float | None]
    """Means over the split's pictures, by the metric's key; None if undefined. `CHANGED` is the PSNR of those pixels
    that change with the edit, or else if all glass is removed: whose light meets glass. Splits by angle lack it."""
    psnr_db: tuple[float | None, ...]
    """PSNR of each picture."""
    ceilings_db: dict[str, float | None]
    """PSNR that noise and 8 bits would leave a perfect method, of all pixels and of those that change."""
    changed: float | None
    """Share of pixels that change."""


@dataclass(frozen=True, kw_only=True)
class SceneResult:
    """The scores of one scene, and how they came about."""

    dataset: str
    """Digest of the dataset."""
    train_noise_db: float | None
    """PSNR of the training pictures, by their own noise and 8 bits."""
    seed: int | None
    costs: dict[str, float]
    """The run's costs.json."""
    splits: dict[str, SplitResult]
    """By split; `EDIT/SPLIT` after an edit."""

    def values(self, column: str) -> list[SplitResult]:
        """The splits that a column averages."""
        if column == EDITS:
            return [result for name, result in self.splits.items() if "/" in name]
        names = TEST_SPLITS if column in (GLASS, ALL) else (column,)
        return [self.splits[name] for name in names if name in self.splits]

    def psnr_db(self, column: str) -> float | None:
        return mean_of_all([result.metrics.get(metric_of(column)) for result in self.values(column)])

    def ceiling_db(self, column: str) -> float | None:
        return mean_of_all([result.ceilings_db.get(metric_of(column)) for result in self.values(column)])


def mean_of_all(values: Sequence[float | None]) -> float | None:
    """The mean; None if there are none, or one is missing."""
    return mean_of(values) if None not in values else None


def metric_of(column: str) -> str:
    """The metric that a column averages: of all pixels, or of those that change."""
    return "psnr_db" if column == ALL or column in ANGLE_SPLITS else CHANGED


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A scored submission."""

    version: int
    """Version of the protocol."""
    preset: str
    name: str
    track: str
    submission: str
    """Digest of the predictions."""
    scored_by: str
    """Version of the code that scored it."""
    scenes: dict[str, SceneResult]
    truths: str
    """Digest of the pictures that it was scored against."""


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
    for scene, run in runs.items():
        if run.dataset.seal != (fixed := protocol.digests.get(preset, {}).get(scene, run.dataset.seal)):
            say(f"{scene}: is not the protocol's dataset {fixed[:12]}, so its scores belong into no table with others")
    parts = {scene: list_parts(run, protocol) for scene, run in runs.items()}
    asked = [part for of_scene in parts.values() for part in of_scene]
    pictures = [dump_json([run.dataset.seal, split, *prediction_digests(run, split)]) for run, split, _ in asked]
    arrays = (array for *_, truth in asked for array in truth.images)
    first = next(iter(runs.values()))
    every = progress(runs.items(), label=f"scoring {first.name}", total=len(runs))
    return Scored(
        version=protocol.version,
        preset=preset,
        name=first.name,
        track=track,
        submission=sha256(b"".join(pictures)),
        scored_by=code_version(),
        scenes={scene: _score_scene(run, parts[scene]) for scene, run in every},
        truths=sha256(b"".join(array.tobytes() for array in arrays)),
    )


def read_scored(path: Path) -> Scored:
    """A scored submission from its file."""
    return from_json(Scored, cast(Json, load_sealed(path)), where=str(path))


def read_scores(folder: Path) -> list[Scored]:
    """The scored submissions in a folder; a file of another version, or of an unknown track, is named and left out."""
    found: list[Scored] = []
    protocol = load_protocol()
    for path in sorted(folder.glob("*.json")):
        with left_out():
            if (version := load_sealed(path).get("version")) != protocol.version:
                raise HyalineError(f"{path}: was scored with protocol {shown(version)}; expected {protocol.version}")
            scored = read_scored(path)
            if scored.track not in protocol.tracks:
                known = ", ".join(protocol.tracks)
                raise HyalineError(f"{path}: is of the track {shown(scored.track)}; expected one of {known}")
            found.append(scored)
    return found


def _score_scene(run: Run, parts: Sequence[Part]) -> SceneResult:
    splits: dict[str, SplitResult] = {}
    without_glass = dataclasses.replace(run.dataset, root=variant_root(run.dataset.root, NO_GLASS))
    for part, split, truth in parts:
        scores = score_run(part, {split: truth}).splits[split]
        assert scores is not None, "list_parts lists splits that are there"
        home = "" if part.dataset.edit is None else f"{part.dataset.name}/"
        masks = part.dataset if part.dataset.edit else without_glass if split in TEST_SPLITS else None
        splits[f"{home}{split}"] = _result(part, split, truth, scores, masks)
    return SceneResult(
        dataset=run.dataset.seal,
        train_noise_db=run.dataset.noise_ceiling_db("train"),
        seed=run.record.seed,
        costs=dict(read_costs(run.folder)),
        splits=splits,
    )


def _result(run: Run, split: Split, truth: Truth, scores: SplitScores, masks: Dataset | None) -> SplitResult:
    """A split's scores.

    Args:
        masks: the edited dataset, whose edit masks tell which pixels change.

    Raises:
        HyalineError: pictures are nearer to the truth than the truth's own noise lets any method come.
    """
    means, ceilings = {metric.key: scores.mean(metric.key) for metric in METRICS}, {"psnr_db": truth.ceiling_db}
    changed = None
    if masks is not None:
        inside = [read_edit_mask(masks, split, view) != ELSEWHERE for view in range(len(truth.images))]
        shown = [view for view, mask in enumerate(inside) if mask.any()]
        pairs = ((read_prediction(run, split, view), truth.images[view], inside[view]) for view in shown)
        means[CHANGED] = mean_of([masked_psnr(*pair) for pair in pairs])
        ceilings[CHANGED] = mean_of([_ceiling_db(run.dataset.view(split, view), inside[view]) for view in shown])
        changed = float(np.mean(inside))
    folder, limits = run.folder / "predictions" / split, []
    for view, psnr in zip(run.dataset.views(split), scores.images["psnr_db"], strict=True):
        limits.append((prediction_path(run, split, view.index), psnr, view.record.ceiling_db, ABOVE_CEILING))
    limits.append((folder, means["psnr_db"], ceilings["psnr_db"], MEAN_ABOVE_CEILING))
    if run.dataset.edit is None and CHANGED in means:  # Edits may change a few pixels, whose PSNR is any number.
        limits.append((folder, means[CHANGED], ceilings[CHANGED], ABOVE_CEILING))
    for path, psnr, ceiling, above in limits:
        if psnr is not None and ceiling is not None and psnr > ceiling + above:
            raise HyalineError(
                f"{path}: a PSNR of {psnr:.1f} dB is above the noise ceiling of {ceiling:.1f} dB; expected pictures "
                "that do not know the truth's noise"
            )
    return SplitResult(
        # The PSNR of few pixels may be infinite.
        metrics={key: None if value == math.inf else value for key, value in means.items()},
        psnr_db=tuple(scores.images["psnr_db"]),
        ceilings_db=ceilings,
        changed=changed,
    )


def _ceiling_db(view: View, inside: Bool[np.ndarray, "h w"]) -> float:
    """`ViewRecord.ceiling_db`, of some of the pixels."""
    radiance, noise = view.radiance_and_noise()
    difference = srgb_from_linear(radiance + noise) - srgb_from_linear(radiance - noise)
    return -10 * math.log10(float(np.mean(difference[inside] ** 2)) / 4 + ROUNDING_MSE)
