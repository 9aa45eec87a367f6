"""Builds the dataset of a scene with truth by somebody else: pictures by Blender's Cycles, under a measured sky.

    python3.11 -m venv blender && blender/bin/pip install bpy==4.4.0
    python examples/truth_by_cycles.py glass_table MAP.exr data/glass_table-cycles --python blender/bin/python
    model train light-path glass_table-cycles
    datagen build data/glass_table-cycles/scene --out data/glass_table-ours --max-depth 100   # the same by hyaline

bpy brings eight maps of Poly Haven (CC0) in bpy/4.4/datafiles/studiolights/world. Meshes, cameras, glass, metal and
colours are those of hyaline's scene; coats of plastic, which Cycles has otherwise, and lamps are left out. With
--checks, hyaline renders some test views, too, and what differs is printed beside what noise explains.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from benchmarks.blender import Compared, cycles_table, draw_by_cycles, float_exr, sheet_bytes
from datagen.builder.build import open_or_start, peel_dataset
from datagen.builder.choices import SizeChoices, configure, fit_to_scene
from datagen.data.config import TEST_SPLITS, Split
from datagen.data.dataset import Dataset, View
from datagen.data.images import decode_radiance
from datagen.data.paths import TRUTH
from datagen.data.writing import commit_view
from datagen.disk.ownership import DATASET, holding
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import EnvironmentMap, Scene, SceneObject
from datagen.scene.finding import find_scene
from datagen.scene.folder import open_scene
from datagen.scene.materials import Diffuse, Plastic
from datagen.scene.rig import cameras_within, make_cameras
from datagen.terminal.command import say

SKY = "sky.exr"
VIEWS_AT_ONCE = 4
"""Views that one process of Blender draws; they are kept together."""
SIZE = {"resolution": 128, "views": 60, "test_views": 8, "spp": 256, "test_spp": 512, "max_depth": 100}
"""Defaults of the flags for sizes, which are those of `datagen build`. Rims of clear glass guide light for long."""


def main() -> None:
    choices = parse()
    use_mitsuba()
    scene = under_map(find_scene(choices.scene), choices.map)
    size = SizeChoices(**{name: getattr(choices, name) for name in SIZE})
    config = fit_to_scene(configure("demo", size, seed=0), scene, size)
    with holding(choices.out, DATASET):
        cameras = cameras_within(scene, make_cameras(scene.cameras, config))
        dataset = open_or_start(scene, choices.out, config, cameras, overwrite=False)
        for split in dataset.splits:
            spp = choices.spp if split == "train" else choices.test_spp
            missing = [view for view in dataset.views(split) if not view.is_built]
            for start in range(0, len(missing), VIEWS_AT_ONCE):
                say(f"{choices.out}: {split}: {len(missing) - start} views are left to draw")
                draw(dataset, split, missing[start : start + VIEWS_AT_ONCE], choices.python, spp)
    peel_dataset(dataset, TRUTH, num_layers=size.num_layers, overwrite=False)
    found = [
        each for split in TEST_SPLITS for each in compare_with_ours(dataset, split, choices.checks, choices.test_spp)
    ]
    for each in found:
        Path(f"{each.name}.png").write_bytes(sheet_bytes(each))
    print(cycles_table({each.name: each for each in found}) if found else choices.out)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Build the dataset of a scene with pictures by Blender's Cycles.")
    parser.add_argument("scene", help="a name that `datagen scenes` lists, or a folder with a scene.json")
    parser.add_argument("map", type=Path, help="the sky, an equirectangular EXR")
    parser.add_argument("out", type=Path, help="folder of the dataset; views that it has are kept")
    parser.add_argument("--python", type=Path, required=True, help="interpreter of an environment with bpy")
    parser.add_argument("--checks", type=int, default=0, help="views of each test split to compare; default: 0")
    for name, usual in SIZE.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=usual, help="default: %(default)s")
    return parser.parse_args()


def under_map(scene: Scene, path: Path) -> Scene:
    """The scene under the map, without coats and lamps."""
    # Compression makes dark pixels of measured maps slightly negative.
    radiance = np.maximum(decode_radiance(path.read_bytes(), where=str(path)), 0)
    return dataclasses.replace(
        scene,
        description=f"{scene.description}; under {path.name}, without coats and lamps; pictures by Blender's Cycles",
        objects=tuple(map(without_coat, scene.objects)),
        environment=EnvironmentMap(path=SKY),
        lights=(),
        baked={**scene.baked, SKY: float_exr(radiance)},
    )


def without_coat(item: SceneObject) -> SceneObject:
    coated = item.material
    return dataclasses.replace(item, material=Diffuse(color=coated.color)) if isinstance(coated, Plastic) else item


def draw(dataset: Dataset, split: Split, views: list[View], python: Path, spp: int) -> None:
    """Draws some views of a split, and commits them."""
    from datagen.render.truth import derive_seed, truth_files, truth_of_halves

    scene, cameras = open_scene(dataset), [dataset.cameras(split)[view.index] for view in views]
    seeds = [[derive_seed(split, view.index, half) >> 1 for half in "ab"] for view in views]
    settings = {"spp": spp, "max_depth": dataset.config.max_depth, "seeds": seeds}
    drawn = draw_by_cycles(scene, scene.objects, cameras, python, where=dataset.root, **settings)
    for view, (first, second), pair in zip(views, drawn.halves, seeds, strict=True):
        truth = truth_of_halves(first.astype(np.float64), second.astype(np.float64), spp)
        renderer = f"Cycles of Blender {drawn.version}"
        told = {"seed": pair[0], "spp": spp, "noise_mse": truth.noise_mse, "variant": renderer}
        commit_view(dataset, split, view.index, truth_files(truth), **told)


def compare_with_ours(dataset: Dataset, split: Split, count: int, spp: int) -> list[Compared]:
    """Renders the first views of a split with hyaline, too, with as many samples."""
    from datagen.render.truth import Renderer, derive_seed, render_view

    cameras = dataset.cameras(split)
    renderer = Renderer(open_scene(dataset), max_depth=dataset.config.max_depth)
    found = []
    for view in dataset.views(split)[:count]:
        seed = derive_seed("ours", split, view.index)
        ours = render_view(renderer, cameras, view.index, spp=spp, view_seed=seed, ceiling_db=None)
        name, noise_mse = f"{dataset.name}-{split}-{view.index}", ours.noise_mse + (view.record.noise_mse or 0)
        found.append(Compared(name=name, ours=ours.radiance, cycles=view.radiance, noise_mse=noise_mse))
    return found


if __name__ == "__main__":
    main()
