"""Tests that a film holds its pictures in order, takes no foreign file's place, and tells what it cannot be."""

import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageSequence

from datagen.builder.film import check_film, write_film
from datagen.disk.errors import HyalineError

FRAMES = [np.full((6, 9, 3), level, np.uint8) for level in (0, 90, 255)]


@pytest.mark.parametrize("name", ["film.webp", "film.mp4"])
def test_a_film_shows_every_picture_in_order_at_its_pace(tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    check_film(out, 10, overwrite=False)
    write_film(out, FRAMES, 10)
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(out), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    if name.endswith(".mp4"):  # Of even sizes.
        played = subprocess.run(words, capture_output=True, check=True).stdout
        shown = np.frombuffer(played, np.uint8).reshape(3, 6, 10, 3)
    else:
        with Image.open(out) as film:
            shown = np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)])
            assert film.info["loop"] == 0 and film.info["duration"] == 100
    np.testing.assert_allclose(shown.mean(axis=(1, 2, 3)), [0, 90, 255], atol=4)


@pytest.mark.parametrize(
    ("name", "fps", "message"),
    [
        ("x.webp", 10, r"x\.webp: already exists; use --overwrite"),
        ("x.gif", 10, r"'\.gif' is no kind of film; expected \.webp or \.mp4"),
        ("y.webp", float("nan"), r"fps: is nan; expected more than 0"),
        ("y.webp", 1e9, r"fps: is .*; expected more than 0"),
        ("y.mp4", 10, "MP4 needs the extra `video`"),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is_drawn(
    name: str, fps: float, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    (tmp_path / "x.webp").write_text("mine")
    with pytest.raises(HyalineError, match=message):
        check_film(tmp_path / name, fps, overwrite=False)
