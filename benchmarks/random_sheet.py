"""A sheet of random scenes, path-traced: a row for each family, a seed in each cell."""

import dataclasses
import io

import numpy as np

from datagen.data.config import DatasetConfig, Resolution, SplitConfig
from datagen.data.images import srgb_from_linear, to_8bit
from datagen.render.truth import Renderer
from datagen.scene.atlas import unwrap_all
from datagen.scene.description import Scene
from datagen.scene.procedural.drawing import draw_scene
from datagen.scene.random_names import FAMILIES, RandomName
from datagen.scene.rig import make_cameras
from datagen.terminal.command import track

VIEWS = 6
"""Training cameras of each scene; the sheet uses one of them."""
GAP = 4
"""White pixels between pictures."""


def draw_random_sheet(seeds: tuple[int, ...], *, view: int, size: int, spp: int, quality: int) -> bytes:
    """The WebP of these seeds, a row for each family that they are of. Call `use_mitsuba` first."""
    rows: dict[str, list[np.ndarray]] = {family: [] for family in FAMILIES.built_in}
    for seed in track(seeds, label="render", total=len(seeds)):
        name = RandomName(seed=seed)
        rows[name.family].append(_picture(draw_scene(name).scene, view, size, spp))
    shown = [pictures for pictures in rows.values() if pictures]
    columns = max(map(len, shown))
    step = size + GAP
    sheet = np.full((len(shown) * step - GAP, columns * step - GAP, 3), 255, np.uint8)
    for row, pictures in enumerate(shown):
        for column, picture in enumerate(pictures):
            sheet[row * step : row * step + size, column * step : column * step + size] = picture
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(sheet).save(buffer, "WEBP", quality=quality, method=6)
    return buffer.getvalue()


def _picture(scene: Scene, view: int, size: int, spp: int) -> np.ndarray:
    # Only what has a texture needs uv.
    meshes = unwrap_all({item.name: item.mesh for item in scene.objects if item.material.textures()})
    objects = tuple(dataclasses.replace(item, mesh=meshes.get(item.name, item.mesh)) for item in scene.objects)
    split = SplitConfig(views=VIEWS, spp=spp)
    config = DatasetConfig(
        scene=scene.name,
        preset="sheet",
        resolution=Resolution(width=size, height=size),
        train=split,
        interpolating=split,
        extrapolating=split,
    )
    cameras = make_cameras(scene.cameras, config)["train"]
    renderer = Renderer(dataclasses.replace(scene, objects=objects), max_depth=24)
    radiance, _ = renderer.radiance(cameras, view, spp=spp, seed=1)
    return to_8bit(srgb_from_linear(np.asarray(radiance)))
