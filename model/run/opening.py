"""A run and the dataset that it was trained on, opened together."""

from pathlib import Path

from datagen.data.dataset import Dataset, open_dataset
from datagen.data.paths import find_dataset
from model.run.run_folder import RunRecord, check_trained_on, read_run


def open_trained(run: Path, dataset: str | None = None) -> tuple[RunRecord, Dataset]:
    """A run's record and its dataset: the one named, or the one where the run found it.

    Raises:
        HyalineError: there is no run, no dataset, or another one than that of the run.
    """
    record = read_run(run)
    opened = open_dataset(find_dataset(dataset) if dataset else Path(record.dataset))
    check_trained_on(run, record.config, opened)
    return record, opened
