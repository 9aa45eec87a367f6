"""Draws README's picture of the demo: test views of the glass table, and what the runs of `make table` make of them.

python docs/demo.py DATASET RUNS OUT.webp
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from datagen.data.dataset import Split, open_dataset
from eval.score.metrics import psnr

RUNS = ("light-path", "paper-best", "paper")
VIEWS: tuple[tuple[Split, int], ...] = (("interpolating", 6), ("extrapolating", 0), ("extrapolating", 6))
PANEL, GAP, TEXT = 320, 8, 22
"""Width in pixels of a picture, between pictures, and height of a line of text; texels stay sharp."""


def main() -> None:
    """See the module."""
    dataset, runs, out = open_dataset(Path(sys.argv[1])), Path(sys.argv[2]), sys.argv[3]
    height = PANEL * dataset.config.resolution.height // dataset.config.resolution.width
    page = Image.new("RGB", ((PANEL + GAP) * (1 + len(RUNS)), (height + TEXT + GAP) * len(VIEWS)), "white")
    write = ImageDraw.Draw(page).text
    for row, (split, index) in enumerate(VIEWS):
        truth = dataset.view(split, index).image
        pictures = {f"truth, {split} view {index}": truth}
        for run in RUNS:
            drawn = np.asarray(Image.open(runs / run / "predictions" / split / f"{index:04d}.png").convert("RGB"))
            pictures[f"{run}: {psnr(drawn, truth):.1f} dB"] = drawn
        for column, (caption, picture) in enumerate(pictures.items()):
            left, top = column * (PANEL + GAP), row * (height + TEXT + GAP)
            write((left + 2, top + 3), caption, fill="black", font_size=14)
            page.paste(Image.fromarray(picture).resize((PANEL, height), Image.Resampling.NEAREST), (left, top + TEXT))
    page.save(out, quality=90)


if __name__ == "__main__":
    main()
