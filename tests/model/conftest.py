"""What tests of training share."""

from collections.abc import Iterator

import pytest
import torch
from support.synthetic import write_synthetic_dataset

from datagen.data.dataset import Dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The pane and the floor, for reading only."""
    return write_synthetic_dataset(tmp_path_factory.mktemp("model") / "data" / "synthetic")


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """On steps this small the threads' waiting for each other costs more than they compute."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
