"""Films: a WebP, an MP4, or a folder of PNGs."""

import io
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from datagen.data.cameras import Cameras
from datagen.data.images import png_bytes
from datagen.data.paths import view_name
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import (
    FolderKind,
    begin,
    holding,
    is_ours,
    refuse_file,
    refuse_others,
    refuse_taken,
    remove_files,
)
from datagen.disk.records import Json, read_regular, to_json
from datagen.disk.storage import commit, commit_sealed, dump_json, load_sealed, seal_bytes, sha256, sha256_file
from datagen.terminal.signals import Stopped

Picture = UInt8[np.ndarray, "h w 3"]

FRAMES = FolderKind(what="film", head="film.json", way_out="choose another --out")
"""A folder of PNGs, which its head lists, with the SHA-256 of those that are drawn."""

ANIMATED, MOVIE = ".webp", ".mp4"
KINDS = f"{ANIMATED} or {MOVIE}, or a folder for a PNG a frame"
MAX_FPS = 240.0


def check_film(out: Path, fps: float, *, frames: int, overwrite: bool) -> None:
    """Raises if the film cannot be written, before anything is rendered."""
    if not 0 < fps <= MAX_FPS:
        raise HyalineError(f"--fps: is {fps}; expected more than 0, at most {MAX_FPS:g} frames a second")
    if out.suffix == "":
        refuse_others(out, FRAMES)
        _refuse_foreign_frames(out, frames)
        if is_ours(out, FRAMES) and not overwrite and _own_frames(out) != _names(frames):
            raise _another_film(out)
        return
    if out.suffix not in (ANIMATED, MOVIE):
        raise HyalineError(f"{out}: {out.suffix!r} is no kind of film; expected {KINDS}")
    refuse_file(out, overwrite=overwrite)
    if out.suffix == MOVIE:
        _find_ffmpeg()


def film_key(cameras: Cameras, *makers: Json) -> str:
    """A digest of what determines a film's pictures: the cameras, and what draws them."""
    return sha256(dump_json([*makers, to_json(cameras)]))


def write_film(
    out: Path, draw: Callable[[int], Iterable[Picture]], fps: float, *, frames: int, key: str, overwrite: bool = False
) -> None:
    """Writes a film of pictures of one size; call `check_film` first.

    A file gets its name when it is complete. WebP loops for ever. A folder keeps the frames of a stopped call.

    Args:
        draw: the pictures from a number on.
        key: see `film_key`; frames that were drawn under another one are not kept.
        overwrite: replace frames that stand there.
    """
    if out.suffix == "":
        _write_frames(out, draw, frames, key, overwrite=overwrite)
        return
    try:
        pictures = list(draw(0))
    except (KeyboardInterrupt, Stopped) as error:
        number = error.status - 128 if isinstance(error, Stopped) else signal.SIGINT
        message = f"stopped; the same command starts {out} over; with a folder as --out, it goes on"
        raise Stopped(number, message) from None
    if out.suffix == MOVIE:
        commit(out, _mp4_bytes(pictures, fps))
    else:
        first, *others = (Image.fromarray(picture) for picture in pictures)
        data = io.BytesIO()
        first.save(
            data,
            format="WEBP",
            save_all=True,
            append_images=others,
            duration=1000 / fps,
            loop=0,
            quality=90,
            method=4,
        )
        commit(out, data.getvalue())


def _names(frames: int) -> list[str]:
    return [f"{view_name(number)}.png" for number in range(frames)]


def _another_film(out: Path) -> HyalineError:
    return HyalineError(f"{out}: holds another film; pass --overwrite to replace it, or choose another --out")


def _own_frames(out: Path) -> list[str]:
    """The frames that a folder's head lists; none if it has no head."""
    listed = load_sealed(out / FRAMES.head).get("frames") if is_ours(out, FRAMES) else None
    return [name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []


def _refuse_foreign_frames(out: Path, frames: int) -> None:
    refuse_taken(out, FRAMES, _names(frames), _own_frames(out))


def _write_frames(
    out: Path, draw: Callable[[int], Iterable[Picture]], frames: int, key: str, *, overwrite: bool
) -> None:
    names, drawn = _names(frames), cast(list[Json], [])
    head: dict[str, Json] = {"version": 1, "key": key, "frames": [*names], "drawn": drawn}
    with holding(out, FRAMES):
        if is_ours(out, FRAMES):
            before = load_sealed(out / FRAMES.head)
            if not overwrite and before.get("key") != key:
                raise _another_film(out)
            _refuse_foreign_frames(out, frames)
            if not overwrite:
                drawn += _intact(out, names, before.get("drawn"))
            remove_files(out, [name for name in _own_frames(out) if name not in names[: len(drawn)]])
            commit_sealed(out / FRAMES.head, head)
        else:
            begin(out, FRAMES, seal_bytes(head))
        for name, picture in zip(names[len(drawn) :], draw(len(drawn)), strict=True):
            data = png_bytes(picture)
            commit(out / name, data)
            drawn.append(sha256(data))
            commit_sealed(out / FRAMES.head, head)


def _intact(out: Path, names: list[str], digests: Json) -> list[Json]:
    """The digests of the first frames, up to one that is missing or damaged."""
    found: list[Json] = []
    for name, digest in zip(names, digests if isinstance(digests, list) else [], strict=False):
        if not (out / name).is_file() or sha256_file(out / name) != digest:
            break
        found.append(digest)
    return found


def _find_ffmpeg() -> str:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise HyalineError(
            "MP4 needs the extra `video` (`pip install imageio-ffmpeg`); or let --out end in .webp"
        ) from None
    return imageio_ffmpeg.get_ffmpeg_exe()


def _mp4_bytes(pictures: list[UInt8[np.ndarray, "h w 3"]], fps: float) -> bytes:
    """H.264 in MP4. The format needs even sizes, so odd ones are padded by a row or column."""
    height, width = pictures[0].shape[:2]
    raw = b"".join(
        np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge").tobytes() for picture in pictures
    )
    size = f"{width + width % 2}x{height + height % 2}"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "film.mp4"
        words = [_find_ffmpeg(), "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size]
        words += ["-r", f"{fps:g}", "-i", "-", "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p"]
        # Players take untagged pictures of 1280 pixels and more for BT.709, and ffmpeg converts to BT.601.
        words += ["-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709", "-color_range", "tv"]
        words += ["-movflags", "+faststart", "-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]
        ended = subprocess.run([*words, str(out)], input=raw, capture_output=True, check=False)
        if ended.returncode != 0:
            raise HyalineError(f"ffmpeg: {ended.stderr.decode(errors='replace').strip()[-300:]}; try --out film.webp")
        return read_regular(out)
