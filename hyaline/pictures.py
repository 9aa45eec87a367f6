"""Pictures that notebooks show, of scenes, datasets, views and runs."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset, View
from datagen.disk.records import checked
from datagen.terminal.plugins import naming_parts
from hyaline.runs import Run
from hyaline.scenes import Scene

HEIGHT = 256
"""Pixels of a picture in a notebook: small ones are enlarged without smoothing."""
GAP = 4
SPP = 64
"""Samples per pixel of a scene's picture."""


@checked
def show(item: Scene | Dataset | View | Run) -> Image.Image:
    """A picture of a scene, dataset, view or run, which notebooks show.

    >>> from hyaline import open_dataset
    >>> show(open_dataset("glass_table").view("train", 0)).height     # the picture, glass, depth, normals, each layer
    256

    A scene is path-traced from its first training camera. A dataset shows the first view of each split, a run that of
    each test split: the truth, and beside it what the run predicts.
    """
    if isinstance(item, Scene):
        return _in_a_row([_scene_picture(item)])
    if isinstance(item, Dataset):
        return _in_a_row([item.view(split, 0).image for split in item.splits])
    if isinstance(item, View):
        from datagen.look.drawings import stored_pictures

        return _in_a_row(list(stored_pictures(item).values()))
    views = [item.dataset.view(split, 0) for split in TEST_SPLITS]
    return _in_a_row([picture for view in views for picture in (view.image, item.prediction(view))])


@naming_parts("hyaline.show")
def _scene_picture(scene: Scene) -> UInt8[np.ndarray, "h w 3"]:
    from datagen.builder.choices import SizeChoices, configure, fit_to_scene
    from datagen.data.images import srgb_from_linear, to_8bit
    from datagen.machine.mitsuba_variant import use_mitsuba
    from datagen.render.truth import Renderer, render_view
    from datagen.scene.rig import make_cameras

    described, size = scene.described(), SizeChoices(resolution=f"{4 * HEIGHT // 3}x{HEIGHT}")
    config = fit_to_scene(configure("tiny", size, seed=0), described, SizeChoices())
    use_mitsuba()
    cameras = make_cameras(described.cameras, config)["train"]
    renderer = Renderer(described, max_depth=config.max_depth)
    truth = render_view(renderer, cameras, 0, spp=SPP, view_seed=0, ceiling_db=None)
    return to_8bit(srgb_from_linear(truth.radiance))


def _in_a_row(pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> Image.Image:
    """Pictures of one height side by side, on white."""
    height = len(pictures[0])
    white = np.full((height, max(1, GAP * height // HEIGHT), 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (picture, white)][:-1]
    row = Image.fromarray(np.hstack(parts))
    scale = max(1, HEIGHT // height)
    return row.resize((scale * row.width, scale * row.height), Image.Resampling.NEAREST)
