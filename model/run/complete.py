"""A whole run: trains what is left to train, then renders what is left to render."""

import functools
import time
from pathlib import Path

import torch

from datagen.data.dataset import Dataset
from datagen.disk.ownership import holding, is_ours
from datagen.disk.records import check_text
from datagen.terminal.command import say
from model.batches.distributed import Processes, join
from model.run.checkpoint import delete_checkpoints, has_checkpoint
from model.run.logs import LogChoices, add_frames
from model.run.predict import render_predictions
from model.run.run_folder import (
    FOLDER,
    WEIGHTS,
    TrainConfig,
    check_trained_on,
    drawn_along,
    finish_clearing,
    is_all_drawn,
    is_drawn,
    refuse_other_folders,
    told_finished,
)
from model.run.train import check_processes, train


def complete_run(
    config: TrainConfig,
    dataset: Dataset,
    out: Path,
    *,
    label: str,
    device: torch.device,
    overwrite: bool = False,
    logs: LogChoices = LogChoices(),  # noqa: B008
) -> bool:
    """Trains a method and renders the test splits; a run that was stopped resumes, a finished one stays as it is.

    Args:
        label: what tables call the run.
        overwrite: delete the run in `out` and start over.
        logs: what to leave for people to watch.

    Returns:
        True in the process that wrote the run: of several that `torchrun` started, the first.
    """
    for where, text in (("--label", label), ("dataset", dataset.root.as_posix())):
        check_text(text, where)  # The run's record holds them, and is written when all else is done.
    with join(device) as processes:
        check_processes(config, processes)
        train_here = functools.partial(
            train,
            config,
            dataset,
            out,
            label=label,
            device=device,
            processes=processes,
            overwrite=overwrite,
            logs=logs,
        )
        if not processes.is_first:
            # The first process holds the folder, and tells whether there is anything to train.
            if processes.broadcast():
                train_here()
            return False
        with holding(out, FOLDER):
            refuse_other_folders(out)
            finish_clearing(out)
            if not overwrite and _is_finished(config, dataset, out, processes):
                return True
            if processes.broadcast(overwrite or not (out / WEIGHTS).is_file()):
                train_here()
            else:
                delete_checkpoints(out)
                say(f"{out}: is trained; continuing with its predictions")
            start, missing = time.monotonic(), [v for v in drawn_along(dataset) if not is_drawn(out, v)]
            render_predictions(out, config, dataset, device=device)
            if logs.costs is not None:
                views = [n for part in (dataset, *missing) for split, n in part.num_views.items() if split != "train"]
                add_frames(out, sum(views), time.monotonic() - start)
    return True


def _is_finished(config: TrainConfig, dataset: Dataset, out: Path, processes: Processes) -> bool:
    """True if nothing is left to do, which the other processes then know."""
    if not is_ours(out, FOLDER):
        return False
    check_trained_on(out, config, dataset)
    if is_all_drawn(out, dataset):
        say(told_finished(out))
        processes.broadcast(False)
        return True
    if not (out / WEIGHTS).is_file() and not has_checkpoint(out):
        say(f"{out}: was stopped before its first checkpoint; starting at step 0")
    return False
