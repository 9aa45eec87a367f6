"""Draws README's picture of the demo: test views of the glass table, and what the runs of `make table` make of them.

python docs/demo.py DATASET RUNS OUT.webp
"""

import sys
from pathlib import Path

import numpy as np
from gallery import panel, sheet
from PIL import Image

from datagen.data.dataset import Split, open_dataset
from eval.score.metrics import psnr

RUNS = ("light-path", "paper-best", "paper")
VIEWS: tuple[tuple[Split, int], ...] = (("interpolating", 6), ("extrapolating", 0), ("extrapolating", 6))
PANEL = 320
"""Width in pixels of a picture."""


def main() -> None:
    """See the module."""
    dataset, runs, out = open_dataset(Path(sys.argv[1])), Path(sys.argv[2]), sys.argv[3]
    panels = []
    for split, index in VIEWS:
        truth = dataset.view(split, index).image
        panels.append(panel(truth, f"truth, {split} view {index}", PANEL))
        for run in RUNS:
            drawn = np.asarray(Image.open(runs / run / "predictions" / split / f"{index:04d}.png").convert("RGB"))
            panels.append(panel(drawn, f"{run}: {psnr(drawn, truth):.1f} dB", PANEL))
    sheet(panels, columns=1 + len(RUNS)).save(out, quality=90)


if __name__ == "__main__":
    main()
