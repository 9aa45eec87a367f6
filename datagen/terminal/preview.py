"""Thumbnails in a terminal: two pixels a character, in true colour."""

import sys
from collections.abc import Sequence
from typing import IO

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from rich.console import Console
from rich.file_proxy import FileProxy
from rich.text import Text

COLUMNS = 40
"""Characters that a thumbnail is wide, and pixels."""
GAP = "  "


def preview(pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]], caption: str) -> None:
    """Shows as many pictures as fit side by side on stderr, if stdout and stderr are terminals with true colour."""
    out, err = (_below_progress(file) for file in (sys.stdout, sys.stderr))
    if not (out.isatty() and err.isatty()):
        return
    console = Console(file=err)
    if console.color_system != "truecolor":
        return
    room = max(1, (console.width + len(GAP)) // (COLUMNS + len(GAP)))
    rows = [half_blocks(picture) for picture in pictures[:room]]
    with console.capture() as captured:
        _print_rows(console, rows)
        console.print(Text(caption))
    # Not by the console: a progress bar that is being shown then moves down.
    print(captured.get(), end="", file=sys.stderr, flush=True)


def _below_progress(file: IO[str]) -> IO[str]:
    """The underlying file: during a progress bar, rich replaces it with a proxy that denies being a terminal."""
    return file.rich_proxied_file if isinstance(file, FileProxy) else file


def _print_rows(console: Console, rows: list[list[list[tuple[str, str]]]]) -> None:
    """Thumbnails side by side, line by line."""
    for line in range(max(map(len, rows), default=0)):
        text = Text(no_wrap=True, end="")
        for place, thumbnail in enumerate(rows):
            text.append(GAP if place else "")
            for above, below in thumbnail[line] if line < len(thumbnail) else ():
                text.append("▀", style=f"{above} on {below}")
            if line >= len(thumbnail):
                text.append(" " * COLUMNS)
        console.print(text)


def half_blocks(picture: UInt8[np.ndarray, "h w 3"]) -> list[list[tuple[str, str]]]:
    """Rows of characters of a thumbnail: the colours of the upper and of the lower half of each."""
    height, width = picture.shape[:2]
    rows = max(1, round(COLUMNS * height / width / 2))
    small = np.asarray(Image.fromarray(picture).resize((COLUMNS, 2 * rows), Image.Resampling.BOX))
    colors = [["#" + bytes(map(int, pixel)).hex() for pixel in line] for line in small]
    return [list(zip(above, below, strict=True)) for above, below in zip(colors[::2], colors[1::2], strict=True)]
