"""Draws the worst view of `light-path` in some scenes of the benchmark, and prints where the squared error lies.

    python docs/gallery.py DATA RUNS OUT.webp DATASET...

DATA has the datasets, with the truth of all views; RUNS the runs of `model sweep` on them.
"""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import Shaped
from PIL import Image, ImageDraw

from datagen.data.dataset import Dataset, Split, open_dataset

RUN = "light-path-400-steps"
PANEL = 192
"""Width in pixels of a picture; texels stay sharp."""
STRONGER = 4
"""Errors are drawn around grey, so many times as strong."""
SPLITS: tuple[Split, ...] = ("interpolating", "extrapolating")


def draw_scene(dataset: Dataset, run: Path, title: str) -> tuple[Image.Image, str]:
    """Truth, prediction and error of the view with the largest error, and a row of Markdown with the shares of the
    squared error of all views by what a pixel's centre sees first."""
    error, pixels = Counter[str](), Counter[str]()
    worst: tuple[float, np.ndarray] = (0.0, np.zeros(0))
    squares, noise = [], []
    for split in SPLITS:
        for index, path in enumerate(sorted((run / "predictions" / split).glob("*.png"))):
            view = dataset.view(split, index)
            truth, drawn = view.image.astype(np.float64), np.asarray(Image.open(path).convert("RGB"), np.float64)
            off = np.square(drawn - truth).mean(axis=-1)
            first, is_glass = view.object_ids()[0], view.mask("glass")
            for seen in np.unique(first):
                name = dataset.objects[seen - 1].name if seen else "sky"
                for kind, chosen in (("glass", is_glass), (name, ~is_glass)):
                    here = (first == seen) & chosen
                    error[kind] += off[here].sum()
                    pixels[kind] += int(here.sum())
            squares.append(off.mean())
            if off.mean() > worst[0]:
                signed = np.clip(128 + STRONGER * (drawn - truth), 0, 255)
                worst = off.mean(), np.concatenate([truth, drawn, signed], axis=1)
        noise.append(255**2 / 10 ** (dataset.noise_ceiling_db(split) / 10))
    share = {name: f"{name} {value / error.total():.0%}" for name, value in error.most_common(4)}
    total = np.mean(squares)
    row = (
        f"| {title} | {_decibels(total):.1f} | {min(1.0, np.mean(noise) / total):.0%} | {', '.join(share.values())} | |"
    )
    return panel(worst[1], f"{title}: {_decibels(worst[0]):.1f} dB", 3 * PANEL), row


def _decibels(square: float) -> float:
    return 10 * np.log10(255**2 / square)


def panel(picture: Shaped[np.ndarray, "h w 3"], caption: str, width: int) -> Image.Image:
    """A picture of this width in pixels, with sharp texels, below its caption."""
    drawn = Image.fromarray(picture.astype(np.uint8))
    drawn = drawn.resize((width, width * drawn.height // drawn.width), Image.Resampling.NEAREST)
    page = Image.new("RGB", (drawn.width, drawn.height + 20), "white")
    page.paste(drawn, (0, 20))
    ImageDraw.Draw(page).text((4, 4), caption, fill="black", font_size=13)
    return page


def sheet(panels: list[Image.Image], columns: int) -> Image.Image:
    """Panels of one size, row by row."""
    width, height = panels[0].size
    page = Image.new("RGB", (columns * (width + 12) - 12, -(-len(panels) // columns) * (height + 8)), "white")
    for place, each in enumerate(panels):
        page.paste(each, (place % columns * (width + 12), place // columns * (height + 8)))
    return page


def main() -> None:
    """See the module."""
    data, runs, out, *names = sys.argv[1:]
    panels = []
    for name in names:
        drawn, row = draw_scene(open_dataset(Path(data) / name), Path(runs) / name / RUN, name.removesuffix("-small"))
        panels.append(drawn)
        print(row)
    sheet(panels, columns=2).save(out, quality=80)


if __name__ == "__main__":
    main()
