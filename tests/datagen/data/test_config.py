"""Tests how the size of pictures is read, printed and stored."""

from pathlib import Path

import pytest
from support.synthetic import write_synthetic_dataset

from datagen.data.config import MAX_SIDE, SPLITS, Resolution, parse_resolution
from datagen.data.dataset import open_dataset
from datagen.disk.errors import HyalineError


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("0", "is 0; expected 1 to 8192"),
        ("-3", "is -3; expected 1 to 8192"),
        (f"20x{MAX_SIDE + 1}", "is 8193; expected 1 to 8192"),
        ("", "is ''; expected a width and height"),
        ("32x", "is '32x'; expected a width and height"),
        ("32x24x3", "is '32x24x3'; expected a width and height"),
        ("3.5", "is '3.5'; expected a width and height"),
        ("٣٢", "expected a width and height"),
        ("9" * 5000, "expected a width and height"),
    ],
)
def test_what_is_no_size_of_pictures_is_refused_in_one_line(text: str, problem: str) -> None:
    with pytest.raises(HyalineError, match=f"^resolution: .*{problem}") as caught:
        parse_resolution(text)
    assert len(str(caught.value)) < 200 and "\n" not in str(caught.value)


def test_pictures_layers_and_cameras_of_an_oblong_dataset_have_its_shape(tmp_path: Path) -> None:
    resolution = Resolution(width=24, height=16)
    dataset = write_synthetic_dataset(tmp_path, resolution=resolution, train_views=2)
    assert open_dataset(tmp_path).config.resolution == resolution
    for split in SPLITS:
        for view in dataset.views(split):
            assert view.image.shape == view.radiance.shape == (16, 24, 3)
            assert view.layers().uv.shape == (4, 16, 24, 2) and view.mask("glass").shape == (16, 24)
            assert (view.camera.width, view.camera.height) == (24, 16)
