"""Tests that a film holds its pictures in order, takes no foreign file's place, and tells what it cannot be."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageSequence
from support.disk import read_state

from datagen.data.film import check_film, write_film
from datagen.data.images import read_png
from datagen.disk.errors import HyalineError
from datagen.terminal.signals import Stopped

FRAMES = [np.full((6, 9, 3), level, np.uint8) for level in (0, 90, 255)]


def draw(first: int) -> Iterator[np.ndarray]:
    yield from FRAMES[first:]


def test_an_animated_file_shows_every_picture_in_order_at_its_pace_for_ever(tmp_path: Path) -> None:
    out = tmp_path / "film.webp"
    check_film(out, 10, frames=3, overwrite=False)
    write_film(out, draw, 10, frames=3, key="a")
    with Image.open(out) as film:
        shown = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
        assert film.info["loop"] == 0 and film.info["duration"] == 100
    assert np.abs(np.stack(shown).astype(int) - np.stack(FRAMES)).max() <= 2  # WebP rounds.


def test_a_folder_gets_a_png_a_frame_and_its_own_frames_alone_are_replaced(tmp_path: Path) -> None:
    out = tmp_path / "frames"
    write_film(out, draw, 10, frames=3, key="a")
    assert [read_png(out / f"000{number}.png")[0, 0, 0] for number in range(3)] == [0, 90, 255]
    (out / "notes.txt").write_text("mine")
    with pytest.raises(HyalineError, match=r"frames: holds another film; pass --overwrite"):
        check_film(out, 10, frames=2, overwrite=False)
    with pytest.raises(HyalineError, match=r"frames: holds another film; pass --overwrite"):
        write_film(out, draw, 10, frames=3, key="b")
    (out / "0002.png").unlink()  # Interrupted.
    check_film(out, 10, frames=3, overwrite=False)
    check_film(out, 10, frames=2, overwrite=True)
    write_film(out, lambda first: FRAMES[first + 1 :], 10, frames=2, key="a", overwrite=True)
    assert sorted(read_state(out).files) == ["0000.png", "0001.png", "film.json", "notes.txt"]
    assert read_png(out / "0000.png")[0, 0, 0] == 90


def test_a_stopped_folder_goes_on_after_its_intact_frames(tmp_path: Path) -> None:
    started: list[int] = []

    def stop_after(first: int, at_most: int = 1) -> Iterator[np.ndarray]:
        started.append(first)
        yield from FRAMES[first : first + at_most]
        if first + at_most < len(FRAMES):
            raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            write_film(tmp_path / "frames", stop_after, 10, frames=3, key="a")
    with pytest.raises(HyalineError, match="frames: holds another film; pass --overwrite"):
        write_film(tmp_path / "frames", stop_after, 10, frames=3, key="b")
    write_film(tmp_path / "frames", stop_after, 10, frames=3, key="a")
    write_film(tmp_path / "whole", draw, 10, frames=3, key="a")
    assert read_state(tmp_path / "frames").files == read_state(tmp_path / "whole").files
    (tmp_path / "frames/0001.png").write_bytes((tmp_path / "frames/0000.png").read_bytes())
    write_film(tmp_path / "frames", partial(stop_after, at_most=3), 10, frames=3, key="a")
    assert started == [0, 1, 2, 1]
    assert read_state(tmp_path / "frames").files == read_state(tmp_path / "whole").files
    write_film(tmp_path / "frames", partial(stop_after, at_most=3), 10, frames=3, key="a", overwrite=True)
    assert started[-1] == 0


def test_a_finished_folder_is_left_as_it_is_by_the_same_command(tmp_path: Path) -> None:
    out = tmp_path / "frames"
    write_film(out, draw, 10, frames=3, key="a")
    before = {path: path.stat().st_mtime_ns for path in out.glob("*.png")}
    check_film(out, 10, frames=3, overwrite=False)
    write_film(out, draw, 10, frames=3, key="a")
    assert {path: path.stat().st_mtime_ns for path in out.glob("*.png")} == before


def test_a_place_where_nothing_can_be_written_is_refused_before_anything_is_drawn(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OSError, match=r"File exists|Not a directory"):
        check_film(tmp_path / "notes.txt" / "film.webp", 10, frames=3, overwrite=False)


def test_a_stopped_file_says_that_it_starts_over(tmp_path: Path) -> None:
    def stop(_: int) -> Iterator[np.ndarray]:
        yield FRAMES[0]
        raise Stopped(signal.SIGTERM)

    with pytest.raises(Stopped, match=r"starts .*film\.webp over; with a folder as --out, it goes on") as caught:
        write_film(tmp_path / "film.webp", stop, 10, frames=3, key="a")
    assert caught.value.status == 143


def test_nothing_foreign_is_taken_for_a_film(tmp_path: Path) -> None:
    file, folder = tmp_path / "x.webp", tmp_path / "thesis"
    file.write_text("mine")
    folder.mkdir()
    (folder / "0000.png").write_text("mine")
    with pytest.raises(HyalineError, match=r"x\.webp: is there already; pass --overwrite"):
        check_film(file, 10, frames=3, overwrite=False)
    for overwrite in (False, True):
        with pytest.raises(HyalineError, match=r"thesis: is not empty \(0000\.png\) and no film; choose another --out"):
            check_film(folder, 10, frames=3, overwrite=overwrite)
    for suffix in (".gif", ".png", ".avi"):
        with pytest.raises(HyalineError, match=rf"'\{suffix}' is no kind of film; expected \.webp or \.mp4"):
            check_film(tmp_path / f"x{suffix}", 10, frames=3, overwrite=False)
    for fps in (0, -1, float("nan"), 1e9):
        with pytest.raises(HyalineError, match=r"fps: is .*; expected more than 0"):
            check_film(tmp_path / "x.webp", fps, frames=3, overwrite=False)


def test_a_movie_plays_every_picture_of_odd_sizes_too(tmp_path: Path) -> None:
    out = tmp_path / "film.mp4"
    check_film(out, 10, frames=3, overwrite=False)
    write_film(out, draw, 10, frames=3, key="a")
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(out), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    played = subprocess.run(words, capture_output=True, check=True).stdout
    shown = np.frombuffer(played, np.uint8).reshape(3, 6, 10, 3)
    np.testing.assert_allclose(shown.mean(axis=(1, 2, 3)), [0, 90, 255], atol=4)


def test_a_movie_without_its_program_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(HyalineError, match="MP4 needs the extra `video`"):
        check_film(tmp_path / "film.mp4", 10, frames=3, overwrite=False)
