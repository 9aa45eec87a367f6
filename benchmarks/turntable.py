"""The film of a dataset and its runs, side by side."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from datagen.builder.film import Picture, check_film, path_trace, write_film
from datagen.data.dataset import open_dataset
from datagen.disk.errors import HyalineError
from datagen.scene.rig import make_path
from model.run.predict import film_pictures
from model.run.run_folder import check_trained_on, read_run

CAPTION = 20
"""Rows under each picture for its name."""

GAP = 4
"""Columns between two pictures."""


def draw_turntable(
    runs: tuple[Path, ...],
    out: Path,
    *,
    path: str,
    frames: int,
    size: int,
    spp: int,
    fps: float,
    overwrite: bool,
) -> None:
    """Write the film.

    Args:
        size: width in pixels of each of the pictures.
    """
    if not runs:
        raise HyalineError("runs: none are given; expected one or more")
    check_film(out, fps, overwrite=overwrite)
    dataset = open_dataset(Path(read_run(runs[0]).dataset))
    cameras = make_path(dataset, path, frames, width=size, height=None)
    columns = [list(path_trace(dataset, cameras, spp=spp))]
    for folder in runs:
        config = read_run(folder).config
        check_trained_on(folder, config, dataset)
        columns.append(list(film_pictures(folder, config, dataset, cameras, device=torch.device("cpu"))))
    pages = _side_by_side(columns, ("truth, path-traced", *(folder.name for folder in runs)))
    write_film(out, pages, fps)


def _side_by_side(columns: list[list[Picture]], names: tuple[str, ...]) -> Iterator[Picture]:
    height, width = columns[0][0].shape[:2]
    font = ImageFont.load_default(13)
    for pictures in zip(*columns, strict=True):
        page = Image.new("RGB", (len(names) * (width + GAP) - GAP, height + CAPTION), "white")
        pen = ImageDraw.Draw(page)
        for place, (picture, name) in enumerate(zip(pictures, names, strict=True)):
            left = place * (width + GAP)
            page.paste(Image.fromarray(picture), (left, 0))
            pen.text((left + width / 2, height + CAPTION / 2), name, fill="black", font=font, anchor="mm")
        yield np.asarray(page)
