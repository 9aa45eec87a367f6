"""A whole run: trains what is left to train, then renders what is left to render."""

import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import torch

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import holding, is_ours
from datagen.terminal.command import say
from model.run.logs import LogChoices, add_frames
from model.run.predict import render_predictions
from model.run.run_folder import (
    CHECKPOINT,
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
from model.run.train import train


def complete_run(
    config: TrainConfig,
    dataset: Dataset,
    out: Path,
    *,
    label: str,
    device: torch.device,
    flags: Mapping[str, str] = MappingProxyType({}),
    overwrite: bool = False,
    logs: LogChoices = LogChoices(),  # noqa: B008
) -> None:
    """Trains a method and renders the test splits; a run that was stopped resumes, a finished one stays as it is.

    Args:
        label: what tables call the run.
        flags: those that asked for it (`flags_asked`), which its record keeps.
        overwrite: delete the run in `out` and start over.
        logs: what to leave for people to watch.
    """
    for where, text in (("--label", label), ("dataset", dataset.root.as_posix())):
        if not text.isprintable():  # The run's record holds them, and is written when all else is done.
            raise HyalineError(f"{where}: is {text!r}; expected text without control characters")
    with holding(out, FOLDER):
        refuse_other_folders(out)
        finish_clearing(out)
        if not overwrite and _is_finished(config, dataset, out):
            return
        if overwrite or not (out / WEIGHTS).is_file():
            train(config, dataset, out, label=label, device=device, flags=flags, overwrite=overwrite, logs=logs)
        else:
            (out / CHECKPOINT).unlink(missing_ok=True)
            say(f"{out}: is trained; continuing with its predictions")
        start, missing = time.monotonic(), [v for v in drawn_along(dataset) if not is_drawn(out, v)]
        render_predictions(out, config, dataset, device=device)
        if logs.costs is not None:
            views = [n for part in (dataset, *missing) for split, n in part.num_views.items() if split != "train"]
            add_frames(out, sum(views), time.monotonic() - start)


def _is_finished(config: TrainConfig, dataset: Dataset, out: Path) -> bool:
    """True if nothing is left to do."""
    if not is_ours(out, FOLDER):
        return False
    check_trained_on(out, config, dataset)
    if is_all_drawn(out, dataset):
        say(told_finished(out))
        return True
    if not (out / WEIGHTS).is_file() and not (out / CHECKPOINT).is_file():
        say(f"{out}: was stopped before its first checkpoint; starting at step 0")
    return False
