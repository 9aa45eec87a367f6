"""What tests of the report share."""

import pytest
from support.synthetic import write_synthetic_dataset

from datagen.data.dataset import Dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The pane and the floor in 16 x 16 pixels, for reading only."""
    return write_synthetic_dataset(tmp_path_factory.mktemp("eval") / "data" / "synthetic", resolution=16)
