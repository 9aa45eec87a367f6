"""Tests that a film holds its pictures in order, takes no foreign file's place, and tells what it cannot be."""

import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageSequence

from datagen.builder.film import check_film, write_film
from datagen.data.images import read_png
from datagen.disk.errors import HyalineError

FRAMES = [np.full((6, 9, 3), level, np.uint8) for level in (0, 90, 255)]


def test_an_animated_file_shows_every_picture_in_order_at_its_pace_for_ever(tmp_path: Path) -> None:
    out = tmp_path / "film.webp"
    check_film(out, 10, overwrite=False)
    write_film(out, FRAMES, 10)
    with Image.open(out) as film:
        shown = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
        assert film.info["loop"] == 0 and film.info["duration"] == 100
    assert np.abs(np.stack(shown).astype(int) - np.stack(FRAMES)).max() <= 2  # WebP rounds.


def test_a_folder_gets_a_png_a_frame_and_a_second_film_needs_overwrite(tmp_path: Path) -> None:
    out = tmp_path / "frames"
    check_film(out, 10, overwrite=False)
    write_film(out, iter(FRAMES), 10)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(HyalineError, match=r"frames: is not an empty folder; pass --overwrite"):
        check_film(out, 10, overwrite=False)
    check_film(out, 10, overwrite=True)
    write_film(out, FRAMES[1:], 10)
    assert [read_png(path)[0, 0, 0] for path in sorted(out.glob("*.png"))] == [90, 255]
    assert (out / "notes.txt").read_text() == "mine"


def test_a_movie_plays_every_picture_of_odd_sizes_too(tmp_path: Path) -> None:
    out = tmp_path / "film.mp4"
    check_film(out, 10, overwrite=False)
    write_film(out, FRAMES, 10)
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(out), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    played = subprocess.run(words, capture_output=True, check=True).stdout
    shown = np.frombuffer(played, np.uint8).reshape(3, 6, 10, 3)
    np.testing.assert_allclose(shown.mean(axis=(1, 2, 3)), [0, 90, 255], atol=4)


@pytest.mark.parametrize(
    ("name", "fps", "message"),
    [
        ("x.webp", 10, r"x\.webp: is there already; pass --overwrite"),
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
