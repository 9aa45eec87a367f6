"""Submissions: the runs of one method, RUNS/SCENE/METHOD, each with its predictions of all splits of the protocol.

Folders come from anybody. Of a run that names another dataset than there is truth of, nothing is scored.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.paths import list_datasets
from datagen.data.variants import ANGLES, has_variant, open_variant, variant_root
from datagen.disk.errors import HyalineError
from datagen.terminal.command import say
from eval.score.runs import Run, has_predictions, has_split, list_run_folders, open_run
from eval.variants import run_of_variant
from hyaline_bench.protocol import Protocol, is_of_preset, left_out


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


def find_runs(root: Path, data_root: Path, preset: str, protocol: Protocol) -> dict[str, dict[str, Run]]:
    """The runs on datasets of a preset, by their name and scene, each with the dataset that has the truth.

    A run that cannot be opened, or whose dataset has another size, is named and left out; so is a second run on a
    scene.
    """
    truths = find_truths(data_root)
    runs: list[Run] = []
    for folder in list_run_folders(root, besides=root / "report"):
        with left_out():
            if has_predictions(folder):
                run = _open(folder, data_root, truths)
                runs += [run] if is_of_preset(run.dataset, preset, protocol) else []
    found: dict[str, dict[str, Run]] = {}
    for run in sorted(runs, key=lambda run: run.folder.parent.name != f"{run.dataset.config.scene}-{preset}"):
        scene = run.dataset.config.scene
        first = found.setdefault(run.name, {}).setdefault(scene, run)
        if first is not run:
            say(f"left out: {run.folder}: is a second run of {run.name} on {scene}, beside {first.folder}")
    return found


def _open(folder: Path, data_root: Path, truths: Mapping[str, Dataset]) -> Run:
    run = open_run(folder, data_root)
    if run.dataset.seal not in truths:
        raise HyalineError(
            f"{folder}: predicts {run.dataset.root} (dataset {run.dataset.seal[:12]}), which is not in {data_root}; "
            "set --data to the folder that contains it"
        )
    # A record must not choose which of a hidden scene's two datasets is scored against.
    return dataclasses.replace(run, dataset=truths[run.dataset.seal])


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
